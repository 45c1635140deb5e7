"""Random search: try linear policies near the best one so far, and keep what earns more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tsbench.core.method import Problem, Workspace
from tsbench.core.policy import Policy, PolicyInfo
from tsbench.core.task import Task
from tsbench.methods import options
from tsbench.sim.episodes import play
from tsbench.sim.model import fingerprint
from tsbench.sim.physics import Physics


@dataclass(frozen=True)
class Options:
    spread: float = 0.3  # of a new policy's weights around the best ones
    episodes: int = 8  # that judge a policy, from perturbed starts


def train(problem: Problem, workspace: Workspace) -> Policy:
    chosen: Options = options(Options, problem)
    task, rng = problem.task, np.random.default_rng(problem.seed)
    physics = Physics(task, chosen.episodes, threads=problem.threads, perturbed=True)
    best, most, steps = np.zeros((task.action_size, task.observation_size + 1)), -np.inf, 0
    budget, trial = problem.budget.plan + problem.budget.act, chosen.episodes * task.horizon
    with workspace.stage("search", budget) as monitor:
        while steps + trial <= budget:
            weights = best + chosen.spread * rng.normal(size=best.shape)
            policy = linear(task, weights)
            episodes = play(task, physics, policy, chosen.episodes, problem.seed)
            if (mean := float(episodes.returns.mean())) > most:
                best, most = weights, mean
            steps += int(episodes.lengths.sum())
            monitor.physics_substeps = physics.substeps
            monitor.update(steps, {"episode_return": most})
    return linear(task, best)


def linear(task: Task[Any], weights: np.ndarray) -> Policy:
    """The policy with these weights and biases, shape (actions, observations + 1)."""
    layers = (task.observation_size, task.action_size)
    physics, name = fingerprint(task.spec()), "random_search"
    info = PolicyInfo(task.name, task.version, physics, name, activation="tanh", layers=layers)
    mean, scale = np.zeros(layers[0], np.float32), np.ones(layers[0], np.float32)
    weight, bias = weights[:, :-1].astype(np.float32), weights[:, -1].astype(np.float32)
    return Policy(info, mean, scale, (weight,), (bias,))
