"""Many episodes of one MDP on one torch device, which begin anew as they end.

The semantics are those of `BatchedEnvironment`, in float32. Nothing moves to the host in a step:
rows are chosen by masks, shapes never change, and errors are kept on the device until `check` reads
them. On a GPU the functions of the MDP are recorded as CUDA graphs when they are first called, and
replayed afterwards: they consist of some hundred small kernels, and launching those one by one
would take longer than running them.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Generic, Protocol, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from tsbench.core.arrays import step_of
from tsbench.core.errors import NotFiniteError, TsbenchError
from tsbench.core.state import Batch, Course, S
from tsbench.core.task import MDP
from tsbench.sim.dynamics import expect_shape
from tsbench.sim.kinematic import Planning

POOL = 2**16  # starts that are drawn in advance

T = TypeVar("T")


class DeviceDynamics(Protocol[S]):
    """Dynamics of n episodes on one torch device. Arrays are tensors there, floats are float32.

    Neither `begin` nor `advance` waits for the device, moves data to the host or changes a shape.
    Tensors that they return may be overwritten by the next call of the same function.

    Attributes:
        starts: number of starts to choose from.
        diverged: whether the last step of a row could not be computed, shape (n,). Such a row
            keeps the state before that step, and its episode has to end.
        substeps: physics steps done so far, all episodes together.
    """

    starts: int
    diverged: Tensor
    substeps: int

    def begin(self, which: Tensor, rows: Tensor) -> S:
        """Starts new episodes.

        Args:
            which: number of the start of each row, integers in [0, starts), shape (n,).
            rows: whether an episode begins in a row, shape (n,).

        Returns:
            The states of all n rows; only those of `rows` have a meaning.
        """

    def advance(self, state: S, action: Tensor) -> S:
        """The states one time step later."""

    def check(self) -> None:
        """Called after each rollout; may wait for the device.

        Raises:
            TsbenchError: the physics since the last call cannot be relied on, for instance because
                contacts did not fit into memory.
        """

    def warned(self) -> dict[str, int]:
        """Number of the engine's warnings so far, by name; may wait for the device."""

    def snapshot(self) -> dict[str, Any]:
        """All data that is kept between two calls: plain values and numpy arrays."""

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot."""
