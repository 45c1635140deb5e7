"""What tsbench asks of every method, and that OMPL's ways are legal and short."""

from typing import ClassVar

import numpy as np
import pytest
from ompl import base
from planner_ompl.method import PLANNERS, Ways

from tsbench import tasks
from tsbench.core.task import plannable, roadmap_space
from tsbench.planning.roadmap import resampled
from tsbench.sim.kinematic import plan_along
from tsbench.testing import MethodContract


class TestOmpl(MethodContract):
    names = ("ompl",)
    task = "rocket_obstacles"
    constants: ClassVar[dict[str, float]] = {"distance": 20.0}


@pytest.mark.parametrize("planner", PLANNERS)
def test_its_plan_passes_the_audit(planner: str) -> None:
    task = plannable(tasks.make("rocket_obstacles"))
    space = roadmap_space(task, "ompl")
    ways = Ways(space)
    after = base.PlannerTerminationCondition(lambda: ways.checked >= 1500)
    corners = ways.plan(planner, 1.0 if planner == "PRMstar" else after, seed=0)
    assert space.free(corners[:-1], corners[1:]).all()
    best = space.steps(space.start, space.goal)
    assert best <= space.steps(corners[:-1], corners[1:]).sum() <= 1.05 * best
    plan = plan_along(task, space, resampled(space, corners))
    assert task.audit(plan, task.reference(plan)).passed
    np.testing.assert_allclose(plan.states[-1, :2], space.goal, atol=1e-6)
