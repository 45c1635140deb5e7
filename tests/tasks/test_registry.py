"""Finding and making tasks by name."""

from __future__ import annotations

from typing import Any

import pytest

import tsbench
from tsbench import TsbenchError, tasks

SOME = tasks.names()[0]
# The tasks that have the constant `distance`.
FAR = [name for name in tasks.names() if "distance" in tasks.defaults(name)]


def test_names() -> None:
    assert tasks.names()
    assert tasks.names() == tuple(sorted(set(tasks.names()))) == tsbench.list_tasks()
    assert tsbench.list_methods() == tuple(sorted(set(tsbench.list_methods())))
    assert not tasks.refused()


def test_what_does_not_exist() -> None:
    with pytest.raises(TsbenchError, match=rf"'{SOME}x'; .*did you mean '{SOME}'\?"):
        tasks.make(f"{SOME}x")
    with pytest.raises(TsbenchError, match=rf"unknown task ''; allowed: {SOME}, "):
        tasks.make("")
    assert tasks.provider("") is None


@pytest.mark.parametrize("name", FAR)
def test_constants_that_do_not_exist(name: str) -> None:
    with pytest.raises(TsbenchError, match=rf"unknown constant of {name} 'distanc'.*distance"):
        tasks.make(name, distanc=1.0)
    with pytest.raises(TsbenchError, match=rf"unknown constant of {name} 'horizon'"):
        tasks.make(name, horizon=5)
    with pytest.raises(TsbenchError, match=rf"unknown constant of {name} 'name'"):
        tasks.make(name, name="foo")
    with pytest.raises(TsbenchError, match=rf"unknown constant of {name} 'name'"):
        tasks.checked(name, name="foo")


@pytest.mark.parametrize("name", FAR)
def test_a_nearer_goal(name: str) -> None:
    task = tasks.make(name)
    half = task.constants()["distance"] / 2
    nearer = tasks.make(name, distance=half)
    assert nearer.horizon < task.horizon
    assert nearer.constants()["distance"] == half


@pytest.mark.parametrize("name", FAR)
@pytest.mark.parametrize(
    "distance", ["a", None, [1.0], -1.0, 0.0, 1e-3, 1e300, float("inf"), "nan"]
)
def test_impossible_constants(name: str, distance: Any) -> None:
    distance = float("nan") if distance == "nan" else distance
    words = f"^(distance of {name} must be a number|{name} cannot be made with .*distance)"
    with pytest.raises(TsbenchError, match=words) as caught:
        tasks.make(name, distance=distance)
    assert "\n" not in str(caught.value)


def test_a_task_that_cannot_be_made_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "_factories", dict(tasks._factories))

    def sunk(depth: float = 1.0) -> Any:
        raise ValueError("it has sunk")

    tasks.register("sunk")(sunk)
    with pytest.raises(TsbenchError, match=r"^sunk cannot be made: it has sunk$"):
        tasks.make("sunk")
    with pytest.raises(TsbenchError, match=r"^sunk cannot be made with \{'depth': 2.0\}: it has"):
        tasks.make("sunk", depth=2.0)


def test_a_constant_that_is_true_or_false(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "_factories", dict(tasks._factories))
    made: list[bool] = []

    def walled(walls: bool = True) -> Any:
        made.append(walls)

    tasks.register("walled")(walled)
    tasks.make("walled", walls=False)
    assert made == [False]
    with pytest.raises(TsbenchError, match=r"^walls of walled must be true or false, not 1$"):
        tasks.make("walled", walls=1)


def test_a_new_task_needs_no_list(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "stroll" not in tasks.names()
    monkeypatch.setattr(tasks, "_factories", dict(tasks._factories))

    def stroll() -> Any:
        return tasks.make(SOME)

    assert tasks.register("stroll")(stroll) is stroll
    assert "stroll" in tasks.names()
    assert tasks.make("stroll") == tasks.make(SOME)
    assert tasks.provider("stroll") is None  # no installed package brings it
    with pytest.raises(ValueError, match="'stroll' is registered already"):
        tasks.register("stroll")(stroll)
