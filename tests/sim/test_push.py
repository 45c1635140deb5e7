"""Pushes: forces and impulses by hand; equal floats in the batched and dm_control environments."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.state import Start, State
from tsbench.sim.physics import Physics
from tsbench.sim.push import Push
from tsbench.tasks.laikago import LaikagoState
from tsbench.tasks.rocket import RocketState


def same(first: State, second: State) -> bool:
    """Whether two states are equal to the last bit."""
    pairs = [(getattr(first, f.name), getattr(second, f.name)) for f in fields(first)]
    return all(a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs)


def test_forces_by_hand() -> None:
    """0.1 s are three control steps of 1/30 s; a step covered by half gets half of the force."""
    times = np.arange(6) / 30
    push = Push(time=1 / 30, duration=0.1, force=np.array([100.0, 0.0, 0.0]))
    assert push.during(times, 1 / 30)[:, 0].tolist() == [0.0, 100.0, 100.0, 100.0, 0.0, 0.0]
    late = Push(time=0.05, duration=0.05, force=np.array([0.0, 30.0, 0.0]))
    assert late.during(times, 1 / 30)[:, 1].tolist() == [0.0, 15.0, 30.0, 0.0, 0.0, 0.0]
    each = Push(
        time=np.array([0.0, 0.1]), duration=np.array([0.1, 0.02]), force=np.eye(3)[:2] * 10.0
    )
    now = each.during(np.array([0.08, 0.08]), 0.04)  # each push covers half of the step
    np.testing.assert_allclose(now, [[5.0, 0.0, 0.0], [0.0, 5.0, 0.0]], rtol=1e-9)


@given(
    st.floats(0.0, 1.0), st.floats(1e-3, 1.0), st.sampled_from([1 / 30, 1 / 50]), st.floats(-1, 1)
)
def test_the_whole_impulse_arrives(
    time: float, duration: float, timestep: float, force: float
) -> None:
    push = Push(time, duration, np.array([force, 0.0, -force]))
    steps = np.cumsum(np.full(110, timestep)) - timestep
    impulse = push.during(steps, timestep).sum(axis=0) * timestep
    np.testing.assert_allclose(impulse, duration * push.force, atol=1e-7)


def test_impulse_over_mass_of_the_rocket() -> None:
    """Free fall, 19.66 N to the right for five steps of 0.02 s on 5 kg. Drag, 2.5 N s/m, is taken
    implicitly: v -> (v + h F / m) / (1 + h d / m)."""
    task = tasks.make("rocket_navigation")
    push = Push(0.2, 0.1, np.array([19.66, 0.0, 0.0]))
    physics = Physics(task, 1, threads=1, push=push)
    state = physics.begin(np.random.default_rng(0), np.arange(1))
    velocity = 0.0
    for step in range(20):
        state = physics.advance(state, np.zeros((1, 2)))
        velocity = (velocity + 0.02 / 5.0 * 19.66 * (10 <= step < 15)) / (1.0 + 0.02 * 2.5 / 5.0)
        assert state.velocity[0, 0] == pytest.approx(velocity, rel=1e-12)
        assert state.angular_velocity[0] == pytest.approx(0.0, abs=1e-15)
    # Without drag 1.966 N s on 5 kg are 0.3932 m/s; after ten steps of it, less.
    assert 0.3 < velocity < 0.3932


@pytest.mark.parametrize("heading", [0.0, 1.0, 4.0])
def test_impulse_over_mass_of_the_robot(heading: float) -> None:
    """In the air nothing but the push moves the centre of mass sideways: 10 N s on 25.432 kg."""
    task = tasks.make("laikago_trot")
    direction = np.array([np.cos(heading), np.sin(heading), 0.0])
    physics = Physics(task, 1, threads=1, push=Push(0.1, 0.1, 100.0 * direction))
    start = task.start(np.random.default_rng(0), 1)
    start.qpos[:, 2] = 50.0
    state = physics.place(np.arange(1), start)
    path = [state.com[0]]
    for _ in range(12):
        state = physics.advance(state, np.zeros((1, 12)))
        path.append(state.com[0])
    velocity = np.diff(path, axis=0) * 30
    np.testing.assert_allclose(velocity[:3, :2], 0.0, atol=1e-6)
    gained = velocity[-1, :2]
    np.testing.assert_allclose(gained, 10.0 / 25.432 * direction[:2], rtol=2e-3, atol=1e-4)


def rows(start: Start, count: int) -> Start:
    return Start(*(np.repeat(getattr(start, field.name), count, axis=0) for field in fields(Start)))


@pytest.mark.parametrize("name", tasks.names())
def test_pushed_episodes_are_equal(name: str) -> None:
    """Batched, with a different push in each row and two threads, equals one by one."""
    task = tasks.make(name)
    rng = np.random.default_rng(0)
    count, steps = 4, min(task.horizon, 180)
    force = 150.0 if task.pushed == "trunk" else 30.0
    times, durations = np.array([0.5, 1.0, 1.01, 2.0]), np.array([0.1, 0.1, 0.1, 0.3])
    pushes = Push(times, durations, force * rng.normal(size=(count, 3)))
    actions = 0.2 * rng.normal(size=(steps, count, task.action_size))
    physics = Physics(task, count, threads=2, push=pushes)
    state = physics.place(np.arange(count), rows(task.start(rng, 1), count))
    states = [state]
    for action in actions:
        state = physics.advance(state, action)
        states.append(state)
    for row in range(count):
        push = Push(times[row], durations[row], pushes.force[row])
        single = tsbench.load(name, push=push)
        time_step = single.reset()
        for step, action in enumerate(actions):
            assert same(states[step].rows(slice(row, row + 1)), cast(Any, single.task).state)
            if time_step.last():
                break
            time_step = single.step(action[row])
    first, last = states[-1].rows(slice(0, 1)), states[-1].rows(slice(3, 4))
    assert isinstance(first, (LaikagoState, RocketState))
    assert not same(first, last)


def test_a_push_that_is_taken_away_ends() -> None:
    task = tasks.make("rocket_navigation")
    physics = Physics(task, 1, threads=1, push=Push(0.0, 9.0, np.array([10.0, 0.0, 0.0])))
    state = physics.advance(physics.begin(np.random.default_rng(0), np.arange(1)), np.zeros((1, 2)))
    speed = state.velocity[0, 0]
    physics.push = None
    state = physics.advance(state, np.zeros((1, 2)))
    assert 0.0 < state.velocity[0, 0] < speed


def test_a_new_episode_is_pushed_again() -> None:
    """The time of a push counts from the start of each episode."""
    push = Push(0.1, 0.1, np.array([5.0, 0.0, 0.0]))
    batch = tsbench.load_batched("rocket_navigation", count=2, push=push, threads=1)
    batch.reset()
    speeds = []
    for step in range(30):
        if step == 15:
            batch.reset()
        batch.step(np.zeros((2, 2)))
        speeds.append(batch.state.velocity[0, 0])
    assert speeds[:15] == speeds[15:]
    assert speeds[4] == 0.0 < speeds[5]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"force": np.zeros(2)}, r"^force of a push must have the shape \(3,\) or \(n, 3\), not"),
        ({"force": 5.0}, r"^force of a push must have the shape"),
        ({"force": np.array([np.nan, 0.0, 0.0])}, "must be finite"),
        ({"force": ["much"] * 3}, "must be numbers"),
        ({"force": np.zeros((4, 3))}, r"^time of a push must have the shape \(4,\)"),
        ({"duration": np.full(3, 0.1)}, r"^duration of a push must have the shape \(\)"),
        ({"duration": -0.1}, "^duration of a push must be positive, not -0.1$"),
        ({"time": np.inf}, "must be finite"),
    ],
)
def test_pushes_that_make_no_sense(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(TsbenchError, match=message):
        Push(**{"time": 0.1, "duration": 0.1, "force": np.zeros(3), **changes})


def test_pushes_may_be_lists() -> None:
    lists: Any = ([0.1, 0.2], [0.3, 0.4], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    pushes = Push(*lists)
    (time,), (duration,), (force,) = vars(pushes.rows(np.array([1]))).values()
    assert (time, duration, [*force]) == (0.2, 0.4, [0.0, 1.0, 0.0])


def test_as_many_pushes_as_episodes() -> None:
    pushes = Push(np.zeros(3), np.full(3, 0.1), np.zeros((3, 3)))
    with pytest.raises(TsbenchError, match=r"one for each of 4 episodes, not 3$"):
        tsbench.load_batched("rocket_navigation", count=4, push=pushes, threads=1)
    with pytest.raises(TsbenchError, match=r"one for each of 1 episodes, not 3$"):
        tsbench.load("rocket_navigation", push=pushes)


def test_plans_cannot_be_pushed() -> None:
    push = Push(0.0, 0.1, np.zeros(3))
    with pytest.raises(TsbenchError, match="no body to push"):
        tsbench.load("laikago_walk", "planning", push=push)
