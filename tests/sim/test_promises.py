"""What a task promises: one line for each way to break it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import mujoco
import numpy as np
import pytest

from tsbench import TsbenchError, tasks
from tsbench.core.task import Plant
from tsbench.sim.promises import check_promises
from tsbench.tasks.rocket import Rocket, rocket_navigation


def rocket(**parts: Any) -> Rocket:
    """A rocket with changed attributes and functions."""
    made: Rocket = type("Broken", (Rocket,), parts)(**vars(rocket_navigation(10.0)))
    return made


def test_the_rocket_keeps_its_promises() -> None:
    check_promises("rocket_navigation", rocket())


def one_engine(self: Rocket) -> mujoco.MjSpec:
    spec = Rocket.spec(self)
    spec.delete(spec.actuators[-1])
    return spec


def broken_model(self: Rocket) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string("<mujoco><worldbod></mujoco>")


def short_start(self: Rocket, *arguments: Any, **options: Any) -> Any:
    start = Rocket.start(self, *arguments, **options)
    return replace(start, qpos=start.qpos[:, :1])


def flat_memory(self: Rocket, *arguments: Any, **options: Any) -> Any:
    start = Rocket.start(self, *arguments, **options)
    return replace(start, memory=start.time)


def short_ideal(self: Rocket) -> Any:
    states = Rocket.ideal(self)
    return replace(states, **{part.name: getattr(states, part.name)[1:] for part in fields(states)})


def planner(**parts: Any) -> Callable[[Rocket], Any]:
    """A function that returns the rocket's planning variant with changed parts."""

    def abstraction(self: Rocket) -> Any:
        made = Rocket.abstraction(self)
        for name, value in parts.items():
            setattr(made, name, value)
        return made

    return abstraction


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        ({"spec": one_engine}, r"control \(.*in the model 1\) has the shape \(3, 2\) .* \(3, 1\)"),
        (
            {"action_size": 3, "control": Plant.control},
            r"control \(action_size 3, actuators in the model 2\) has the shape \(3, 3\)",
        ),
        ({"pushed": "rockte"}, r"unknown body `pushed` of .* 'rockte'.*did you mean 'rocket'\?"),
        ({"spec": broken_model}, r"spec fails with ValueError: XML"),
        ({"substeps": 4}, r"4 substeps of .* s take .* s, but its timestep is"),
        ({"start": short_start}, r"qpos of a start has the shape \(3, 1\) for 3 states"),
        ({"start": flat_memory}, r"the memory of a start has the shape \(3,\)"),
        ({"control": lambda self, state, action: action}, r"control returns no pair"),
        (
            {"control": lambda self, state, action: (action, np.zeros((3, 1)))},
            r"the memory that control returns has the shape \(3, 1\)",
        ),
        ({"observation_size": 4}, r"observation \(observation_size 4\) has the shape \(3, 10\)"),
        (
            {"reward": lambda self, previous, action, state: state.time[..., None]},
            r"reward has the shape \(3, 1\) for 3 states, not \(3,\)",
        ),
        (
            {"reward": lambda self, previous, action, state: np.nan * state.time},
            r"reward is not finite",
        ),
        (
            {"reward": lambda self, previous, action, state: 1.0},
            r"reward is of type float, not an array",
        ),
        (
            {"reward": lambda self, previous, action, state: state.nothing},
            r"reward fails with AttributeError: .*nothing.* \(test_promises.py, line \d+\)",
        ),
        (
            {"terminal": lambda self, state: 0.0 * state.time},
            r"terminal is of type float64, not bool",
        ),
        ({"success": lambda self, state, course: True}, r"success is of type bool, not an array"),
        ({"success": lambda self, state, course: 1 / 0}, r"success fails with ZeroDivisionError: "),
        (
            {"reward": lambda self, previous, action, state: 1.5 + 0.0 * state.time},
            r"reward is 1\.5, above its max_reward of 0\.9$",
        ),
        ({"max_reward": None}, r"max_reward fails with TypeError"),
        ({"max_reward": 0.0}, r"max_reward is 0, which normalises no reward$"),
        ({"max_reward": np.nan}, r"max_reward is nan, which normalises no reward$"),
        ({"push_steps": (3.0, 9.5)}, r"push_steps fails with TypeError"),
        ({"push_steps": ()}, r"push_steps are \(\), not one or more rising steps from 0 to \d+$"),
        ({"push_steps": (0, 10**6)}, r"push_steps are \(0, 1000000\), not"),
        ({"push_steps": (9, 3)}, r"push_steps are \(9, 3\), not"),
        ({"push_steps": 3}, r"push_steps fails with TypeError"),
        ({"ideal": short_ideal}, r"ideal has times of the shape \((\d+),\); states needed: \d+, "),
        ({"ideal": lambda self: None}, r"ideal fails with AttributeError"),
        (
            {"abstraction": planner(observation_size=1)},
            r"observation of the planning variant \(observation_size 1\)",
        ),
        ({"abstraction": planner(coordinates=("x",))}, r"flatten has the shape"),
        (
            {"abstraction": planner(naive=lambda state: state.time)},
            r"naive has the shape \(3,\) for 3 states",
        ),
    ],
)
def test_a_broken_promise_is_one_line(parts: dict[str, Any], line: str) -> None:
    with pytest.raises(TsbenchError, match=line) as caught:
        check_promises("rocket_navigation", rocket(**parts))
    assert "rocket_navigation" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_what_is_missing_or_has_another_name() -> None:
    whole = rocket_navigation(10.0)
    with pytest.raises(TsbenchError, match=r"^the task fligth: it names itself 'rocket_navigation"):
        check_promises("fligth", whole)

    class Unlimited(Rocket):
        @property
        def max_reward(self) -> float:  # type: ignore[override]
            raise AttributeError

    with pytest.raises(TsbenchError, match=r"^the task rocket_navigation: it has no max_reward$"):
        check_promises("rocket_navigation", Unlimited(**vars(whole)))


def test_commands_check_promises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "_factories", dict(tasks._factories))
    tasks.register("fligth")(lambda: rocket_navigation(10.0))
    assert tasks.make("fligth").name == "rocket_navigation"
    with pytest.raises(TsbenchError, match="it names itself"):
        tasks.checked("fligth")
