"""The contracts of all tasks, and what `load` refuses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.task import plannable
from tsbench.testing import ArrayContract, PlanningContract, TaskContract
from tsbench.testing.episodes import plannable_tasks

SOME, OTHER = plannable_tasks()[:2]


class TestTasks(TaskContract):
    names = tasks.names()
    least_reward = -0.4  # two obstacle terms of 0.075 and a collision of 0.25


class TestArrays(ArrayContract):
    names = tasks.names()


class TestPlanning(PlanningContract):
    names = plannable_tasks()
    least_reward = TestTasks.least_reward


def still(array: np.ndarray) -> np.ndarray:
    """The first frame in the place of every frame."""
    return np.repeat(array[:1], len(array), axis=0)


@pytest.mark.parametrize("name", plannable_tasks())
def test_an_audit_finds_what_never_moves(
    name: str, naive_plan: Callable[[str], Plan], naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    """A plan that stays at the start, and a reference motion that does not follow its plan."""
    task, plan, motion = plannable(tasks.make(name)), naive_plan(name), naive_reference(name)
    frozen = replace(
        motion,
        qpos=still(motion.qpos),
        qvel=0.0 * motion.qvel,
        tracked={name: still(values) for name, values in motion.tracked.items()},
    )
    resting = replace(plan, states=still(plan.states))
    before = {item.what for item in task.audit(plan, motion).failures}
    for pair in ((plan, frozen), (resting, frozen), (resting, task.reference(resting))):
        assert {item.what for item in task.audit(*pair).failures} - before


def test_what_cannot_be_loaded(naive_reference: Callable[[str], ReferenceMotion]) -> None:
    with pytest.raises(TsbenchError, match=r"unknown variant 'planing'.*did you mean 'planning'"):
        tsbench.load(SOME, cast(Any, "planing"))
    with pytest.raises(TsbenchError, match="needs a reference motion"):
        tsbench.load(SOME, "imitation")
    foreign = naive_reference(OTHER)
    version = tasks.make(OTHER).version
    with pytest.raises(TsbenchError, match=f"for {OTHER} version {version}, not for {SOME}"):
        tsbench.load(SOME, "imitation", reference=foreign)
    with pytest.raises(TsbenchError, match="no perturbed starts"):
        tsbench.load(SOME, "planning", perturbed=True)
    with pytest.raises(TsbenchError, match="unknown task 'nothing'"):
        tsbench.load_batched("nothing", count=1)
