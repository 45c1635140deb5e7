"""Several processes that learn together, each with its own GPU, as torchrun starts them.

Each process steps its own environments. rsl-rl averages their gradients after every minibatch, so
that all have the same weights. The first process writes the run directory.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import torch

# Set by torchrun in every process that it starts.
COUNT, RANK, LOCAL_RANK = "WORLD_SIZE", "RANK", "LOCAL_RANK"
SEEDS = 2**32


def count() -> int:
    """Number of the processes that learn together; 1 without torchrun."""
    return int(os.environ.get(COUNT, "1"))


def rank() -> int:
    """Number of this process among them."""
    return int(os.environ.get(RANK, "0"))


def local_rank() -> int:
    """Number of this process among those of this machine, which is that of its GPU."""
    return int(os.environ.get(LOCAL_RANK, "0"))


def own(seed: int) -> int:
    """The seed of what should differ between processes: starts, disturbances and noise."""
    return (seed + rank()) % SEEDS


@contextmanager
def together(device: torch.device) -> Iterator[None]:
    """Connects the processes, if there are several."""
    if count() == 1:
        yield
        return
    on_gpu = device.type == "cuda"
    with torch.cuda.device(device) if on_gpu else nullcontext():
        torch.distributed.init_process_group("nccl" if on_gpu else "gloo")
        try:
            yield
        finally:
            torch.distributed.destroy_process_group()
