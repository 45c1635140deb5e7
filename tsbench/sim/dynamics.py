"""What turns actions into states, and what is looked at on the way."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from tsbench.core.arrays import Array
from tsbench.core.errors import NotFiniteError, TsbenchError
from tsbench.core.state import Rng, S, State


class Dynamics(Protocol[S]):
    """What turns actions into states, for a fixed number of episodes.

    Attributes:
        diverged: rows in which the last step could not be computed, sorted. They keep the state
            they had before it, and their episodes have to end.
        seconds: spent in a physics engine so far, wall-clock.
    """

    diverged: np.ndarray
    seconds: float

    def begin(self, rng: Rng, rows: np.ndarray) -> S:
        """Starts new episodes in `rows` and returns their states."""

    def advance(self, state: S, action: Array, rows: np.ndarray | None = None) -> S:
        """The states one time step later, of all episodes or only of those in `rows`."""


class LastingDynamics(Dynamics[S], Protocol[S]):
    """Dynamics that can be saved and go on later."""

    def snapshot(self) -> dict[str, Any]:
        """All that it remembers between two calls: plain values and arrays."""

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Goes on from where `snapshot` was taken."""


def expect_shape(action: np.ndarray, shape: tuple[int, ...]) -> None:
    """
    Raises:
        TsbenchError: the action has another shape; numpy would stretch or cut some of them.
    """
    if np.shape(action) != shape:
        raise TsbenchError(f"the action has shape {np.shape(action)}, not {shape}")


def expect_finite(
    steps: np.ndarray,
    previous: State,
    action: np.ndarray,
    state: State | None = None,
    reward: np.ndarray | None = None,
    rows: np.ndarray | None = None,
) -> None:
    """Looks at a step of many episodes.

    Args:
        steps: of each episode so far, shape (n,).
        previous: the state before the step.
        action: shape (n, action_size).
        state: the state after it, once it is known.
        reward: of the step, shape (n,), once it is known.
        rows: which of the environments these are, shape (n,), where they are not all.

    Raises:
        NotFiniteError: a number is not finite. It names the episode, its step and the quantity.
    """
    looked_at: dict[str, np.ndarray] = {"action": action}
    if state is not None and reward is not None:
        looked_at = {**vars(state), "reward": reward}
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
