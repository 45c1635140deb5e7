"""What many tests share: plans and reference motions made without learning."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache

# Before numpy and torch are loaded, here and in the commands that tests start: the tests run side
# by side, and threads that wait for each other's cores slow a small network down tenfold.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

from tsbench import tasks
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.protocol import SMOKE
from tsbench.evaluation.robustness import Robustness, Surface
from tsbench.evaluation.score import Score, Summary
from tsbench.motion import Plan, ReferenceMotion
from tsbench.record import Record, Stage
from tsbench.sim.kinematic import naive_plan
from tsbench.task import plannable

# How fast a machine is, or how busy, is no property of the code.
settings.register_profile("any", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any")


@cache
def _naive_plan(name: str) -> Plan:
    return naive_plan(tasks.make(name))


@cache
def _naive_reference(name: str) -> ReferenceMotion:
    return plannable(tasks.make(name)).reference(_naive_plan(name))


@pytest.fixture(name="naive_plan", scope="session")
def naive_plan_fixture() -> Callable[[str], Plan]:
    """Of a task: the plan that its hand-made planner makes."""
    return _naive_plan


@pytest.fixture(scope="session")
def naive_reference() -> Callable[[str], ReferenceMotion]:
    """Of a task: that plan as full poses."""
    return _naive_reference


@pytest.fixture(name="invented_record", scope="session")
def invented_record_fixture() -> Callable[[str], Record]:
    """Of a task: what could be in a run's score.json, though nothing was run."""
    return _invented_record


def _invented_record(name: str) -> Record:
    task = tasks.make(name)
    nominal = Summary(
        episodes=1,
        normalized_reward=0.01,
        success=0.0,
        violations=0.25,
        steps=180.0,
        goal_distance=3.5,
    )
    score = Score(
        protocol=SMOKE.name,
        normalized_reward=0.01,
        optimality=0.125,
        success=0.0,
        nominal=nominal,
        perturbed=replace(nominal, episodes=100, steps=170.0),
        changes={"mass x 0.8": nominal},
        robustness=Robustness(
            survival_100N=0.25,
            survival_100N_interval=(0.1, 0.5),
            impulse_50=7.5,
            impulse_50_is_lower_bound=False,
            mass_scale=1.0,
            push_duration_s=0.1,
            surface=Surface(
                forces_N=(50.0, 100.0),
                headings_rad=(0.0, 1.5707963),
                phases=(30, 34, 38, 42),
                survived=(((1, 1, 1, 1), (1, 1, 1, 1)), ((1, 0, 1, 0), (0, 0, 0, 0))),
            ),
        ),
        origin=Origin.here(task, SMOKE, lambda observation: observation),
    )
    stage = Stage("plan", 1000, steps=1000, seconds=61.0)
    return Record(name, task.version, True, "twostage", 0, "smoke", score, (stage,))
