"""Registers every task as a Gymnasium environment when it is imported.

import gymnasium
import tsbench.gym

one = gymnasium.make("tsbench/laikago_trot-v1")
many = gymnasium.make_vec("tsbench/laikago_trot-v1", num_envs=512)  # stepped together

The number at the end is the task's version. `make` and `make_vec` also take the arguments of
`tsbench.load`, such as `variant="planning"`, `perturbed=True` or `seed=5`, and `make_vec` those of
`tsbench.load_batched` and an `autoreset_mode`. Gymnasium's wrappers of single environments go into
`make_vec(..., wrappers=...)` with `vectorization_mode="sync"` or `"async"`.

A task ends its episodes itself, at its horizon. `max_episode_steps` can only end them earlier.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import gymnasium
from gymnasium.vector import AutoresetMode

import tsbench
from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.task import MDP
from tsbench.sim.gym import GymEnvironment, GymVectorEnvironment

__all__ = ["GymEnvironment", "GymVectorEnvironment", "identifier", "make", "make_vec"]


def identifier(name: str) -> str:
    """Gymnasium's identifier of the task of that name.

    Raises:
        TsbenchError: no task has that name.
    """
    return f"tsbench/{name}-v{tasks.make(name).version}"


def make(
    name: str, render_mode: str | None = None, *, longest: int | None = None, **arguments: Any
) -> GymEnvironment:
    """One environment.

    Args:
        name: of the task.
        render_mode: None or "rgb_array". `gymnasium.make` makes the other modes of this one.
        longest: the number of steps at which Gymnasium cuts episodes; None if it does not.
        arguments: as in `tsbench.load`.

    Raises:
        TsbenchError: an argument is refused, or Gymnasium would cut the episodes.
    """
    single = tsbench.load(name, **arguments)
    _expect_uncut("make", single.task.mdp, longest)
    return GymEnvironment(single, render_mode)


def make_vec(
    name: str,
    num_envs: int = 1,
    render_mode: str | None = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    max_episode_steps: int | None = None,
    longest: int | None = None,
    seed: int | Sequence[int | None] | None = None,
    **arguments: Any,
) -> GymVectorEnvironment:
    """`num_envs` environments stepped together.

    Args:
        name: of the task.
        num_envs: number of environments.
        render_mode: None or "rgb_array".
        autoreset_mode: what happens where an episode ends (`GymVectorEnvironment`).
        max_episode_steps: ends episodes earlier than the task does.
        longest: as in `make`.
        seed: of the starts, as in `GymVectorEnvironment.reset`.
        arguments: as in `tsbench.load_batched`.

    Raises:
        TsbenchError: an argument is refused, or Gymnasium would cut the episodes.
    """
    batched = tsbench.load_batched(name, count=num_envs, seed=seed, **arguments)
    _expect_uncut("make_vec", batched.mdp, longest)
    return GymVectorEnvironment(
        batched, render_mode, autoreset_mode=autoreset_mode, max_episode_steps=max_episode_steps
    )


def _expect_uncut(function: str, mdp: MDP[Any], longest: int | None) -> None:
    if longest is not None and mdp.horizon > longest:
        raise TsbenchError(
            f"gymnasium would cut the episodes of {mdp.horizon} steps at {longest}; "
            f"tsbench.gym.{function}({mdp.name!r}, ...) makes whole ones"
        )


def _register(name: str) -> None:
    task = tasks.make(name)
    gymnasium.register(
        identifier(name),
        entry_point="tsbench.gym:make",
        vector_entry_point="tsbench.gym:make_vec",
        max_episode_steps=task.horizon,
        kwargs={"name": name, "longest": task.horizon},
    )


# By it `gymnasium.make` knows which modes its own wrappers have to add.
make.metadata = GymEnvironment.metadata  # type: ignore[attr-defined]
for _name in tasks.names():
    with suppress(TsbenchError):  # a plug-in's task that cannot be made; `make` says why
        _register(_name)
