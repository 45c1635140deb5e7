"""The stages that methods are made of: PPO on a task, on its imitation, on its planning variant.

They learn on the problem's device, of which methods need not know.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

from tsbench.core.errors import PlanError, TsbenchError
from tsbench.core.method import AUDITS, Monitor, Problem, Workspace
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.task import SimulatedTask, plannable
from tsbench.core.typed import typed_items
from tsbench.rl import processes
from tsbench.rl.devices import CPU, torch_device, working_on
from tsbench.rl.ppo import Learner, Report
from tsbench.rl.settings import AFTER_IMITATION as AFTER_IMITATION  # methods use it too
from tsbench.rl.settings import PPOSettings, environments
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.device import DeviceDynamics, DeviceEnvironment, DeviceKinematics
from tsbench.sim.disturbed import Disturbances, DisturbedPhysics
from tsbench.sim.kinematic import Planning
from tsbench.sim.physics import Physics
from tsbench.sim.tracking import Imitation

Environment = BatchedEnvironment[Any] | DeviceEnvironment[Any]


@dataclass(frozen=True)
class StageSettings(PPOSettings):
    """Attributes:
    disturb: random disturbances of the physics in training.
    """

    disturb: Disturbances = field(default_factory=Disturbances)


def settings(problem: Problem, kind: str) -> StageSettings:
    """The settings of a kind of stage.

    Kinds are the names that methods give in their `STAGES`. Three have rules of their own: `plan`
    has no physics that could be disturbed, and `settle` and `finetune` begin with the settings of
    `imitate`. Off the CPU and in several processes `update: auto` is rsl-rl's own update.

    Raises:
        TsbenchError: unknown names or values of the wrong type or range.
    """
    changes = _changes(problem, kind)
    changes["environments"] = environments(changes, problem.budget.environments)
    disturb = changes.get("disturb", Disturbances())
    if kind == "plan" and disturb != Disturbances():
        raise TsbenchError("task.training.plan.disturb: planning has no physics to disturb")
    if disturb != Disturbances() and disturb.interval < problem.task.timestep:
        step = f"a control step of {problem.task.timestep:.3g} s"
        raise TsbenchError(f"task.training.{kind}.disturb.interval must be at least {step}")
    if problem.device != CPU or processes.count() > 1:
        if changes.get("update") == "numpy":
            where = f"on {problem.device}" if problem.device != CPU else "in several processes"
            raise TsbenchError(
                f"task.training.{kind}.update: numpy works in one process on the CPU, not {where}"
            )
        changes["update"] = "rsl_rl"
    try:
        return StageSettings(**changes)
    except ValueError as error:
        raise TsbenchError(f"task.training.{kind}.{error}") from None


def _changes(problem: Problem, kind: str) -> dict[str, Any]:
    """The settings that differ from the defaults. The stages after `imitate` continue with its
    policy, so their settings are changes to those of `imitate`, with the same network. Their pushes
    start at full size, which those of the imitation stage have reached."""
    given, path = problem.training.get(kind, {}), f"task.training.{kind}"
    changes = typed_items(StageSettings, given, path)
    if kind not in AFTER_IMITATION:
        return changes
    before = _changes(problem, "imitate")
    for name in ("hidden", "activation", "encoding"):
        imitated = before.get(name, getattr(StageSettings, name))
        if changes.get(name, imitated) != imitated:
            raise TsbenchError(
                f"{path}.{name} must be that of imitate, whose policy the stage goes on with: "
                f"{imitated}"
            )
    other = typed_items(Disturbances, given.get("disturb", {}), f"{path}.disturb")
    disturb: Disturbances = before.get("disturb", Disturbances())
    try:
        disturb = replace(disturb, **{"rise": 0, **other})
    except ValueError as error:
        raise TsbenchError(f"{path}.disturb.{error}") from None
    return {**before, **changes, "disturb": disturb}


def learn_planning(
    problem: Problem, workspace: Workspace, steps: int, explore: float = 0.0
) -> Learner:
    """PPO on the planning variant. `explore` is that of `Planning` and applies to iterations that
    begin in the first half of the steps.

    Sampled starts yield rewards near the goal before the planner knows the way there. The second
    half trains on the task's own start only, from which the plan is made.
    """
    chosen = settings(problem, "plan")
    planning: Planning[Any] = Planning(problem.task, explore=explore)

    def prepare(taken: int) -> None:
        planning.explore = explore if taken < steps // 2 else 0.0

    device = torch_device(problem.device)
    with working_on(device, deterministic=problem.deterministic):
        environment = planning_environment(problem, planning, chosen.environments)
        with workspace.stage("plan", steps) as monitor:
            learner = Learner(environment, chosen, problem.seed)
            learner.learn(steps, _reporting(learner, monitor), prepare)
    return learner


def learn_physics(
    problem: Problem,
    workspace: Workspace,
    name: str,
    task: SimulatedTask[Any],
    kind: str,
    steps: int,
    start_from: Learner | None = None,
) -> Learner:
    """PPO on a task in full physics, or on its imitation variant, under the disturbances that the
    stage's settings ask for."""
    chosen = settings(problem, kind)
    device = torch_device(problem.device)
    with working_on(device, deterministic=problem.deterministic):
        environment = physics_environment(problem, task, chosen)
        with workspace.stage(name, steps) as monitor:
            learner = Learner(environment, chosen, problem.seed, start_from)
            physics: Any = environment.dynamics
            learner.learn(steps, _reporting(learner, monitor, physics))
    return learner


