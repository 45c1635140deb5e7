"""Disturbances of training: their effects and their reproducibility."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tsbench import tasks
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.disturbed import Disturbances, DisturbedPhysics
from tsbench.sim.physics import Physics
from tsbench.testing.episodes import one_of_each_kind, same

NAMES = one_of_each_kind()


def states(
    name: str, disturbances: Disturbances, *, seed: int = 0, threads: int = 1, steps: int = 60
) -> list[Any]:
    """The states of four environments under random actions."""
    task = tasks.make(name)
    physics: Physics[Any] = DisturbedPhysics(task, 4, disturbances, seed, threads=threads)
    batch = BatchedEnvironment(task, physics, 4, seed)
    rng = np.random.default_rng(1)
    batch.reset()
    found = []
    for _ in range(steps):
        batch.step(rng.normal(0.0, 0.1, (4, task.action_size)))
        found.append(batch.state)
    return found


@pytest.mark.parametrize("name", NAMES)
def test_no_disturbance_changes_nothing(name: str) -> None:
    task = tasks.make(name)
    batch = BatchedEnvironment(task, Physics(task, 4, threads=1), 4, 0)
    rng = np.random.default_rng(1)
    batch.reset()
    for state in states(name, Disturbances()):
        batch.step(rng.normal(0.0, 0.1, (4, task.action_size)))
        assert same(state, batch.state)


EVERYTHING = Disturbances(push=200.0, interval=0.5, mass=0.2, friction=0.5, strength=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_the_seed_is_everything(name: str) -> None:
    """Disturbances are equal for any number of threads and differ between seeds."""
    first = states(name, EVERYTHING)
    again = states(name, EVERYTHING, threads=2)
    assert all(same(*pair) for pair in zip(first, again, strict=True))
    other = states(name, EVERYTHING, seed=1)
    assert not same(first[-1], other[-1])


def test_pushes_come_once_an_interval() -> None:
    """Idle rockets: each is pushed for 0.1 s in every 0.5 s, from a random time on, by at most 20
    N, each time in another direction."""
    task = tasks.make("rocket_navigation")
    count, steps = 40, 125  # 2.5 s
    disturbances = Disturbances(push=20.0, interval=0.5)
    physics = DisturbedPhysics(task, count, disturbances, 0, threads=1)
    state = physics.begin(np.random.default_rng(0), np.arange(count))
    forces = np.zeros((steps, count, 3))
    for step in range(steps):
        forces[step] = physics.push_force(state.time, slice(None))
        state = physics.advance(state, np.zeros((count, 2)))
    assert not np.any(forces[..., 1])  # the rocket's plane
    size = np.linalg.norm(forces, axis=-1)
    assert 19.0 < size.max() <= 20.0
    pushed = size > 0.0
    firsts = pushed.argmax(axis=0)
    assert set(firsts) <= set(range(26))
    assert len(set(firsts)) > 10
    # Each covers 0.1 s: four whole steps and parts of two, or five whole ones.
    assert np.all((pushed.sum(axis=0) >= 4 * 4) & (pushed.sum(axis=0) <= 5 * 6))
    impulses = forces.sum(axis=0) * task.timestep
    assert np.linalg.norm(impulses, axis=-1).max() <= 5 * 2.0
    headings = np.arctan2(forces[..., 2], forces[..., 0])[pushed]
    counts, _ = np.histogram(headings, bins=4, range=(-np.pi, np.pi))
    assert counts.min() > 0.15 * len(headings)
    assert np.abs(state.velocity[:, 0]).max() > 0.1


def test_pushes_grow_over_the_first_steps() -> None:
    """After a quarter of the steps of `rise`, pushes have at most a quarter of the full force."""
    task = tasks.make("rocket_navigation")
    physics = DisturbedPhysics(task, 50, Disturbances(push=20.0, rise=4000), 0, threads=1)
    rows, rng = np.arange(50), np.random.default_rng(0)

    def largest() -> float:
        state = physics.begin(rng, rows)
        sizes = [physics.push_force(state.time + 0.02 * k, slice(None)) for k in range(250)]
        return float(np.linalg.norm(sizes, axis=-1).max())

    assert largest() == 0.0
    for bound in (5.0, 10.0, 15.0, 20.0, 20.0):
        state = physics.begin(rng, rows)
        for _ in range(20):  # 1,000 environment steps
            state = physics.advance(state, np.zeros((50, 2)))
        assert 0.9 * bound < largest() <= bound


def test_some_episodes_are_calm() -> None:
    """Three tenths of the rows get no push at all; other rows in each episode."""
    task = tasks.make("rocket_navigation")
    disturbances = Disturbances(push=20.0, calm=0.3, interval=0.5)
    physics = DisturbedPhysics(task, 1000, disturbances, 0, threads=1)
    rng, rows = np.random.default_rng(0), np.arange(1000)

    def calm() -> np.ndarray:
        state = physics.begin(rng, rows)
        times = state.time + 0.1 * np.arange(20)[:, None]
        sizes = [np.linalg.norm(physics.push_force(t, slice(None)), axis=-1) for t in times]
        return ~np.any(sizes, axis=0)

    first, second = calm(), calm()
    for found in (first, second):
        assert 0.25 < found.mean() < 0.35  # three standard deviations are 0.043
    assert 0.05 < (first & second).mean() < 0.13


def test_every_environment_has_its_own_physics_for_good() -> None:
    task = tasks.make("rocket_navigation")
    physics = DisturbedPhysics(task, 8, Disturbances(mass=0.3), 5, threads=1)
    gained = []
    for _ in range(2):
        state = physics.begin(np.random.default_rng(0), np.arange(8))
        state = physics.advance(state, np.tile([1.0, 0.0], (8, 1)))
        gained.append(state.velocity[:, 1])
    np.testing.assert_array_equal(gained[0], gained[1])
    # v = h (F - g m) / (m + h d), so m = h F + ... solved for the mass
    mass = (0.02 * 50.0 - gained[0] * 0.02 * 2.5) / (gained[0] + 0.02 * 2.5)
    assert len(np.unique(mass)) == 8
    assert np.all((mass > 0.7 * 5.0) & (mass < 1.3 * 5.0))
    factors, friction, strength = physics.unseen()  # no latency
    np.testing.assert_allclose(mass, 5.0 * factors, rtol=1e-9)
    assert np.all(friction == 1.0)
    assert np.all(strength == 1.0)


def test_actions_come_late_by_what_a_critic_is_told() -> None:
    """Rockets whose main engine is on from the first action on: one falls until it burns."""
    task = tasks.make("rocket_navigation")
    rows, full = np.arange(60), np.tile([1.0, 0.0], (60, 1))
    physics = DisturbedPhysics(task, 60, Disturbances(latency=2), 0, threads=1)
    batch = BatchedEnvironment(task, physics, 60, 0)
    batch.reset()
    (late,) = physics.unseen()
    assert set(late) == {0, 1, 2}
    np.testing.assert_array_equal(batch.value_observation()[:, -1], late)
    np.testing.assert_array_equal(
        batch.value_observation()[:, :-1], task.value_observation(batch.state)
    )
    climbs = []
    for _ in range(3):
        before = batch.state.velocity[:, 1]
        batch.step(full)
        climbs.append(batch.state.velocity[:, 1] > before)
    np.testing.assert_array_equal(np.argmax(climbs, axis=0), late)
    drawn = []
    for seed in range(3):  # of each episode its own
        physics.begin(np.random.default_rng(seed), rows)
        drawn.append(physics.unseen()[0].tolist())
    assert drawn[0] != drawn[1] != drawn[2]


def test_a_critic_sees_what_the_mdp_says_where_nothing_is_hidden() -> None:
    task = tasks.make("rocket_navigation")
    for physics in (
        Physics(task, 3, threads=1),
        DisturbedPhysics(task, 3, Disturbances(push=20.0), 0, threads=1),
    ):
        batch = BatchedEnvironment(task, physics, 3, 0)
        batch.reset()
        expected = task.value_observation(batch.state)
        np.testing.assert_array_equal(batch.value_observation(), expected)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"push": -1.0}, "push must not be negative"),
        ({"rise": -1}, "rise must not be negative"),
        ({"calm": 1.0}, r"calm must lie in \[0, 1\)"),
        ({"duration": 2.0}, "at most the interval"),
        ({"mass": 1.0}, r"mass must lie in \[0, 1\)"),
        ({"friction": -0.1}, r"friction must lie in \[0, 1\)"),
    ],
)
def test_values_that_make_no_sense(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Disturbances(**wrong)
