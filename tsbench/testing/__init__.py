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

from importlib import import_module
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from tsbench.testing.arrays import ArrayContract
    from tsbench.testing.contracts import MethodContract, PlanningContract, TaskContract

# It must come before their imports, or failing assertions do not show their values.
pytest.register_assert_rewrite(
    "tsbench.testing.arrays", "tsbench.testing.contracts", "tsbench.testing.episodes"
)

__all__ = ["ArrayContract", "MethodContract", "PlanningContract", "TaskContract"]


def __getattr__(name: str) -> Any:
    """Imports a contract when it is asked for: they need dm_control, and `engines` does not."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    part = "arrays" if name == "ArrayContract" else "contracts"
    return getattr(import_module(f"{__name__}.{part}"), name)
