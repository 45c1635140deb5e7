"""Dynamics, which turn actions into states, and checks of their inputs and results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from tsbench.core.arrays import Array
from tsbench.core.errors import NotFiniteError, TsbenchError, quoted
from tsbench.core.state import Rng, S, Start, State
from tsbench.sim.push import Push


class Dynamics(Protocol[S]):
    """Dynamics of a fixed number of episodes: they turn actions into states.

    Attributes:
        diverged: rows in which the last step could not be computed, sorted. They keep the state
            before that step, and their episodes have to end.
        seconds: wall-clock time spent in a physics engine so far.
    """

    diverged: np.ndarray
    seconds: float

    def begin(self, rng: Rng, rows: np.ndarray) -> S:
        """Starts new episodes in `rows` and returns their states."""

    def advance(self, state: S, action: Array, rows: np.ndarray | None = None) -> S:
        """The states one time step later, of all episodes or only of those in `rows`."""


class LastingDynamics(Dynamics[S], Protocol[S]):
    """Dynamics that can be saved and restored."""

    def unseen(self) -> tuple[np.ndarray, ...]:
        """What the next states depend on beside state and action, each of shape (episodes,). A
        policy never sees it; a critic, which only training needs, may."""

    def snapshot(self) -> dict[str, Any]:
        """All data that is kept between two calls: plain values and arrays."""

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot."""


class PlacedDynamics(Dynamics[S], Protocol[S]):
    """Full physics in which scores are played.

    Attributes:
        push: the push that disturbs the episodes, or None.
        side_by_side: how many episodes are best played at once.
    """

    push: Push | None
    side_by_side: int

    def place(self, rows: np.ndarray, start: Start) -> S:
        """Puts the simulations in `rows` where `start` says and returns their states."""

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """qpos (n, nq) and qvel (n, nv) of all simulations."""


# Makes them: (task, count, *, threads, change).
Engine = Callable[..., PlacedDynamics[Any]]


def expect_shape(action: Array, shape: tuple[int, ...]) -> None:
    """Checks the shape of an action, since libraries would broadcast some wrong shapes.

    Raises:
        TsbenchError: the action has another shape.
    """
    found = tuple(np.shape(action))
    if found != shape:
        raise TsbenchError(f"the action has shape {found}, not {shape}")


def as_action(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The action as floats.

    Args:
        action: an array, or what numpy makes one of.
        shape: that the action must have.

    Raises:
        TsbenchError: the action is not made of real numbers, or has another shape.
    """
    try:
        numbers = np.asarray(action)
    except (TypeError, ValueError, RuntimeError):  # ragged lists; tensors with a gradient
        numbers = np.asarray(None)
    if numbers.dtype.kind not in "fiub":
        raise TsbenchError(f"the action must be an array of numbers, not {quoted(action)}")
    expect_shape(numbers, shape)
    return np.asarray(numbers, float)


def expect_finite(
    steps: np.ndarray,
    previous: State,
    action: np.ndarray,
    state: State | None = None,
    reward: np.ndarray | None = None,
    rows: np.ndarray | None = None,
) -> None:
    """Checks that the numbers of a step of n episodes are finite.

    Args:
        steps: number of steps in each episode so far, shape (n,).
        previous: the state before the step.
        action: actions, shape (n, action_size).
        state: the state after the step; None before it is known.
        reward: reward of the step, shape (n,); None before it is known.
        rows: indices of the episodes' environments, shape (n,); None for all environments.

    Raises:
        NotFiniteError: a number is not finite. The message names the environment, the step of its
            episode and the quantity.
    """
    looked_at: dict[str, np.ndarray] = {"action": action}
    if state is not None and reward is not None:
        looked_at |= {**vars(state), "reward": reward}
    for name, values in looked_at.items():
        if np.isfinite(values).all():
            continue
        finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
        row = int(np.flatnonzero(~finite)[0])
        before = {f"previous_{key}": value for key, value in vars(previous).items()}
        which = row if rows is None else rows[row]
        raise NotFiniteError(
            f"{name} of environment {which} is not finite at step {steps[row]} of its episode",
            {"steps": steps, **before, "action": action, **looked_at},
        )
