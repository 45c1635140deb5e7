"""The rocket's rewards, endings and engines against numbers worked out by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.state import Course, Start
from tsbench.planning.path import Path
from tsbench.sim.physics import Physics
from tsbench.tasks.rocket import Rocket, RocketState
from tsbench.testing.episodes import Case, compare, ending

COS30, SIN30 = 0.8660254037844387, 0.5
GOAL = np.array([51.96152422706632, 30.0])  # 60 m at 30 degrees


def rocket(name: str = "rocket_navigation", **constants: Any) -> Rocket:
    task = tasks.make(name, **constants)
    assert isinstance(task, Rocket)
    return task


def state(
    *positions: Any,
    angle: Any = 0.0,
    velocity: Any = (0.0, 0.0),
    spin: Any = 0.0,
    clearance: Any = (9.0, 9.0),
) -> RocketState:
    """States at the positions (n, 2), equal in everything else."""
    n = len(positions)
    return RocketState(
        time=np.zeros(n),
        position=np.array(positions, float),
        angle=np.full(n, angle),
        velocity=np.tile(np.array(velocity, float), (n, 1)),
        angular_velocity=np.full(n, spin),
        clearance=np.tile(np.array(clearance, float), (n, 1)),
    )


def off_goal(distance: float, bearing: float = 1.1) -> np.ndarray:
    return GOAL + distance * np.array([math.cos(bearing), math.sin(bearing)])


def reward(task: Rocket, at: RocketState) -> np.ndarray:
    return np.asarray(task.reward(at, np.zeros((len(at.time), 2)), at))


# The task's constants


def test_constants() -> None:
    for name in ("rocket_navigation", "rocket_obstacles"):
        task = rocket(name)
        assert (task.version, task.timestep, task.substeps) == (1, 0.02, 1)
        assert (task.observation_size, task.action_size, task.max_reward) == (10, 2, 0.9)
        np.testing.assert_allclose(task.goal, GOAL, rtol=1e-14)
        np.testing.assert_allclose(task.bounds, [[-10.0, -10.0], [61.96152422706632, 40.0]])
        # 51.96 m at 5 m/s take 10.392 s; one and a half of that at 50 Hz are 779.4 steps.
        assert task.horizon == 779
    assert rocket().obstacles == ()
    # A third and two thirds of the way, a metre to the left and to the right of the line.
    np.testing.assert_allclose(
        rocket("rocket_obstacles").obstacles,
        [
            [20 * COS30 - SIN30, 20 * SIN30 + COS30],  # 16.82, 10.87
            [40 * COS30 + SIN30, 40 * SIN30 - COS30],  # 35.14, 19.13
        ],
    )


@pytest.mark.parametrize(("distance", "horizon"), [(24.0, 312), (40.0, 520), (80.0, 1039)])
def test_the_horizon_grows_with_the_distance(distance: float, horizon: int) -> None:
    task = rocket(distance=distance)
    assert task.horizon == horizon  # 1.5 x distance x cos 30 / 5 / 0.02
    assert np.linalg.norm(task.goal) == pytest.approx(distance)


@pytest.mark.parametrize(("horizon", "steps"), [(120, 48), (121, 48), (124, 49), (779, 311)])
def test_planning_takes_all_whole_steps(horizon: int, steps: int) -> None:
    """In 120 steps of 0.02 s go 48 of 0.05 s, though 120 * 0.02 / 0.05 is rounded to less."""
    task = replace(rocket(), horizon=horizon)
    assert task.abstraction().horizon == steps


# Reward


@pytest.mark.parametrize(
    ("distance", "expected"),
    [
        (0.0, 0.9),
        (4.0, 0.9 * 0.36787944117144233),  # exp(-1)
        (10.0, 0.0738764987616),  # 0.9 exp(-2.5) = 0.9 x 0.082084998624
        (20.0, 0.00606415229917),  # 0.9 exp(-5) = 0.9 x 0.00673794699909
        (60.0, 0.9 * 3.059023205018258e-07),  # exp(-15): the start
    ],
)
def test_reward_without_obstacles(distance: float, expected: float) -> None:
    assert reward(rocket(), state(off_goal(distance)))[0] == pytest.approx(expected, rel=1e-9)


def test_reward_with_obstacles() -> None:
    task = rocket("rocket_obstacles")
    first, second = np.array(task.obstacles)
    # The obstacles are 20 m apart along the line and 2 m across it: sqrt(404) = 20.0997512 m.
    # On the first, 40 m along and 1 m across from the goal, sqrt(1601) = 40.0124980 m:
    #   0.9 exp(-10.0031245) - 0.075 - 0.075 exp(-10.0498756)
    #   = 4.0732390e-5 - 0.075 - 3.2394e-6
    np.testing.assert_allclose(reward(task, state(first)), -0.0749625070, atol=1e-9)
    # Two metres to the side of the second the penalty is 0.075 exp(-1) = 0.0275909581.
    aside = second + 2.0 * np.array([SIN30, -COS30])
    expected = 0.9 * math.exp(-0.25 * math.hypot(20.0, 3.0)) - 0.0275909581
    expected -= 0.075 * math.exp(-0.5 * math.hypot(20.0, 4.0))
    np.testing.assert_allclose(reward(task, state(aside)), expected, atol=1e-9)
    # Obstacles cost something only nearby.
    np.testing.assert_allclose(reward(task, state(GOAL)), 0.9 - 0.075 * math.exp(-10.0), atol=1e-4)


# Observation


def test_observation() -> None:
    at = state((10.0, -2.0), angle=0.3, velocity=(1.0, -4.0), spin=0.7)
    offset = (41.96152422706632, 32.0)
    expected = [
        *(10.0, -2.0, 0.3, 1.0, -4.0, 0.7),
        *offset,
        52.7709154313,  # sqrt(1760.7695155 + 1024)
        math.atan(32.0 / 41.96152422706632) - 0.3 - math.pi / 2,
    ]
    np.testing.assert_allclose(rocket().observation(at)[0], expected, rtol=1e-7)


@pytest.mark.parametrize(
    ("angle", "expected"),
    [
        (0.0, -60.0),  # upright points at 90 degrees, the goal lies at 30
        (-60.0, 0.0),
        (300.0, 0.0),
        (-420.0, 0.0),
        (-90.0, 30.0),
        (119.0, -179.0),
        (121.0, 179.0),
        (-239.0, 179.0),
    ],
)
def test_heading_error_in_degrees(angle: float, expected: float) -> None:
    observation = rocket().observation(state((0.0, 0.0), angle=math.radians(angle)))
    assert math.degrees(observation[0, 9]) == pytest.approx(expected, abs=1e-9)
    assert -180.0 <= math.degrees(observation[0, 2]) < 180.0
    assert math.cos(observation[0, 2]) == pytest.approx(math.cos(math.radians(angle)))
    assert math.sin(observation[0, 2]) == pytest.approx(math.sin(math.radians(angle)))


# Endings


@pytest.mark.parametrize(
    ("inside", "outside"),
    [
        ((-9.999, 0.0), (-10.001, 0.0)),
        ((0.0, -9.999), (0.0, -10.001)),
        ((61.961, 0.0), (61.962, 0.0)),
        ((0.0, 39.999), (0.0, 40.001)),
        ((-10.0, -10.0), (61.962, 40.001)),
    ],
)
def test_out_of_bounds_ends_the_episode(inside: Any, outside: Any) -> None:
    task = rocket()
    assert task.terminal(state(inside, outside)).tolist() == [False, True]
    assert not task.reached(state(inside, outside, GOAL)).any()


@pytest.mark.parametrize(
    ("clearance", "collision"),
    [((1e-9, 5.0), False), ((0.0, 5.0), True), ((5.0, 0.0), True), ((-0.2, -0.2), True)],
)
def test_collision(clearance: tuple[float, float], collision: bool) -> None:
    task = rocket("rocket_obstacles")
    at = state((0.0, 0.0), clearance=clearance)
    assert task.violated(at).tolist() == [collision]
    assert task.terminal(at).tolist() == [False]  # it only costs


def test_leaving_the_world_is_a_violation() -> None:
    outside = state((-10.001, 0.0))
    for name, mishap in (
        ("rocket_navigation", "leaving the world"),
        ("rocket_obstacles", "a collision or leaving the world"),
    ):
        task = rocket(name)
        assert task.violated(outside).all()
        assert task.terminal(outside).all()
        assert not task.violated(state((-9.999, 0.0))).any()
        assert task.mishap == mishap


def test_what_a_step_measures() -> None:
    """Main engine at 0.6: 30 N, side at -0.5: 5 N; below half throttle, none."""
    task = rocket()
    near, far = state(off_goal(0.999)), state(off_goal(1.001))
    found = task.measured(far, np.array([[0.6, -0.5]]), near)
    assert found["away"][0] == 0.0
    assert found["impulse"][0] == pytest.approx(35.0 * 0.02)
    found = task.measured(near, np.array([[0.49, 0.3]]), far)
    assert found["away"][0] == pytest.approx(0.02)
    assert found["impulse"][0] == 0.0
    assert set(task.measured(near, None, far)) == {"away"}


def test_measures_by_hand() -> None:
    """Two flights: one to the end, one that leaves the world after 100 of 779 steps."""
    task = rocket()
    ends, course = state((0.0, 0.0), (1.0, 1.0)), Course(violated=np.array([False, True]))
    sums = {"away": np.array([9.0, 2.0]), "impulse": np.array([300.0, 0.0])}
    found = task.measures(ends, ends, course, sums, np.array([779, 100]))
    assert list(found) == list(task.measure_notes)
    np.testing.assert_allclose(found["time away from the goal, s"], [9.0, 2.0 + 679 * 0.02])
    np.testing.assert_allclose(found["impulse of the engines, N s"], [300.0, 0.0])
    del sums["impulse"]
    assert len(task.measures(ends, ends, course, sums, np.array([779, 100]))) == 1


def test_nothing_to_collide_with() -> None:
    assert not rocket().violated(state((0.0, 0.0), clearance=())).any()


@pytest.mark.parametrize(
    ("distance", "speed", "solved"),
    [(0.999, 0.999, True), (1.001, 0.0, False), (0.0, 1.001, False), (5.0, 5.0, False)],
)
def test_success(distance: float, speed: float, solved: bool) -> None:
    at = state(off_goal(distance), velocity=(0.6 * speed, -0.8 * speed))
    for violated in (False, True):
        course = Course(violated=np.array([violated]))
        assert rocket().success(at, course).tolist() == [solved and not violated]
    assert rocket().goal_distance(at)[0] == pytest.approx(distance)


VARIANTS: tuple[tsbench.Variant | None, ...] = (None, *tsbench.VARIANTS)
NAMES = ("rocket_navigation", "rocket_obstacles")


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", NAMES)
def test_both_endings_happen(name: str, variant: tsbench.Variant | None) -> None:
    """A hovering rocket lasts to the horizon, and a falling one leaves the world. In a plan the
    same holds for a resting and a descending one."""
    environment = Case(name, variant).load(seed=3, perturbed=False)
    if variant == "planning":
        hover, away = itertools.cycle([np.zeros(3)]), -np.ones(3)
    else:  # the least thrust at every other step is its weight, 12.5 N
        hover, away = itertools.cycle([np.zeros(2), np.array([0.5, 0.0])]), np.zeros(2)
    # An imitation begins anywhere along its reference.
    assert not all(ending(environment, lambda: next(hover)) for _ in range(20))
    assert any(ending(environment, lambda: away) for _ in range(20))


@pytest.mark.parametrize("name", NAMES)
def test_both_simulations_agree_to_the_horizon(name: str) -> None:
    task = rocket(name)
    actions = np.zeros((task.horizon, 3, 2))
    actions[::2, :, 0] = 0.5
    starts = task.start(np.random.default_rng(11), 3)
    assert compare(task, starts, actions) == [task.horizon] * 3


# Physics


@pytest.mark.parametrize(
    ("action", "force"),
    [
        ((0.0, 0.0), (0.0, 0.0)),
        ((0.5, 0.5), (25.0, 5.0)),
        ((0.499999, 0.499999), (0.0, 0.0)),
        ((0.75, -0.5), (37.5, -5.0)),
        ((1.0, -1.0), (50.0, -10.0)),
        ((-1.0, -0.499999), (0.0, 0.0)),
        ((7.0, 7.0), (50.0, 10.0)),
        ((-7.0, -7.0), (0.0, -10.0)),
    ],
)
def test_engines(action: tuple[float, float], force: tuple[float, float]) -> None:
    control, memory = rocket().control(state((0.0, 0.0)), np.array([action]))
    np.testing.assert_array_equal(control, [force])
    assert memory.shape == (1, 0)


@pytest.mark.parametrize(
    ("angle", "action", "velocity", "spin"),
    [
        # MuJoCo takes drag implicitly: v = h F / (m + 2.5 h) = 0.02 F / 5.05. Weight is 12.5 N.
        (0.0, (0.0, 0.0), (0.0, -0.25 / 5.05), 0.0),
        (0.0, (1.0, 0.0), (0.0, 0.02 * 37.5 / 5.05), 0.0),
        # Counter-clockwise by 90 degrees, the top points to the left.
        (math.pi / 2, (1.0, 0.0), (-1.0 / 5.05, -0.25 / 5.05), 0.0),
        # Positive: the top is pushed to the left, so it turns counter-clockwise,
        # by h x 10 N x 0.365 m / 0.8 kg m^2 = 0.09125 rad/s.
        (0.0, (0.0, 1.0), (-0.2 / 5.05, -0.25 / 5.05), 0.09125),
        (0.0, (0.0, -0.5), (0.1 / 5.05, -0.25 / 5.05), -0.045625),
    ],
)
def test_one_step_of_physics(
    angle: float, action: Any, velocity: tuple[float, float], spin: float
) -> None:
    task = rocket()
    physics = Physics(task, 1, threads=1)
    qpos = np.array([[3.0, 4.0, angle]])
    before = physics.place(
        np.array([0]), Start(np.zeros(1), qpos, np.zeros((1, 3)), np.zeros((1, 0)))
    )
    after = physics.advance(before, np.array([action]))
    np.testing.assert_allclose(after.velocity[0], velocity, atol=1e-12)
    np.testing.assert_allclose(after.angular_velocity[0], spin, atol=1e-12)
    np.testing.assert_allclose(after.position[0], qpos[0, :2] + 0.02 * np.array(velocity))
    assert after.time[0] == 0.02


@pytest.mark.parametrize(
    ("offset", "clearance"),
    [
        ((0.0, 0.465667 + 0.5 + 0.1), 0.1),  # an obstacle above the hull's flat top
        ((0.0, -0.434333 - 0.5 - 0.1), 0.1),  # under its flat bottom
        ((0.566667 + 0.5 + 0.1, -0.3), 0.1),  # at its right side
        ((-0.566667 - 0.5 - 0.1, -0.3), 0.1),
        ((0.0, 0.465667 + 0.5 - 0.05), -0.05),
        ((0.0, 30.0), 30.0 - 0.5 - 0.465667),  # far away
    ],
)
def test_clearance_is_measured_from_the_hull(offset: tuple[float, float], clearance: float) -> None:
    task = rocket("rocket_obstacles")
    physics = Physics(task, 1, threads=1)
    qpos = np.array([[*(np.array(task.obstacles[0]) - offset), 0.0]])
    placed = physics.place(
        np.array([0]), Start(np.zeros(1), qpos, np.zeros((1, 3)), np.zeros((1, 0)))
    )
    np.testing.assert_allclose(placed.clearance[0, 0], clearance, atol=1e-4)


def test_a_collision_is_a_contact() -> None:
    """The sensors report a collision exactly where the physics has a contact."""
    task = rocket("rocket_obstacles")
    model = task.spec().compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(400):
        obstacle = np.array(task.obstacles[rng.integers(2)])
        data.qpos[:] = [*(obstacle + rng.uniform(-1.6, 1.6, 2)), rng.uniform(-4.0, 4.0)]
        mujoco.mj_forward(model, data)
        clearance = data.sensordata.min()
        if abs(clearance) > 1e-6:
            seen.append((clearance <= 0.0, data.ncon > 0))
    assert all(sensed == touched for sensed, touched in seen)
    assert 50 < sum(touched for _, touched in seen) < 350


def test_starts() -> None:
    task = rocket()
    fixed = task.start(np.random.default_rng(0), 3)
    assert not np.any(fixed.time)
    assert not np.any(fixed.qpos)
    assert not np.any(fixed.qvel)
    near = task.start(np.random.default_rng(0), 4000, perturbed=True)
    bounds = np.array([0.5, 0.5, 0.2])
    for values in (near.qpos, near.qvel):
        assert np.all(np.abs(values) <= bounds)
        assert np.all(values.max(axis=0) > 0.98 * bounds)
        assert np.all(values.min(axis=0) < -0.98 * bounds)


def test_goal_and_obstacles_are_in_the_model() -> None:
    task = rocket("rocket_obstacles")
    model = task.spec().compile()
    np.testing.assert_allclose(model.site("goal").pos, [GOAL[0], 0.0, GOAL[1]])
    for number, (x, z) in enumerate(task.obstacles, 1):
        geom = model.geom(f"obstacle_{number}")
        np.testing.assert_allclose(geom.pos, [x, 0.0, z])
        assert geom.size[0] == 0.5


# From plan to reference motion


def test_reference_is_the_plan_interpolated() -> None:
    states = np.array([[0.0, 0.0, 0.0], [0.25, 0.1, 0.05], [0.5, 0.2, 0.1]])
    reference = rocket().reference(Plan("rocket_navigation", 1, 0.05, states, np.zeros(2)))
    assert (reference.task, reference.task_version) == ("rocket_navigation", 1)
    assert (reference.steps, reference.timestep) == (5, 0.02)
    np.testing.assert_allclose(reference.qpos[1], [0.1, 0.04, 0.02])
    np.testing.assert_allclose(reference.qpos[-1], [0.5, 0.2, 0.1])
    np.testing.assert_allclose(reference.qvel, np.tile([5.0, 2.0, 1.0], (6, 1)))
    assert not reference.tracked


def test_a_plan_shorter_than_a_control_step_has_a_reference() -> None:
    states = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    plan = Plan("rocket_navigation", 1, 0.01, states, np.zeros(1))
    rocket().check_fit(plan)
    reference = rocket().reference(plan)
    np.testing.assert_allclose(reference.qpos, states)
    np.testing.assert_allclose(reference.qvel, np.tile([5.0, 0.0, 0.0], (2, 1)))


def test_audit_of_the_naive_plans(
    naive_plan: Callable[[str], Plan], naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    """Straight at the goal passes a metre from either obstacle, where 1.22 m are needed."""
    free = "rocket_navigation"
    assert rocket(free).audit(naive_plan(free), naive_reference(free)).passed
    blocked = "rocket_obstacles"
    audit = rocket(blocked).audit(naive_plan(blocked), naive_reference(blocked))
    assert [item.what for item in audit.failures] == [
        "missing clearance from obstacle 1",
        "missing clearance from obstacle 2",
    ]
    assert all(item.value == pytest.approx(0.22, abs=0.01) for item in audit.failures)


@pytest.mark.parametrize(
    ("spoil", "failure"),
    [
        (lambda plan: replace(plan, states=plan.states[:50], rewards=plan.rewards[:49]),
         "distance of the plan's end from the goal"),
        (lambda plan: replace(plan, timestep=0.04), "speed per axis"),
    ],
)  # fmt: skip
def test_audit_finds_what_is_wrong(
    spoil: Callable[[Plan], Plan], failure: str, naive_plan: Callable[[str], Plan]
) -> None:
    task = rocket()
    plan = spoil(naive_plan(task.name))
    audit = task.audit(plan, task.reference(plan))
    assert [item.what for item in audit.failures] == [failure]


# Imitation


@pytest.fixture(scope="module")
def straight() -> ReferenceMotion:
    """Straight from the start to the goal in 600 steps of 0.1 m."""
    qpos = np.linspace(0.0, 1.0, 601)[:, None] * np.array([*GOAL, 0.0])
    return ReferenceMotion("rocket_navigation", 1, 0.02, qpos, np.gradient(qpos, 0.02, axis=0))


def along(forward: float, left: float) -> np.ndarray:
    return forward * np.array([COS30, SIN30]) + left * np.array([-SIN30, COS30])


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        # exp(-0.625 x 2) (0.1 + 0.5 / 3 + 0.4 exp(-40))
        (along(20.0, 2.0), 0.2865047969 * 0.2666666667),
        # between two vertices: 0.5 x 20.03 / 60
        (along(20.03, -2.0), 0.2865047969 * 0.2669166667),
        (along(0.0, 0.0), 0.1),
        (along(-3.0, 0.0), 0.1533549623 * 0.1),  # exp(-0.625 x 3), behind the start
        (along(59.0, 0.0), 0.5916666667 + 0.4 * 0.3678794412),  # 0.1 + 0.5 x 59 / 60, exp(-1)
        (along(60.0, 0.0), 1.0),
        (along(64.0, 0.0), 0.0820849986),  # exp(-0.625 x 4), past the goal
    ],
)
def test_progress_reward(straight: ReferenceMotion, position: Any, expected: float) -> None:
    tracker = rocket().tracker(straight)
    at = state(position)
    action = np.zeros((1, 2))
    assert tracker.reward(at, action, at)[0] == pytest.approx(expected, rel=1e-6)
    hit = state(position, clearance=(-0.1, 3.0))
    assert tracker.reward(hit, action, hit)[0] == pytest.approx(expected - 0.25, rel=1e-6)
    assert tracker.max_reward == 1.2


@pytest.mark.parametrize(
    ("before", "advance"),
    [
        (along(19.9, 0.0), 0.1),
        (along(20.2, 1.0), -0.2),  # backwards, whatever the distance from the path
        (along(19.7, 0.0), 0.2),  # 15 m/s is paid as 10 m/s
        (along(15.0, 0.0), 0.2),  # faster than any rocket: a corner of the path was cut
        (along(25.0, 0.0), -0.5),
    ],
)
def test_advancing_is_paid_by_the_metre(
    straight: ReferenceMotion, before: Any, advance: float
) -> None:
    tracker = rocket().tracker(straight)
    at, action = state(along(20.0, 2.0)), np.zeros((1, 2))
    standing = tracker.reward(at, action, at)[0]
    assert tracker.reward(state(before), action, at)[0] == pytest.approx(standing + advance)


def test_the_papers_imitation_reward(straight: ReferenceMotion) -> None:
    """exp(-0.625 |x - xbar|) R - 0.25 I_collision."""
    task = rocket("rocket_obstacles")
    tracker = task.tracker(straight, "paper")
    assert tracker.max_reward == 0.9
    action = np.zeros((1, 2))
    # 50 m along and 2 m left: R = 0.9 exp(-0.25 x sqrt(104)) less two faint obstacle terms.
    position = along(50.0, 2.0)
    worth = 0.9 * math.exp(-0.25 * math.sqrt(104.0))
    worth -= 0.075 * math.exp(-0.5 * math.hypot(30.0, 1.0))
    worth -= 0.075 * math.exp(-0.5 * math.hypot(10.0, 3.0))
    clear, hit = state(position), state(position, clearance=(0.3, 0.0))
    expected = 0.2865047969 * worth
    assert tracker.reward(clear, action, clear)[0] == pytest.approx(expected, rel=1e-6)
    assert tracker.reward(hit, action, hit)[0] == pytest.approx(expected - 0.25, rel=1e-6)
    # At an obstacle R is negative, and so is the product.
    near = state(task.obstacles[0])
    assert tracker.reward(near, action, near)[0] == pytest.approx(
        math.exp(-0.625) * -0.0749625070, rel=1e-6
    )


def test_no_other_imitation_reward(straight: ReferenceMotion) -> None:
    with pytest.raises(TsbenchError, match=r"'progres'.*did you mean 'progress'"):
        rocket().tracker(straight, "progres")


def test_imitation_starts_along_the_reference(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    task = rocket()
    reference = naive_reference(task.name)
    tracker = task.tracker(reference)
    start = tracker.start(np.random.default_rng(1), 4000)
    frames = np.rint(start.time / task.timestep).astype(int)
    assert frames.max() < min(task.horizon, tracker.horizon)
    np.testing.assert_allclose(start.qpos[:, :2], reference.qpos[frames, :2], atol=1e-12)
    at_start = (frames == 0) & ~np.any(start.qvel, axis=-1)
    assert 0.22 < at_start.mean() < 0.28
    assert np.all(np.abs(start.qpos[:, 2]) <= 0.5)
    assert not np.any(start.qvel[:, 2])
    # Somewhere between rest and the reference's velocity.
    speed = np.linalg.norm(start.qvel, axis=-1)
    assert np.all(speed <= np.linalg.norm(reference.qvel[frames, :2], axis=-1) + 1e-9)


def test_projection_against_all_segments() -> None:
    """On a winding path of short segments, against the nearest point of every one of them."""
    t = np.linspace(0.0, 1.0, 300)
    points = np.stack([40.0 * t, 5.0 * np.sin(6.0 * t)], axis=-1)
    path = Path.through(np.repeat(points, 2, axis=0))  # standing still now and then
    assert len(path.vertices) == 300
    rng = np.random.default_rng(2)
    positions = points[rng.integers(0, 300, 200)] + rng.normal(0.0, 1.0, (200, 2))
    a, b = points[:-1], points[1:]
    lengths = np.linalg.norm(b - a, axis=-1)
    before = np.concatenate([[0.0], np.cumsum(lengths)])
    distance, progress = path.project(positions)
    for row, position in enumerate(positions):
        share = np.clip(((position - a) * (b - a)).sum(-1) / lengths**2, 0.0, 1.0)
        all_distances = np.linalg.norm(position - (a + share[:, None] * (b - a)), axis=-1)
        best = all_distances.argmin()
        assert distance[row] == pytest.approx(all_distances[best], abs=0.01)
        if all_distances[best] < 1.0:  # farther away two parts of the path may be as near
            expected = (before[best] + share[best] * lengths[best]) / before[-1]
            assert progress[row] == pytest.approx(expected, abs=0.005)


def test_projection_on_a_point() -> None:
    distance, progress = Path.through(np.zeros((5, 2))).project(np.array([[3.0, 4.0]]))
    assert (distance[0], progress[0]) == (5.0, 0.0)
