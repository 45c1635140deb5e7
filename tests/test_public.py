"""What a user's editor and type checker see of the package."""

from __future__ import annotations

from typing import Any, assert_type

import pytest

import tsbench
import tsbench.gym
from tsbench import TsbenchError

PUBLIC = {"TsbenchError", "evaluate", "list_methods", "list_tasks", "load", "load_batched"}


def test_the_public_names() -> None:
    """Completion shows them, and nothing that the package itself imports."""
    assert set(dir(tsbench)) == PUBLIC | {"__version__"}
    names: dict[str, Any] = {}
    exec("from tsbench import *", names)
    assert names.keys() - {"__builtins__"} == PUBLIC


def test_every_public_name_explains_itself() -> None:
    for name in PUBLIC:
        thing = getattr(tsbench, name)
        assert thing.__doc__
        assert thing.__module__.startswith("tsbench")


def test_results_have_types_and_a_wrong_argument_is_found() -> None:
    """`make check` has mypy read this test, and a user's checker reads the package too, which holds
    py.typed (tests/test_packaging.py). mypy refuses an ignore that it does not need, so the one
    below fails the check if the wrong argument is not found."""
    assert_type(tsbench.list_tasks(), tuple[str, ...])
    assert_type(tsbench.load_batched("laikago_trot", count=2).count, int)
    assert_type(tsbench.gym.make("laikago_trot").render_mode, str | None)
    assert_type(tsbench.evaluate("zero", "rocket_navigation", protocol="smoke").success, float)
    with pytest.raises(TsbenchError, match="seed must be a whole number or None"):
        tsbench.load("laikago_trot", seed="five")  # type: ignore[arg-type]
