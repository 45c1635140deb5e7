"""How many threads the networks have."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits


@contextmanager
def one_thread() -> Iterator[None]:
    """Gives torch and numpy's BLAS one thread each, and at the end what they had before.

    The networks are small: more threads gain little on a free machine, stall on a busy one, and
    change the rounding, and with it the result, from machine to machine. The physics has the cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)
