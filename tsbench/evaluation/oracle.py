"""The oracle: the return of a given motion, as if physics followed it exactly, and the best return
known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tsbench.core.state import State
from tsbench.core.task import Task


@dataclass(frozen=True)
class Outcome:
    """The outcome of one episode.

    Attributes:
        earned: the return.
        normalized: the return over the largest conceivable return.
        solved: whether the episode was solved (`Task.success`).
        measures: the figures of `Task.measures`; None for a figure that the episode lacks.
    """

    earned: float
    normalized: float
    solved: bool
    measures: dict[str, float | None]


def outcome(task: Task[Any], states: State, actions: np.ndarray | None = None) -> Outcome:
    """The outcome of an episode through given states, up to the step at which the task ends it.

    Args:
        task: the task that rewards and judges the states.
        states: n + 1 states, one per control step from the start, with time as the batch axis.
        actions: the actions between the states, shape (n, action_size). None for a plan, which has
            no actions; `measures` then lacks the figures that need actions.
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
    """The return of `Task.ideal`, the best motion known under the planner's speed limits.

    No motion earns the largest conceivable reward at every step, so this return is a fairer scale.
    The limits do not bind a policy in full physics, which may earn more.
    """
    return outcome(task, task.ideal()).earned


def known_mean(values: np.ndarray) -> float | None:
    """The mean of the finite values; None if no value is finite."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
