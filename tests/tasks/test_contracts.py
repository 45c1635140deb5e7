"""The contracts of all tasks, and what `load` refuses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.motion import ReferenceMotion
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
