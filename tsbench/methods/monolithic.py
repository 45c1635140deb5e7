"""Monolithic: PPO on the task as it is, with the budget of all stages together."""

from __future__ import annotations

from dataclasses import dataclass

from tsbench.core.method import Problem, Workspace
from tsbench.core.policy import Policy
from tsbench.methods import options
from tsbench.rl.stages import learn_physics

STAGES = ("task",)


@dataclass(frozen=True)
class Options:
    """The method has no options: its PPO settings are the task's (`task.training.task`)."""


def train(problem: Problem, workspace: Workspace) -> Policy:
    options(Options, problem)
    steps = problem.budget.plan + problem.budget.act
    learner = learn_physics(problem, workspace, "train", problem.task, "task", steps)
    return learner.policy(problem.task, "monolithic")
