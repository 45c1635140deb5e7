"""The planning variants: s' = s + a, its limits, its reward, and the same in full poses."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any, cast

import numpy as np
import pytest

import tsbench
from tsbench import tasks
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.kinematic import Planning
from tsbench.sim.model import compiled
from tsbench.tasks.laikago import PLAN_REACH, PLAN_TIMESTEP, LaikagoState
from tsbench.tasks.rocket import Rocket, RocketState
from tsbench.testing.episodes import plannable_tasks

NAMES = plannable_tasks()
HIPS = np.array([[0.21935, -0.1245], [0.21935, 0.1245], [-0.21935, -0.1245], [-0.21935, 0.1245]])
SOLE = 0.0265
REACH, DT = PLAN_REACH, PLAN_TIMESTEP  # calibrated; all other numbers are written out here
SPEED = {"laikago_walk": 0.264, "laikago_trot": 0.63}
SWING = {"laikago_walk": 1.65 * 0.48 * DT, "laikago_trot": 1.26 * 0.50 * DT}  # m per plan step


def make(name: str, explore: float = 0.0) -> Planning[Any]:
    return Planning(tasks.make(name), explore=explore)


def ahead(state: LaikagoState) -> np.ndarray:
    """Metres by which each foot is ahead of its hip."""
    return np.asarray(state.feet[..., 0] - state.base_position[..., :1] - HIPS[:, 0])


# The rocket


@pytest.mark.parametrize("name", [name for name in NAMES if isinstance(tasks.make(name), Rocket)])
def test_rocket_moves_by_its_action(name: str) -> None:
    planning = make(name)
    assert planning.timestep == 0.05
    state = cast(RocketState, planning.begin(np.random.default_rng(0), np.arange(2)))
    assert not np.any(state.position)
    action = np.array([[1.0, -0.5, 0.2], [-7.0, 1.0, -9.0]])
    for step in (1, 2):
        state = planning.advance(state, action)
        np.testing.assert_allclose(
            state.position, step * np.array([[0.25, -0.125], [-0.25, 0.25]]), atol=1e-15
        )
        np.testing.assert_allclose(state.angle, step * np.array([0.01, -0.05]), atol=1e-15)
        np.testing.assert_allclose(state.time, step * 0.05)
    assert not np.any(state.velocity)


def test_rocket_sees_its_state_without_velocities() -> None:
    planning = make("rocket_navigation")
    assert planning.observation_size == 7
    state = planning.begin(np.random.default_rng(0), np.arange(1))
    goal = (51.96152422706632, 30.0)
    np.testing.assert_allclose(
        planning.observation(state), [[0.0, 0.0, 0.0, *goal, 60.0, -math.pi / 3]]
    )


def test_rocket_keeps_clear_as_a_disc() -> None:
    """0.5 m of the obstacle and 0.72 m to the lander's farthest corner, sqrt(.567^2 + .434^2)."""
    assert math.hypot(0.566667, 0.434333) < 0.72
    planning = make("rocket_obstacles")
    first = np.array(planning.task.constants()["obstacles"][0])
    state = planning.begin(np.random.default_rng(0), np.arange(2))
    for offset, collision in ((1.219, True), (1.221, False)):
        there = first + offset * np.array([0.6, 0.8])
        near = planning.advance(state.replace(position=np.tile(there, (2, 1))), np.zeros((2, 3)))
        assert planning.violated(near).tolist() == [collision] * 2
        np.testing.assert_allclose(near.clearance[:, 0], offset - 1.22, atol=1e-12)


# Laikago


def test_laikago_stands_at_the_start() -> None:
    for name in SPEED:
        planning = make(name)
        assert (planning.timestep, planning.action_size) == (DT, 7)
        assert planning.horizon * DT == pytest.approx(6.0)
        state = cast(LaikagoState, planning.begin(np.random.default_rng(0), np.arange(1)))
        np.testing.assert_allclose(state.base_position, [[0.0, 0.0, 0.42]])
        np.testing.assert_allclose(state.feet[0, :, :2], HIPS)
        stands = cast(Any, planning.task).gait.contacts(state.time)[0]
        np.testing.assert_allclose(state.feet[0, :, 2], np.where(stands, SOLE, SOLE + 0.1))
        still = planning.advance(state, np.zeros((1, 7)))
        np.testing.assert_allclose(still.base_position, state.base_position)
        np.testing.assert_allclose(still.feet[..., :2], state.feet[..., :2], atol=1e-15)


