"""The oracle: what a motion would earn if the robot could follow it exactly, and the best known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tsbench.core.state import State
from tsbench.core.task import Task


@dataclass(frozen=True)
class Outcome:
    """Of one episode.

    Attributes:
        earned: its return.
        normalized: that over the largest conceivable one.
        solved: by `Task.success`.
        measures: `Task.measures`; None for what it has none of.
    """

    earned: float
    normalized: float
    solved: bool
    measures: dict[str, float | None]


def outcome(task: Task[Any], states: State, actions: np.ndarray | None = None) -> Outcome:
    """What an episode through given states is worth, up to where the task ends it.

    Args:
        task: that judges.
        states: one per control step from the start, time as the batch axis, n + 1 of them.
        actions: that led through them, shape (n, action_size); None where nothing acted, as along
            a plan, and then `measures` lacks what needs actions.
    """
    first = states.rows(slice(0, 1))
    before, after = states.rows(slice(0, -1)), states.rows(slice(1, None))
    steps = len(after.time)
    acted = np.zeros((steps, task.action_size)) if actions is None else actions
    rewards = task.reward(before, acted, after)
    course, spared = task.begun(first), np.zeros(1)
    for step in range(steps):
        previous, last = (one.rows(slice(step, step + 1)) for one in (before, after))
        course = task.followed(course, previous, last)
        if task.terminal(last)[0]:
            steps, spared = step + 1, task.spared(last, course)
            break
    gone = slice(0, steps)
    earned = rewards[gone].sum() + task.credit(spared, task.quality(course))[0]
    sums = task.measured(
        before.rows(gone), None if actions is None else acted[gone], after.rows(gone)
    )
    totals = {name: values.sum(keepdims=True) for name, values in sums.items()}
    found = task.measures(first, last, course, totals, np.array([steps]))
    return Outcome(
        earned=float(earned),
        normalized=float(earned) / (task.max_reward * task.horizon),
        solved=bool(task.success(last, course)[0]),
        measures={name: known_mean(values) for name, values in found.items()},
    )


def best_return(task: Task[Any]) -> float:
    """The return of `Task.ideal`, the best motion known under the planner's speed limits, since
    no motion earns the largest conceivable reward at every step. A policy in full physics, which
    those limits do not bind, may earn more."""
    return outcome(task, task.ideal()).earned


def known_mean(values: np.ndarray) -> float | None:
    """Over the finite ones; None where there are none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
