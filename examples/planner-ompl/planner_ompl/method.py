"""OMPL: plan by a planner of the Open Motion Planning Library, then imitate the plan in physics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from ompl import base, geometric, util

from tsbench.core.errors import PlanError
from tsbench.core.method import Problem, Workspace
from tsbench.core.policy import Policy
from tsbench.core.roadmap import RoadmapSpace
from tsbench.core.task import roadmap_space
from tsbench.methods import options
from tsbench.planning.roadmap import resampled
from tsbench.rl.stages import AFTER_IMITATION, ImitationOptions, learn_imitation
from tsbench.sim.kinematic import plan_along

STAGES = ("imitate", *AFTER_IMITATION)
PLANNERS = ("BITstar", "RRTstar", "PRMstar")


@dataclass(frozen=True)
class Options(ImitationOptions):
    """RRTstar and BITstar check `edges`. PRMstar plans for `seconds`, which does not repeat."""

    planner: str = "BITstar"
    edges: int = 3000
    seconds: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.planner not in PLANNERS:
            raise ValueError(f"planner must be one of {', '.join(PLANNERS)}, not {self.planner}")


def train(problem: Problem, workspace: Workspace) -> Policy:
    chosen: Options = options(Options, problem)
    task, space = problem.task, roadmap_space(problem.task, "ompl")
    ways = Ways(space)
    # The second thread of PRMstar must not call Python, which the first one is in.
    after = base.PlannerTerminationCondition(lambda: ways.checked >= chosen.edges)
    enough = chosen.seconds if chosen.planner == "PRMstar" else after
    corners = ways.plan(chosen.planner, enough, problem.seed)
    workspace.note(f"{chosen.planner}: {ways.checked:,} edges checked; no environment steps")
    plan = plan_along(task, space, resampled(space, corners))
    return learn_imitation(problem, workspace, plan, chosen).policy(task, "ompl")


class Ways:
    """A roadmap space in units of plan steps, in which OMPL seeks the shortest way."""

    def __init__(self, space: RoadmapSpace[Any]) -> None:
        self.space, self.checked = space, 0
        self.vectors = base.RealVectorStateSpace(len(space.scale))
        bounds = base.RealVectorBounds(len(space.scale))
        for i, scale in enumerate(space.scale):
            bounds.setLow(i, float(space.low[i] / scale))
            bounds.setHigh(i, float(space.high[i] / scale))
        self.vectors.setBounds(bounds)

    def plan(self, planner: str, enough: Any, seed: int) -> np.ndarray:
        """The corners (k, d) of a way, found in `enough` seconds or until it is true."""
        util.noOutputHandler()
        util.RNG.setSeed(seed + 1)  # 0 stands for the clock
        information = base.SpaceInformation(self.vectors)
        information.setStateValidityChecker(lambda at: self.free(at, at))
        information.setMotionValidator(Motion(self, information))
        setup = geometric.SimpleSetup(information)
        setup.setStartAndGoalStates(self.state(self.space.start), self.state(self.space.goal))
        setup.setOptimizationObjective(base.PathLengthOptimizationObjective(information))
        setup.setPlanner(getattr(geometric, planner)(information))
        setup.solve(enough)
        if not setup.haveExactSolutionPath():
            more = "method.seconds" if planner == "PRMstar" else "method.edges"
            raise PlanError(f"{planner} found no way to the goal: more {more} are needed")
        return np.array([self.point(at) for at in setup.getSolutionPath().getStates()])

    def free(self, first: Any, second: Any) -> bool:
        return bool(self.space.free(self.point(first)[None], self.point(second)[None])[0])

    def point(self, at: Any) -> np.ndarray:
        return np.array([at[i] for i in range(len(self.space.scale))]) * self.space.scale

    def state(self, point: np.ndarray) -> Any:
        state = self.vectors.allocState()
        for i, scale in enumerate(self.space.scale):
            state[i] = float(point[i] / scale)
        return state


class Motion(base.MotionValidator):  # asks the roadmap space
    def __init__(self, ways: Ways, information: Any) -> None:
        super().__init__(information)
        self.ways = ways

    def checkMotion(self, first: Any, second: Any, _: Any = None) -> bool:  # noqa: N802
        self.ways.checked += 1
        return self.ways.free(first, second)