@pytest.mark.parametrize("name", SPEED)
def test_base_moves_by_its_action(name: str) -> None:
    planning, step = make(name), DT * SPEED[name]
    state = planning.begin(np.random.default_rng(0), np.arange(4))
    action = np.zeros((4, 7))
    action[:, :2] = [[0.5, 0.0], [-1.0, 0.0], [0.6, 0.8], [1.0, 1.0]]
    action[3, 2] = 0.5  # a norm of 1.5, to be scaled to 1
    moved = planning.advance(state, action).base_position - state.base_position
    expected = np.array([[0.5, 0, 0], [-1, 0, 0], [0.6, 0.8, 0], [2 / 3, 2 / 3, 1 / 3]]) * step
    expected[3, 2] = min(expected[3, 2], 0.02)  # between 0.40 and 0.44 m
    np.testing.assert_allclose(moved, expected, atol=1e-12)


@pytest.mark.parametrize("name", SPEED)
def test_feet_move_by_their_action(name: str) -> None:
    """A displacement in the world, its angle about the hip limited; in stance there is none."""
    planning, swing, step = make(name), SWING[name], DT * SPEED[name]
    state = planning.begin(np.random.default_rng(0), np.arange(2))
    action = np.zeros((2, 7))
    action[:, 3:] = [0.25, -0.5, 1.0, 0.0]  # times twice the swing of one step
    action[1, 0] = 1.0
    moved = (planning.advance(state, action).feet - state.feet)[..., 0]
    gait = cast(Any, planning.task).gait
    free = ~(gait.contacts(state.time[:1]) & gait.contacts(state.time[:1] + DT))[0]
    assert 0 < free.sum() < 4
    expected = np.array([swing / 2, -swing, swing, 0.0])
    np.testing.assert_allclose(moved[0], np.where(free, expected, 0.0), atol=1e-12)
    expected = np.array([swing / 2, step - swing, step + min(swing, REACH), 0.0])
    np.testing.assert_allclose(moved[1], np.where(free, expected, 0.0), atol=1e-12)


@pytest.mark.parametrize("name", SPEED)
def test_who_does_not_step_does_not_travel(name: str) -> None:
    planning = make(name)
    state = cast(LaikagoState, planning.begin(np.random.default_rng(0), np.arange(1)))
    feet = state.feet[..., :2]
    for _ in range(90):
        state = planning.advance(state, np.array([[1.0, 0, 0, 0, 0, 0, 0]]))
        np.testing.assert_allclose(state.feet[..., :2], feet, atol=1e-12)
    assert state.base_position[0, 0] == pytest.approx(REACH)


@pytest.mark.parametrize("name", SPEED)
@pytest.mark.parametrize("extreme", [False, True])
def test_limits_hold_for_any_actions(name: str, extreme: bool) -> None:
    planning = make(name, explore=0.5)
    rng = np.random.default_rng(0)
    state = cast(LaikagoState, planning.begin(rng, np.arange(300)))
    gait = cast(Any, planning.task).gait
    for _ in range(60):
        action = rng.normal(0.0, 2.0, (300, 7))
        action = np.sign(action) if extreme else action
        following = planning.advance(state, action)
        np.testing.assert_allclose(following.time, state.time + DT)
        move = np.linalg.norm(following.base_position - state.base_position, axis=-1)
        assert move.max() <= DT * SPEED[name] * (1 + 1e-9)
        assert np.all(following.base_position[:, 2] >= 0.40 - 1e-12)
        assert np.all(following.base_position[:, 2] <= 0.44 + 1e-12)
        assert np.abs(ahead(following) - ahead(state)).max() <= SWING[name] * (1 + 1e-9)
        assert np.abs(ahead(following)).max() <= REACH * (1 + 1e-9)
        height = np.where(gait.contacts(following.time), 0.0, 0.1)
        np.testing.assert_allclose(following.feet[..., 2] - SOLE, height, atol=1e-12)
        across = following.feet[..., 1] - following.base_position[:, 1:2]
        np.testing.assert_allclose(across, np.tile(HIPS[:, 1], (300, 1)), atol=1e-12)
        state = following