def planning_environment(problem: Problem, planning: Planning[Any], count: int) -> Environment:
    """`count` episodes of the planning variant on the problem's device."""
    seed = processes.own(problem.seed)
    if problem.device == CPU:
        return BatchedEnvironment(planning, planning, count, seed)
    device = torch_device(problem.device)
    dynamics = DeviceKinematics(planning, count, seed, device)
    return DeviceEnvironment(planning, dynamics, count, seed, device)


def physics_environment(
    problem: Problem, task: SimulatedTask[Any], chosen: StageSettings
) -> Environment:
    """Episodes of a task in full physics on the problem's device, disturbed as `chosen` says."""
    count, seed = chosen.environments, processes.own(problem.seed)
    # The physics counts the steps of its own process, and `rise` those of all.
    disturb = replace(chosen.disturb, rise=chosen.disturb.rise // processes.count())
    if problem.device == CPU:
        physics: Physics[Any] = DisturbedPhysics(
            task, count, disturb, seed, threads=problem.threads
        )
        return BatchedEnvironment(task, physics, count, seed)
    device = torch_device(problem.device)
    dynamics: DeviceDynamics[Any] = import_module("tsbench.sim.warp").WarpPhysics(  # of an extra
        task,
        count,
        device=device,
        disturbances=disturb,
        seed=seed,
        threads=problem.threads,
        deterministic=problem.deterministic,
    )
    return DeviceEnvironment(task, dynamics, count, seed, device)


@dataclass(frozen=True)
class ImitationOptions:
    """Options of a method that imitates a plan.

    Attributes:
        imitation: form of the imitation reward, None for the task's default.
        settle: share of the physics budget spent on further imitation with the settings of
            `settle`, such as milder disturbances.
        finetune: share of the physics budget spent on the task's own reward at the end.
        audit: what a plan that fails its audit does: "stop" ends the run, "warn" goes on; None for
            what the budget says.
    """

    imitation: str | None = None
    settle: float = 0.0
    finetune: float = 0.0
    audit: str | None = None

    def __post_init__(self) -> None:
        for name in AFTER_IMITATION:
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} must lie in [0, 1), not {getattr(self, name)}")
        if self.settle + self.finetune >= 1.0:
            raise ValueError("settle and finetune must leave a share of the budget to imitate with")
        if self.audit not in (None, *AUDITS):
            raise ValueError(f"audit must be stop, warn or null, not {self.audit}")


def learn_imitation(
    problem: Problem, workspace: Workspace, plan: Plan, options: ImitationOptions
) -> Learner:
    """Turns a plan into a reference motion, audits both, and learns to imitate the motion by PPO,
    with the whole physics budget. Saves `plan.npz` and `reference.npz`.

    Raises:
        TsbenchError: the task has no planning variant, or no such form of the imitation reward.
        PlanError: the plan fails its audit, and that stops the run.
    """
    task, act = plannable(problem.task), problem.budget.act
    plan.save(workspace.directory / "plan.npz")
    reference = task.reference(plan)
    reference.save(workspace.directory / "reference.npz")
    _audit(problem, workspace, plan, reference, options.audit or problem.budget.audit)
    imitation = Imitation(task, reference, options.imitation)
    settling, finetuning = round(options.settle * act), round(options.finetune * act)
    learner = learn_physics(
        problem, workspace, "imitate", imitation, "imitate", act - settling - finetuning
    )
    further = (("settle", imitation, settling), ("finetune", task, finetuning))
    for name, mdp, steps in further:
        if steps:
            learner = learn_physics(problem, workspace, name, mdp, name, steps, learner)
    return learner


def _audit(
    problem: Problem, workspace: Workspace, plan: Plan, reference: ReferenceMotion, failed: str
) -> None:
    audit = plannable(problem.task).audit(plan, reference)
    if audit.passed:
        workspace.note("plan audit: passed")
    elif failed == "warn":
        for item in audit.failures:
            workspace.note(f"plan audit: {item}")
    else:
        found = "; ".join(map(str, audit.failures))
        raise PlanError(
            f"the plan fails its audit: {found}; plan more steps, or go on with method.audit=warn"
        )


def _reporting(
    learner: Learner,
    monitor: Monitor,
    physics: Physics[Any] | DeviceDynamics[Any] | None = None,
) -> Report:
    """Restores the learner of an interrupted run, if there is one, and returns the function that
    reports iterations."""
    if monitor.saved is not None:
        learner.restore(monitor.saved)

    def report(steps: int, metrics: Mapping[str, float]) -> None:
        if physics is not None:
            monitor.physics_substeps = physics.substeps
            monitor.warnings = physics.warned()
        monitor.update(steps, metrics, learner.snapshot)

    return report
