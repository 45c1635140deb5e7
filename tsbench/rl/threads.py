"""The number of threads that networks use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits


@contextmanager
def one_thread() -> Iterator[None]:
    """Limits torch and numpy's BLAS to one thread each, and restores their former limits at the
    end.

    The networks are small. More threads gain little on an idle machine and stall on a busy one.
    They also change the rounding, and with it the result, from machine to machine. The other cores
    are for the physics.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)
