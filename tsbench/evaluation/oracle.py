"""The oracle: what is reachable on a task."""

from __future__ import annotations

from typing import Any

import numpy as np

from tsbench.core.task import Task


def best_return(task: Task[Any]) -> float:
    """The return of `Task.ideal`, the best motion known under the planner's speed limits, since
    no motion earns the largest conceivable reward at every step. A policy in full physics, which
    those limits do not bind, may earn more."""
    states = task.ideal()
    before, after = states.rows(slice(0, -1)), states.rows(slice(1, None))
    rewards = task.reward(before, np.zeros((task.horizon, task.action_size)), after)
    violated = np.logical_or.accumulate(task.violated(after))
    ends = task.terminal(after)
    if not ends.any():
        return float(rewards.sum())
    last = int(np.argmax(ends))
    spared = task.spared(after, violated)[last]
    return float(rewards[: last + 1].sum()) + float(task.credit(spared))