def test_balance_by_hand() -> None:
    """R_dyn = exp(-5 |C - P|) of a walk whose feet stay under their hips.

    At 0.1 s FL is in the air: P is the mean of FR, RR and RL,
    x = (0.21935 - 0.21935 - 0.21935) / 3, y = (-0.1245 - 0.1245 + 0.1245) / 3,
    0.0840732 m from C, so R_dyn = exp(-0.420366) = 0.6568065.
    The goal is 1.25 m away, feet are at rest and as high as they should be: R = exp(-3.125).
    """
    planning = make("laikago_walk")
    state = planning.begin(np.random.default_rng(0), np.arange(1))
    still = np.zeros((1, 7))
    following = planning.advance(state, still)
    balance = planning.abstraction.dynamics_reward
    assert balance is not None
    assert balance(state)[0] == pytest.approx(0.6568065, abs=1e-7)  # FL lifts off at the start
    assert balance(following)[0] == pytest.approx(0.6568065, abs=1e-7)
    assert planning.reward(state, still, following)[0] == pytest.approx(
        0.6568065 * 0.043936934, rel=1e-5
    )
    # In trot the diagonal pair FR, RL stands: P is under C.
    trot = make("laikago_trot")
    start = trot.begin(np.random.default_rng(0), np.arange(1))
    following = trot.advance(start, still)
    assert trot.reward(start, still, following)[0] == pytest.approx(5.530844e-4, rel=1e-6)
    # 4 cm ahead of it: exp(-0.2), if the feet stay.
    shifted = following.replace(base_position=np.add(following.base_position, [0.04, 0.0, 0.0]))
    balance = trot.abstraction.dynamics_reward
    assert balance is not None
    assert balance(shifted)[0] == pytest.approx(0.8187308)


# All


@pytest.mark.parametrize("name", NAMES)
def test_reward_start_and_ending_are_the_tasks(name: str) -> None:
    planning = make(name, explore=0.7)
    task = planning.task
    rng = np.random.default_rng(0)
    state = planning.begin(rng, np.arange(500))
    ended = 0
    for _ in range(25):
        action = rng.uniform(-1.0, 1.0, (500, planning.action_size))
        following = planning.advance(state, action)
        factor: Any = 1.0
        if planning.abstraction.dynamics_reward is not None:
            factor = planning.abstraction.dynamics_reward(following)
            assert np.all((factor > 0.0) & (factor <= 1.0))
        expected = task.reward(state, action, following) * factor
        np.testing.assert_array_equal(planning.reward(state, action, following), expected)
        for question in ("terminal", "reached", "violated"):
            answer = getattr(planning, question)(following)
            np.testing.assert_array_equal(answer, getattr(task, question)(following))
        ended += int(planning.terminal(following).sum())
        state = following
    assert ended > 0
    own = make(name).begin(rng, np.arange(2))
    assert not np.any(own.time)
    np.testing.assert_allclose(task.goal_distance(own), task.constants()["distance"])
    assert (planning.name, planning.version) == (task.name, task.version)
    assert planning.max_reward == task.max_reward


@pytest.mark.parametrize("name", NAMES)
def test_sampled_states_are_possible(name: str) -> None:
    planning = make(name, explore=1.0)
    state = planning.begin(np.random.default_rng(0), np.arange(4000))
    steps = state.time / planning.timestep
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    assert steps.min() == 0.0
    assert planning.horizon - 3 < steps.max() < planning.horizon
    if isinstance(state, LaikagoState):
        farthest = SPEED[name] * state.time
        assert np.all(state.base_position[:, 0] <= farthest + 1e-12)
        assert np.all(state.base_position[:, 0] >= 0.5 * farthest - 1e-12)
        assert np.all(np.abs(state.base_position[:, 1]) <= 0.1)
        heights = state.base_position[:, 2]
        assert 0.40 <= heights.min() < 0.401
        assert 0.439 < heights.max() <= 0.44
        assert np.abs(ahead(state)).max() <= REACH / 2 + 1e-12
        assert not np.any(planning.violated(state))
    else:
        at = cast(RocketState, state)
        assert not np.any(planning.terminal(at))
        assert np.all(at.position.min(axis=0) < [-9.5, -9.5])
        assert np.all(at.position.max(axis=0) > [61.4, 39.5])
        assert np.all(np.abs(at.angle) <= 0.5)


