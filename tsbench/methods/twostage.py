"""Two stages (the paper): plan in kinematics, then imitate the plan in full physics.

Stage one learns on the planning variant by PPO; the deterministic rollout of its policy is the
plan. The plan is turned into a reference motion and audited. Stage two learns to imitate the
reference motion by PPO. Two more stages are off by default: `settle` goes on imitating with other
settings, and `finetune` goes on with the task's own reward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tsbench.core.method import Problem, Workspace
from tsbench.core.motion import Plan
from tsbench.core.policy import Policy
from tsbench.methods import options, planned_task
from tsbench.rl.stages import AFTER_IMITATION, ImitationOptions, learn_imitation, learn_planning
from tsbench.sim.episodes import PolicyFunction
from tsbench.sim.kinematic import Planning, rolled_out

STAGES = ("plan", "imitate", *AFTER_IMITATION)


@dataclass(frozen=True)
class Options(ImitationOptions):
    """Attributes:
    explore: share of planning episodes that begin at sampled states instead of the start, in the
        first half of the planning budget.
    """

    explore: float = 0.75

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.explore <= 1.0:
            raise ValueError(f"explore must lie in [0, 1], not {self.explore}")


def train(problem: Problem, workspace: Workspace) -> Policy:
    chosen: Options = options(Options, problem)
    task = planned_task(problem, "twostage")
    task.imitation_form(chosen.imitation)  # refuses an unknown form before it costs a stage
    planner = learn_planning(problem, workspace, problem.budget.plan, chosen.explore)
    plan = extract(Planning(task), planner.policy(task, "twostage"))
    return learn_imitation(problem, workspace, plan, chosen).policy(task, "twostage")


def extract(planning: Planning[Any], policy: PolicyFunction) -> Plan:
    """The plan: one deterministic episode of the planner."""
    return rolled_out(planning.task, lambda state, _: policy(planning.observation(state)))
