"""Finding and making tasks by name."""

from __future__ import annotations

import json
from typing import Any

import pytest

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.sim.model import fingerprint

NAMES = ("laikago_trot", "laikago_walk", "rocket_navigation", "rocket_obstacles")


def test_names() -> None:
    assert tasks.names() == NAMES
    assert tsbench.list_tasks() == NAMES
    assert tsbench.list_methods() == tuple(sorted(tsbench.list_methods()))
    assert {"monolithic", "twostage"} <= set(tsbench.list_methods())


@pytest.mark.parametrize("name", NAMES)
def test_make(name: str) -> None:
    task = tasks.make(name)
    assert task.name == name
    assert task == tasks.make(name)
    assert tasks.standard(task)
    assert fingerprint(task.spec()) == fingerprint(tasks.make(name).spec())
    half = task.constants()["distance"] / 2
    nearer = tasks.make(name, distance=half)
    assert not tasks.standard(nearer)
    assert nearer.horizon < task.horizon
    assert fingerprint(nearer.spec()) != fingerprint(task.spec())
    assert nearer.constants()["distance"] == half
    json.dumps(task.constants(), default=vars)  # they go into records


@pytest.mark.parametrize(
    ("name", "constants", "message"),
    [
        ("laikago_trott", {}, r"unknown task 'laikago_trott'; .*did you mean 'laikago_trot'\?"),
        ("", {}, r"unknown task ''; allowed: laikago_trot, laikago_walk, rocket_nav"),
        ("laikago_walk", {"distanc": 1.0}, r"unknown constant of laikago_walk 'distanc'.*distance"),
        ("laikago_walk", {"horizon": 5}, r"unknown constant of laikago_walk 'horizon'"),
    ],
)
def test_unknown_names(name: str, constants: dict[str, Any], message: str) -> None:
    with pytest.raises(TsbenchError, match=message):
        tasks.make(name, **constants)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "distance", ["a", None, [1.0], -1.0, 0.0, 1e-3, 1e300, float("inf"), "nan"]
)
def test_impossible_constants(name: str, distance: Any) -> None:
    distance = float("nan") if distance == "nan" else distance
    words = f"^(distance of {name} must be a number|{name} cannot be made with .*distance)"
    with pytest.raises(TsbenchError, match=words) as caught:
        tasks.make(name, distance=distance)
    assert "\n" not in str(caught.value)


def test_a_new_task_needs_no_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "_factories", dict(tasks._factories))
    walk = tasks._factories["laikago_walk"]
    tasks.names.cache_clear()
    try:
        assert tasks.register("stroll")(walk) is walk
        assert "stroll" in tasks.names()
        assert (
            tasks.make("stroll", distance=1.0).horizon
            == tasks.make("laikago_walk", distance=1.0).horizon
        )
        with pytest.raises(ValueError, match="'stroll' is registered already"):
            tasks.register("stroll")(walk)
    finally:
        tasks.names.cache_clear()
