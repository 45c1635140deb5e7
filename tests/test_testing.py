"""Each contract test fails on a task that breaks the promise that it tests."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tsbench import tasks
from tsbench.core.arrays import array_namespace
from tsbench.tasks.rocket import Rocket, rocket_navigation
from tsbench.testing.arrays import ArrayContract
from tsbench.testing.contracts import Contract, PlanningContract, TaskContract
from tsbench.testing.episodes import Case

numbers = itertools.count()
Make = Callable[..., str]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Make:
    """A function that registers a short rocket task with changed functions and returns its name."""
    monkeypatch.setattr(tasks, "_factories", dict(tasks._factories))

    def register(**functions: Callable[..., Any]) -> str:
        name = f"broken_{next(numbers)}"
        kind = type("Broken", (Rocket,), functions)

        @tasks.register(name)
        def broken(distance: float = 10.0) -> Rocket:
            rocket: Rocket = kind(**{**vars(rocket_navigation(distance)), "name": name})
            return rocket

        return name

    return register


def wide(self: Rocket, state: Any) -> Any:
    seen = Rocket.observation(self, state)
    return array_namespace(seen).concat([seen, seen], axis=-1)


def constant(self: Rocket, state: Any) -> Any:
    seen = Rocket.observation(self, state)
    return seen * np.array([0.0] + [1.0] * 9)


def moody(self: Rocket, state: Any) -> Any:
    return Rocket.observation(self, state) + 1e-9 * next(numbers)


def crowded(self: Rocket, state: Any) -> Any:
    seen = Rocket.observation(self, state)
    return seen + 1e-12 * len(seen)


def generous(self: Rocket, previous: Any, action: Any, state: Any) -> Any:
    return 1.0 + 0.0 * state.time


def stingy(self: Rocket, previous: Any, action: Any, state: Any) -> Any:
    return -1.0 + 0.0 * state.time


def free(self: Rocket, state: Any, action: Any) -> Any:
    return 5.0 * action, action[..., :0]


def double(self: Rocket, previous: Any, action: Any, state: Any) -> Any:
    reward = Rocket.reward(self, previous, action, state)
    xp = array_namespace(reward)
    return xp.astype(reward, xp.float64)


def steady(self: Rocket, rng: Any, count: int, *, perturbed: bool = False) -> Any:
    return Rocket.start(self, rng, count)


def unsettled(self: Rocket, rng: Any, count: int, *, perturbed: bool = False) -> Any:
    return Rocket.start(self, rng, count, perturbed=True)


@pytest.mark.parametrize(
    ("functions", "test"),
    [
        ({"observation": wide}, "test_specs"),
        ({"observation": constant}, "test_no_observation_is_constant"),
        ({"observation": moody}, "test_the_same_seed_gives_the_same_episodes"),
        ({"reward": generous}, "test_episodes"),
        ({"reward": stingy}, "test_episodes"),
        ({"control": free}, "test_actions_are_clipped"),
        ({"start": steady}, "test_other_seeds_and_episodes_start_elsewhere"),
        ({"start": unsettled}, "test_other_seeds_and_episodes_start_elsewhere"),
    ],
)
def test_what_breaks_a_contract_is_found(functions: dict[str, Any], test: str, make: Make) -> None:
    check = getattr(Contract(), test)
    check(Case(make()))
    with pytest.raises((AssertionError, ValueError)):
        check(Case(make(**functions)))


def test_what_differs_among_many_is_found(make: Make) -> None:
    check = TaskContract().test_both_simulations_agree_to_the_last_bit
    check(make(), "uniform")
    with pytest.raises(AssertionError):
        check(make(observation=crowded), "uniform")


def test_a_constant_of_numpys_is_found(make: Make) -> None:
    check = ArrayContract().test_torch_in_single_precision_agrees
    check(make())
    with pytest.raises(AssertionError):
        check(make(reward=double))


def test_a_name_that_is_not_its_own_is_found(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    check, name = TaskContract().test_it_is_found_by_name, make()
    check(name)
    (factory,) = tasks._factories[name].values()
    other: Any = factory()
    monkeypatch.setitem(tasks._factories, name, {"x": lambda: replace(other, name="y")})
    with pytest.raises(AssertionError):
        check(name)


def test_a_planner_beyond_its_actions_is_found(make: Make) -> None:
    check = PlanningContract().test_states_can_be_sampled
    check(make())

    def abstraction(self: Rocket) -> Any:
        found = Rocket.abstraction(self)
        found.naive = lambda state: np.full((len(state.time), 3), 2.0)  # type: ignore[method-assign]
        return found

    with pytest.raises(AssertionError):
        check(make(abstraction=abstraction))


def test_a_planning_step_too_few_is_found(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """But not what rounding leaves: 120 * 0.02 s are less than 48 * 0.05 s by 4e-16 s."""
    check, name = PlanningContract().test_the_sizes_are_the_tasks, make()
    (factory,) = tasks._factories[name].values()
    made: Any = factory()
    monkeypatch.setitem(tasks._factories, name, {"x": lambda: replace(made, horizon=120)})
    check(Case(name, "planning"))

    def abstraction(self: Rocket) -> Any:
        found = Rocket.abstraction(self)
        found.horizon -= 1
        return found

    with pytest.raises(AssertionError):
        check(Case(make(abstraction=abstraction), "planning"))
