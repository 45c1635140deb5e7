"""Registers every task as a Gymnasium environment when it is imported.

import gymnasium
import tsbench.gym

one = gymnasium.make("tsbench/laikago_trot-v1")
many = gymnasium.make_vec("tsbench/laikago_trot-v1", num_envs=512)  # stepped together

The number at the end is the task's version. `make` and `make_vec` also take the arguments of
`tsbench.load`, such as `variant="planning"` or `perturbed=True`.
"""

from __future__ import annotations

from typing import Any

import gymnasium

import tsbench
from tsbench import tasks
from tsbench.sim.gym import GymEnvironment, GymVectorEnvironment

__all__ = ["GymEnvironment", "GymVectorEnvironment", "identifier", "make", "make_vec"]


def identifier(name: str) -> str:
    """Gymnasium's identifier of the task of that name.

    Raises:
        TsbenchError: no task has that name.
    """
    return f"tsbench/{name}-v{tasks.make(name).version}"


def make(name: str, render_mode: str | None = None, **arguments: Any) -> GymEnvironment:
    """One environment; arguments as in `tsbench.load`."""
    return GymEnvironment(tsbench.load(name, **arguments), render_mode)


def make_vec(name: str, num_envs: int, **arguments: Any) -> GymVectorEnvironment:
    """`num_envs` environments stepped together; arguments as in `tsbench.load_batched`."""
    return GymVectorEnvironment(tsbench.load_batched(name, count=num_envs, **arguments))


for _name in tasks.names():
    gymnasium.register(
        identifier(_name),
        entry_point="tsbench.gym:make",
        vector_entry_point="tsbench.gym:make_vec",
        kwargs={"name": _name},
    )
