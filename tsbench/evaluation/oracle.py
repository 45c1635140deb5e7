"""The oracle: what is reachable on a task."""

from __future__ import annotations

from typing import Any

import numpy as np

from tsbench.mdp import Task


def best_return(task: Task[Any]) -> float:
    """The return of `Task.ideal`, the best motion known under the planner's speed limits, since
    no motion earns the largest conceivable reward at every step. A policy in full physics, which
    those limits do not bind, may earn more."""
    states = task.ideal()
    before, after = states.rows(slice(0, -1)), states.rows(slice(1, None))
    rewards = task.reward(before, np.zeros((task.horizon, task.action_size)), after)
    length = int(np.argmax([*task.terminal(after), True])) + 1
    credit = (task.horizon - length) * task.max_reward if length <= task.horizon else 0.0
    return float(rewards[:length].sum()) + credit
