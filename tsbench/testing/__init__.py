"""Contract tests for packages that add a task or a method. tsbench's own tests use them too.

The test file of a package with one task, which has a planning variant, and one method:

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

# It must come before the imports, or failing assertions do not show their values.
pytest.register_assert_rewrite(
    "tsbench.testing.arrays", "tsbench.testing.contracts", "tsbench.testing.episodes"
)

from tsbench.testing.arrays import ArrayContract  # noqa: E402
from tsbench.testing.contracts import MethodContract, PlanningContract, TaskContract  # noqa: E402

__all__ = ["ArrayContract", "MethodContract", "PlanningContract", "TaskContract"]
