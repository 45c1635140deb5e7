"""What many tests share: plans and reference motions made without learning."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache

# Before numpy and torch are loaded, here and in the commands that tests start: the tests run side
# by side, and threads that wait for each other's cores slow a small network down tenfold.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

from tsbench import tasks
from tsbench.motion import Plan, ReferenceMotion
from tsbench.sim.kinematic import naive_plan

# How fast a machine is, or how busy, is no property of the code.
settings.register_profile("any", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any")


@cache
def _naive_plan(name: str) -> Plan:
    return naive_plan(tasks.make(name))


@cache
def _naive_reference(name: str) -> ReferenceMotion:
    return tasks.make(name).reference(_naive_plan(name))


@pytest.fixture(name="naive_plan", scope="session")
def naive_plan_fixture() -> Callable[[str], Plan]:
    """Of a task: the plan that its hand-made planner makes."""
    return _naive_plan


@pytest.fixture(scope="session")
def naive_reference() -> Callable[[str], ReferenceMotion]:
    """Of a task: that plan as full poses."""
    return _naive_reference
