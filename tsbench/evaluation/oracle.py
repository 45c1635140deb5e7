"""The oracle: what is reachable on a task."""

from __future__ import annotations

from typing import Any

import numpy as np

from tsbench.task import Task


def best_return(task: Task[Any]) -> float:
    """The return of `Task.ideal`, the best motion known under the planner's speed limits, since
    no motion earns the largest conceivable reward at every step. A policy in full physics, which
    those limits do not bind, may earn more."""
    states = task.ideal()
    before, after = states.rows(slice(0, -1)), states.rows(slice(1, None))
    rewards = task.reward(before, np.zeros((task.horizon, task.action_size)), after)
    course = task.begun(states.rows(slice(0, 1)))
    for step in range(task.horizon):
        previous, state = (one.rows(slice(step, step + 1)) for one in (before, after))
        course = task.followed(course, previous, state)
        if task.terminal(state)[0]:
            spared = task.spared(state, course)
            credit = task.credit(spared, task.quality(course))
            return float(rewards[: step + 1].sum()) + float(credit[0])
    return float(rewards.sum())