def test_share_of_sampled_starts() -> None:
    state = make("rocket_navigation", explore=0.75).begin(np.random.default_rng(0), np.arange(4000))
    sampled = np.any(state.position != 0.0, axis=-1)
    assert 0.72 < sampled.mean() < 0.78
    assert not np.any(state.time[~sampled])


@pytest.mark.parametrize("name", NAMES)
def test_batched_path_agrees_with_full_poses(name: str) -> None:
    """The dm_control environment gives the same floats, and its full poses match the states."""
    environment = tsbench.load(name, "planning")
    planning = make(name)
    batch = BatchedEnvironment(planning, planning, 3, 0)
    observations = batch.reset()
    time_step = environment.reset()
    rng = np.random.default_rng(4)
    site = environment.physics.named.data.site_xpos
    low, high = compiled("laikago").jnt_range[1:].T
    for _ in range(150):
        (observed,) = time_step.observation.values()
        assert observed.tobytes() == observations[1].tobytes()
        state: Any = batch.state.rows(np.array([1]))
        qpos = environment.physics.data.qpos
        if isinstance(state, LaikagoState):
            np.testing.assert_allclose(qpos[:3], state.base_position[0], atol=1e-3)
            np.testing.assert_allclose(qpos[3:7], [1.0, 0.0, 0.0, 0.0], atol=1e-9)
            feet = np.array([site[f"{leg}_foot"] for leg in ("FR", "FL", "RR", "RL")])
            np.testing.assert_allclose(feet, state.feet[0], atol=1e-3)
            assert np.all((qpos[7:] >= low - 1e-6) & (qpos[7:] <= high + 1e-6))
        else:
            np.testing.assert_allclose(qpos, [*state.position[0], *state.angle])
        actions = np.clip(rng.normal(0.2, 0.6, (3, planning.action_size)), -1.0, 1.0)
        transition = batch.step(actions)
        time_step = environment.step(actions[1])
        assert time_step.reward == transition.reward[1]
        assert time_step.last() == (transition.terminal[1] or transition.truncated[1])
        if time_step.last():
            time_step = environment.reset()
        observations = transition.observation


@pytest.mark.parametrize("name", NAMES)
def test_rows_do_not_know_each_other(name: str) -> None:
    planning = make(name, explore=1.0)
    rng = np.random.default_rng(0)
    state = planning.begin(rng, np.arange(33))
    action = rng.uniform(-1.0, 1.0, (33, planning.action_size))
    following = planning.advance(state, action)
    reward = planning.reward(state, action, following)
    observation = planning.observation(following)
    critic = planning.value_observation(following)
    for row in range(33):
        only = slice(row, row + 1)
        after = planning.advance(state.rows(only), action[only])
        for field in fields(after):
            value = getattr(after, field.name)
            assert value.tobytes() == getattr(following, field.name)[only].tobytes(), field.name
        assert planning.reward(state.rows(only), action[only], after)[0] == reward[row]
        assert planning.observation(after).tobytes() == observation[only].tobytes()
        assert planning.value_observation(after).tobytes() == critic[only].tobytes()


@pytest.mark.parametrize("name", NAMES)
def test_coordinates(name: str) -> None:
    """The columns of a plan match the names of the coordinates."""
    abstraction = make(name).abstraction
    state = abstraction.sample(np.random.default_rng(0), 5)
    flat = dict(zip(abstraction.coordinates, abstraction.flatten(state).T, strict=True))
    if isinstance(state, LaikagoState):
        np.testing.assert_array_equal(flat["base_z"], state.base_position[:, 2])
        np.testing.assert_array_equal(flat["RR_foot_x"], state.feet[:, 2, 0])
        np.testing.assert_array_equal(flat["FL_foot_z"], state.feet[:, 1, 2])
        assert len(flat) == 15
    else:
        at = cast(RocketState, state)
        np.testing.assert_array_equal(flat["z"], at.position[:, 1])
        np.testing.assert_array_equal(flat["angle"], at.angle)
        assert len(flat) == 3
