"""Two stages (the paper): plan in kinematics, then imitate the plan in full physics.

Stage one learns on the planning variant by PPO; the deterministic rollout of its policy is the
plan. The plan is audited and turned into a reference motion. Stage two learns to imitate the
reference motion by PPO. A third stage, off by default, fine-tunes the imitation policy on the
task's own reward.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tsbench.core.method import Problem, Workspace
from tsbench.core.motion import Plan
from tsbench.core.policy import Policy
from tsbench.core.task import plannable
from tsbench.methods import options
from tsbench.rl.stages import learn_physics, learn_planning
from tsbench.sim.episodes import PolicyFunction, play
from tsbench.sim.kinematic import Planning
from tsbench.sim.tracking import Imitation

STAGES = ("plan", "imitate", "finetune")


@dataclass(frozen=True)
class Options:
    """Attributes:
    explore: share of planning episodes that begin at sampled states instead of the start, in the
        first half of the planning budget.
    imitation: form of the imitation reward, None for the task's default.
    finetune: share of the physics budget spent on the task's own reward at the end.
    """

    explore: float = 0.75
    imitation: str | None = None
    finetune: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.explore <= 1.0:
            raise ValueError(f"explore must lie in [0, 1], not {self.explore}")
        if not 0.0 <= self.finetune < 1.0:
            raise ValueError(f"finetune must lie in [0, 1), not {self.finetune}")


def train(problem: Problem, workspace: Workspace) -> Policy:
    chosen: Options = options(Options, problem)
    task, budget = plannable(problem.task), problem.budget
    form = task.imitation_form(chosen.imitation)

    planner = learn_planning(problem, workspace, budget.plan, chosen.explore)
    plan = extract(Planning(task), planner.policy(task, "twostage"))
    plan.save(workspace.directory / "plan.npz")

    reference = task.reference(plan)
    reference.save(workspace.directory / "reference.npz")
    audit = task.audit(plan, reference)
    for item in audit.failures:
        workspace.note(f"plan audit: {item}")
    if audit.passed:
        workspace.note("plan audit: passed")

    imitation = Imitation(task, reference, form)
    finetuning = round(chosen.finetune * budget.act)
    learner = learn_physics(
        problem, workspace, "imitate", imitation, "imitate", budget.act - finetuning
    )
    if finetuning:
        learner = learn_physics(
            problem, workspace, "finetune", task, "finetune", finetuning, start_from=learner
        )
    return learner.policy(task, "twostage")


def extract(planning: Planning[Any], policy: PolicyFunction) -> Plan:
    """The plan: one deterministic episode of the planner."""
    episode = play(planning, planning, policy, 1, seed=0, record=planning.abstraction.flatten)
    length = int(episode.lengths[0])
    assert episode.states is not None
    return Plan(
        task=planning.name,
        task_version=planning.version,
        timestep=planning.timestep,
        states=episode.states[: length + 1, 0],
        rewards=episode.rewards[:length, 0],
    )
