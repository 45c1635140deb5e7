"""PRM (the paper's baseline): plan by a probabilistic roadmap, then imitate the plan in physics.

The roadmap (`tsbench.planning.roadmap`) knows the planning variant's speed limits and where it may
move, but neither its reward nor, if it is blind, the robot's gait. A layered roadmap keeps to the
gait and goes for the reward. The imitation is that of the method twostage.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tsbench.core.errors import TsbenchError
from tsbench.core.method import Problem, Workspace
from tsbench.core.motion import Plan
from tsbench.core.policy import Policy
from tsbench.core.task import Task, plannable, roadmap_space
from tsbench.methods import options, planned_task
from tsbench.planning.roadmap import cycled, expect_size, find_route
from tsbench.rl.stages import AFTER_IMITATION, ImitationOptions, learn_imitation
from tsbench.sim.kinematic import plan_along, rolled_out

STAGES = ("imitate", *AFTER_IMITATION)
ROADMAPS = ("blind", "layered")


@dataclass(frozen=True)
class Options(ImitationOptions):
    """Attributes:
    roadmap: "blind", whose points know nothing of the task's gait (the paper's), or "layered" by
        the phase of the gait, which needs no samples.
    samples: Halton samples of a blind roadmap, at most `roadmap.MOST_SAMPLES`.
    neighbours: nearest samples that each of them is joined to; samples times neighbours may be
        `roadmap.MOST_PAIRS`.
    shortcut: whether the way through a blind roadmap is straightened; the paper's is not.
    """

    audit: str | None = "warn"
    roadmap: str = "blind"
    samples: int = 2000
    neighbours: int = 16
    shortcut: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.roadmap not in ROADMAPS:
            raise ValueError(f"roadmap must be one of {', '.join(ROADMAPS)}, not {self.roadmap}")
        expect_size(self.samples, self.neighbours)


def train(problem: Problem, workspace: Workspace) -> Policy:
    chosen: Options = options(Options, problem)
    task = planned_task(problem, "prm")
    space = roadmap_space(task, "prm")
    task.imitation_form(chosen.imitation)  # refuses an unknown form before the planning
    if chosen.roadmap == "layered":
        plan = layered_plan(task)
    else:
        route = find_route(
            space, chosen.samples, chosen.neighbours, problem.seed, shortcut=chosen.shortcut
        )
        plan = plan_along(task, space, route.points)
        route.drawn(space, plan).save(workspace.directory / "roadmap.npz")
        workspace.note(
            f"roadmap: {chosen.samples:,} samples, {route.graph.checked:,} edges checked, "
            f"{len(route.graph.edges):,} of them free; no environment steps"
        )
    return learn_imitation(problem, workspace, plan, chosen).policy(task, "prm")


def layered_plan(task: Task[Any]) -> Plan:
    """
    Raises:
        TsbenchError: the task has no gait whose phase could make layers.
    """
    abstraction = plannable(task).abstraction()
    lattice = abstraction.lattice()
    if lattice is None:
        raise TsbenchError(f"method.roadmap: {task.name} has no gait for a layered roadmap")
    actions = cycled(lattice, abstraction.horizon)
    return rolled_out(task, lambda _, step: actions[step : step + 1])
