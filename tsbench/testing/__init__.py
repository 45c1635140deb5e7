"""Contract tests for whoever adds a task or a method; tsbench's own run the same ones.

A test file of a package that brings a task with a planning variant, and a method:

from tsbench.testing import ArrayContract, MethodContract, PlanningContract, TaskContract


class TestCart(TaskContract):
    names = ("cart",)


class TestCartPlanning(PlanningContract):
    names = ("cart",)


class TestCartArrays(ArrayContract):
    names = ("cart",)


class TestLazy(MethodContract):
    names = ("lazy",)
    task = "cart"
"""

import pytest

# Before they are imported: without it their assertions do not tell what was found.
pytest.register_assert_rewrite(
    "tsbench.testing.arrays", "tsbench.testing.contracts", "tsbench.testing.episodes"
)

from tsbench.testing.arrays import ArrayContract  # noqa: E402
from tsbench.testing.contracts import MethodContract, PlanningContract, TaskContract  # noqa: E402

__all__ = ["ArrayContract", "MethodContract", "PlanningContract", "TaskContract"]
