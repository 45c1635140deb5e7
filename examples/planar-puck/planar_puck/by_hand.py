"""By hand: imitate the plan of the task's hand-made planner, without learning to plan."""

from __future__ import annotations

from dataclasses import dataclass

from tsbench.core.method import Problem, Workspace
from tsbench.core.policy import Policy
from tsbench.core.task import plannable
from tsbench.methods import options
from tsbench.rl.stages import learn_physics
from tsbench.sim.kinematic import naive_plan
from tsbench.sim.tracking import Imitation

STAGES = ("imitate",)


@dataclass(frozen=True)
class Options:
    """There are none: the PPO settings are the task's (`task.training.imitate`)."""


def train(problem: Problem, workspace: Workspace) -> Policy:
    options(Options, problem)
    task = plannable(problem.task)
    plan = naive_plan(task)
    reference = task.reference(plan)
    plan.save(workspace.directory / "plan.npz")
    reference.save(workspace.directory / "reference.npz")
    imitation, steps = Imitation(task, reference), problem.budget.act
    learner = learn_physics(problem, workspace, "imitate", imitation, "imitate", steps)
    return learner.policy(task, "by_hand")
