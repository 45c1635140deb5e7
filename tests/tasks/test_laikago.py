"""Laikago's rewards, endings, gaits and filter against numbers worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, freqz, lfilter
from scipy.spatial.transform import Rotation

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core import rotations
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.state import Start
from tsbench.sim.kinematic import naive_plan
from tsbench.sim.model import compiled
from tsbench.sim.physics import Physics
from tsbench.tasks import laikago
from tsbench.tasks.laikago import Laikago, LaikagoCourse, LaikagoState
from tsbench.testing.episodes import Case, compare, ending

GAITS = ("laikago_walk", "laikago_trot")
SOLE = 0.0265  # m, from a foot's centre down
STANDING = np.array(  # foot centres under their hips, FR FL RR RL
    [
        [0.21935, -0.1245, SOLE],
        [0.21935, 0.1245, SOLE],
        [-0.21935, -0.1245, SOLE],
        [-0.21935, 0.1245, SOLE],
    ]
)


def make(name: str, **constants: Any) -> Laikago:
    task = tasks.make(name, **constants)
    assert isinstance(task, Laikago)
    return task


def state(
    time: float = 0.0,
    base: Any = (0.0, 0.0, 0.42),
    feet: Any = STANDING,
    com_height: float = 0.41,
    orientation: Any = (1.0, 0.0, 0.0, 0.0),
) -> LaikagoState:
    base = np.array([base], float)
    return LaikagoState(
        time=np.array([time]),
        joint_position=np.zeros((1, 12)),
        joint_velocity=np.zeros((1, 12)),
        base_position=base,
        base_orientation=np.array([orientation], float),
        base_velocity=np.zeros((1, 3)),
        base_angular_velocity=np.zeros((1, 3)),
        feet=np.array([feet], float),
        com=np.array([[base[0, 0], base[0, 1], com_height]]),
        filter=np.zeros((1, 48)),
    )


def moved(leg: int, **shift: float) -> np.ndarray:
    """Standing feet, one of them shifted along x, y or z."""
    feet = STANDING.copy()
    for axis, metres in shift.items():
        feet[leg, "xyz".index(axis)] += metres
    return feet


FR, FL, RR, RL = range(4)
NOMINAL = np.array([0.0, 0.67, -1.33] * 4)
STEP = 1 / 30


def terms(task: Laikago, previous: LaikagoState, after: LaikagoState) -> list[float]:
    action = np.zeros((1, 12))
    values = [float(term[0]) for term in task.reward_terms(previous, action, after).values()]
    reward = task.reward(previous, action, after)[0]
    assert reward == pytest.approx(values[0] * values[1] * values[2] * values[3])
    return values


# The task's constants


@pytest.mark.parametrize(
    ("name", "distance", "speed"), [("laikago_walk", 1.25, 0.264), ("laikago_trot", 3.0, 0.63)]
)
def test_constants(name: str, distance: float, speed: float) -> None:
    task = make(name)
    assert (task.version, task.substeps, task.max_reward) == (1, 20, 1.0)
    assert (task.observation_size, task.action_size) == (43, 12)
    assert task.timestep == pytest.approx(STEP)
    assert task.distance == distance
    assert task.horizon == 180  # six seconds: 60 planning steps
    assert distance / speed == pytest.approx(0.8 * 6.0, rel=0.02)  # who lags arrives too
    model = task.spec().compile()
    assert model.opt.timestep * task.substeps == pytest.approx(task.timestep)
    np.testing.assert_allclose(model.site("goal").pos[:2], [distance, 0.0])


@pytest.mark.parametrize(("distance", "horizon"), [(1.0, 60), (2.0, 120), (5.0, 300)])
def test_the_horizon_grows_with_the_distance(distance: float, horizon: int) -> None:
    assert make("laikago_trot", distance=distance).horizon == horizon


def test_the_least_cycles_of_a_gait() -> None:
    """They decide `solved_reward`, but no hash of constants tells another number, because the kept
    entries have that hash. So another number needs another version of the tasks."""
    assert (laikago.LEAST_CYCLES, make("laikago_walk").version) == (2, 1)


def test_it_does_not_start_at_its_goal() -> None:
    with pytest.raises(TsbenchError, match=r"the distance must lie between 0.1 and 1000 m$"):
        make("laikago_trot", distance=0.1)
    assert len(naive_plan(make("laikago_trot", distance=0.11)).rewards) >= 1


# Reward


@pytest.mark.parametrize(
    ("name", "base", "expected"),
    [
        ("laikago_walk", (0.0, 0.0, 0.42), 0.04393693),  # exp(-2.5 x 1.25) = exp(-3.125)
        ("laikago_trot", (0.0, 0.0, 0.42), 5.530844e-04),  # exp(-7.5)
        ("laikago_walk", (1.25, 0.0, 0.3), 1.0),  # on the ground plane: height is nothing
        ("laikago_walk", (0.85, 0.3, 0.42), 0.2865048),  # 0.4 before, 0.3 beside: exp(-1.25)
        ("laikago_walk", (1.65, -0.3, 0.42), 0.2865048),
    ],
)
def test_r_dist(name: str, base: Any, expected: float) -> None:
    at = state(base=base)
    assert terms(make(name), at, at)[0] == pytest.approx(expected, rel=1e-3)


# In the walk at 0.1 s only FL swings: phases .375, .875, .625, .125 with a duty of .75.
@pytest.mark.parametrize(
    ("time", "feet", "expected"),
    [
        (0.1, moved(FR, x=0.003, y=0.004), 0.9512294),  # exp(-10 x 0.005)
        (0.1, moved(FR, x=-0.003, z=0.004), 0.9704455),  # only horizontally: exp(-0.03)
        (0.1, moved(FL, x=0.05, y=0.05), 1.0),  # in swing
        (
            0.1,
            STANDING + np.array([0.0088, 0.0, 0.0]),
            0.7679733,
        ),  # dragging all: exp(-10 x 3 x 0.0088)
        (0.2, moved(FL, x=0.05), 1.0),  # FL touches down at 0.2 s: it was in the air before
        (0.2 + STEP, moved(FL, x=0.05), 0.6065307),  # exp(-0.5)
    ],
)
def test_r_ns(time: float, feet: np.ndarray, expected: float) -> None:
    task = make("laikago_walk")
    assert terms(task, state(time - STEP), state(time, feet=feet))[1] == pytest.approx(expected)


def test_dragging_in_trot() -> None:
    """Two feet are in stance: exp(-10 x 2 x 0.021)."""
    before, after = state(0.1 - STEP), state(0.1, feet=STANDING + np.array([0.021, 0.0, 0.0]))
    assert terms(make("laikago_trot"), before, after)[1] == pytest.approx(0.6570468)


@pytest.mark.parametrize(
    ("name", "time", "feet", "expected"),
    [
        ("laikago_walk", 0.1, STANDING, 0.1353353),  # FL should be 0.1 m up: exp(-20 x 0.1)
        ("laikago_walk", 0.1, moved(FL, z=0.1), 1.0),
        ("laikago_walk", 0.1, moved(FL, z=0.13), 0.5488116),  # exp(-20 x 0.03)
        ("laikago_walk", 0.1, moved(FR, z=-0.02), 0.0907180),  # exp(-20 x (0.1 + 0.02))
        ("laikago_walk", 0.0, moved(FL, z=0.1), 1.0),  # it lifts off at the start
        ("laikago_trot", 0.1, STANDING, 0.01831564),  # two should be up: exp(-4)
    ],
)
def test_r_ee_z(name: str, time: float, feet: np.ndarray, expected: float) -> None:
    at = state(time, feet=feet)
    assert terms(make(name), at, at)[2] == pytest.approx(expected, rel=1e-6)


def test_r_ee_x() -> None:
    feet = STANDING.copy()
    feet[:, 0] += [0.01, -0.02, 0.0, 0.03]
    feet[:, 1] += 0.3
    values = terms(make("laikago_walk"), state(0.1 - STEP), state(0.1, feet=feet))
    assert values[3] == pytest.approx(0.7866279)  # exp(-4 x 0.06)


def test_reward_is_the_product() -> None:
    """Walk, 0.1 s, 0.5 m from the goal; FR slips 1 cm forward, FL is 9 cm up."""
    feet = moved(FL, z=0.09)
    feet[FR, 0] += 0.01
    before = state(0.1 - STEP, base=(0.75, 0.0, 0.42))
    after = state(0.1, base=(0.75, 0.0, 0.42), feet=feet)
    reward = make("laikago_walk").reward(before, np.zeros((1, 12)), after)[0]
    # exp(-2.5 x 0.5 - 10 x 0.01 - 20 x 0.01 - 4 x 0.01) = exp(-1.59)
    assert reward == pytest.approx(0.2039256, rel=1e-6)


# Gaits


def schedule(name: str, rate: float, cycles: int) -> list[str]:
    """One string for each leg, # in stance, with a clock that runs as the simulation's does."""
    task = make(name)
    time, rows = np.zeros(1), []
    for _ in range(round(cycles * task.gait.period * rate)):
        rows.append(task.gait.contacts(time)[0])
        time = time + 1 / rate
    return ["".join("#" if stands else "." for stands in leg) for leg in np.array(rows).T]


@pytest.mark.parametrize(
    ("name", "rate", "expected"),
    [
        # A foot stands from touchdown on, and at lift-off no longer.
        (
            "laikago_walk",
            30,  # 24 frames; swings of 0.2 s, in the order FL, RR, FR, RL
            [
                "############......######",
                "......##################",
                "######......############",
                "##################......",
            ],
        ),
        (
            "laikago_trot",
            30,  # 16 frames; swings of 0.267 s, FL with RR and FR with RL
            [
                "########........",
                "........########",
                "........########",
                "########........",
            ],
        ),
        ("laikago_walk", 10, ["####..##", "..######", "##..####", "######.."]),
    ],
)
def test_contact_schedule(name: str, rate: float, expected: list[str]) -> None:
    assert schedule(name, rate, 1) == expected
    assert schedule(name, rate, 40) == [leg * 40 for leg in expected]


@pytest.mark.parametrize(
    ("name", "duty", "speed", "foot_speed", "radius"),
    [("laikago_walk", 0.75, 0.264, 1.65, 0.48), ("laikago_trot", 0.5, 0.63, 1.26, 0.50)],
)
def test_both_speeds_are_reached_together(
    name: str, duty: float, speed: float, foot_speed: float, radius: float
) -> None:
    gait = make(name).gait
    assert (gait.duty, gait.base_speed) == (duty, speed)
    assert (gait.foot_speed, gait.leg_length) == (foot_speed, radius)
    # What a swing foot gains on the base, the base gains on a stance foot.
    assert foot_speed * radius * (1 - duty) == pytest.approx(speed * duty)


# Observation


def test_observation() -> None:
    rng = np.random.default_rng(0)
    at = replace(
        state(1.2, base=(0.4, -0.3, 0.41)),
        joint_position=rng.normal(size=(1, 12)),
        joint_velocity=rng.normal(size=(1, 12)),
        base_orientation=np.array([[0.5, 0.5, -0.5, 0.5]]),
        base_velocity=np.array([[1.0, 2.0, 3.0]]),
        base_angular_velocity=np.array([[4.0, 5.0, 6.0]]),
    )
    expected = [
        *at.joint_position[0],
        *at.joint_velocity[0],
        *(0.4, -0.3, 0.41),
        *(0.5, 0.5, -0.5, 0.5),
        *(1.0, 2.0, 3.0),
        *(4.0, 5.0, 6.0),
        0.2,  # of six seconds
        *(0.0, -1.0),  # one and a half cycles of 0.8 s
        *(0.85, 0.3),
        0.9013878,  # sqrt(0.7225 + 0.09)
    ]
    task = make("laikago_walk")
    np.testing.assert_allclose(task.observation(at)[0], expected, atol=1e-6)
    other_sign = replace(at, base_orientation=-at.base_orientation)
    np.testing.assert_array_equal(task.observation(other_sign), task.observation(at))


# Endings

D = 1.25


@pytest.mark.parametrize(
    ("base", "com_height", "reached", "violated", "terminal"),
    [
        ((0.0, 0.0, 0.42), 0.41, False, False, False),
        ((D - 0.1001, 0.0, 0.42), 0.41, False, False, False),
        ((D - 0.0999, 0.0, 0.42), 0.41, True, False, True),
        ((D, 0.0999, 0.42), 0.41, True, False, True),
        ((-0.0999, 0.0, 0.42), 0.41, False, False, False),
        ((-0.1001, 0.0, 0.42), 0.41, False, False, True),
        ((D, D + 0.0999, 0.42), 0.41, False, False, False),
        ((D, D + 0.1001, 0.42), 0.41, False, False, True),
        ((0.0, 0.0, 0.42), 0.3201, False, False, False),
        ((0.0, 0.0, 0.42), 0.3199, False, True, True),
        ((0.0, 0.0, 0.30), 0.3201, False, False, False),  # it is the CoM that counts
    ],
)
def test_endings(
    base: Any, com_height: float, reached: bool, violated: bool, terminal: bool
) -> None:
    task = make("laikago_walk")
    at = state(base=base, com_height=com_height)
    assert task.reached(at).tolist() == [reached]
    assert task.violated(at).tolist() == [violated]
    assert task.terminal(at).tolist() == [terminal]


# Footfall


def course(stance: float, swing: float, violated: bool = False, walked: float = 1.0) -> Any:
    """Of an episode whose feet did as scheduled in these shares of its stance and swing."""
    return LaikagoCourse(
        violated=np.array([violated]),
        nearest=np.array([0.0]),
        stance=np.array([0.5 * walked]),
        stance_kept=np.array([0.5 * walked * stance]),
        swing=np.array([0.5 * walked]),
        swing_kept=np.array([0.5 * walked * swing]),
    )


@pytest.mark.parametrize(
    ("base_x", "at", "solved"),
    [
        (D - 0.0999, course(0.9, 0.7001), True),
        (D - 0.1001, course(1.0, 1.0), False),  # not there
        (D, course(0.9, 0.6999), False),  # the mean of both shares is below 0.8
        (D, course(1.0, 0.0), False),  # dragged
        (D, course(1.0, 1.0, violated=True), False),
        (D, course(1.0, 1.0, walked=0.0), False),  # nothing says how it got there
    ],
)
def test_success(base_x: float, at: LaikagoCourse, solved: bool) -> None:
    there = state(base=(base_x, 0.0, 0.42), time=2.0)
    assert make("laikago_walk").success(there, at).tolist() == [solved]


@pytest.mark.parametrize(
    ("name", "distance", "steps", "solved"),
    [
        ("laikago_walk", 1.25, 47, False),  # two cycles of 0.8 s are 48 control steps
        ("laikago_walk", 1.25, 48, True),
        ("laikago_trot", 3.0, 31, False),  # two cycles of 0.533 s are 32
        ("laikago_trot", 3.0, 32, True),
        ("laikago_walk", 0.2, 10, False),  # 0.1 m at 0.264 m/s are 11.4 steps
        ("laikago_walk", 0.2, 11, True),
    ],
)
def test_a_lunge_is_not_a_gait(name: str, distance: float, steps: int, solved: bool) -> None:
    there = state(base=(distance, 0.0, 0.42), time=steps / 30)
    task = make(name, distance=distance)
    assert task.success(there, course(1.0, 1.0)).tolist() == [solved]


@pytest.mark.parametrize(
    ("stance", "swing", "quality"),
    [(1.0, 1.0, 1.0), (0.9, 0.8, 0.7), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.1, 0.2, 0.0)],
)
def test_what_a_spared_step_is_worth(stance: float, swing: float, quality: float) -> None:
    """Twice the agreement less one, and never less than nothing."""
    assert make("laikago_trot").quality(course(stance, swing))[0] == pytest.approx(quality)


def test_footfall_by_hand() -> None:
    """Trot, 0.1 s: FR and RL are to stand, FL and RR to swing. Only ground that is gained counts,
    and a sole is on the ground below 1 cm."""
    task = make("laikago_trot")

    def at(x: float, feet: np.ndarray = STANDING) -> LaikagoState:
        return state(0.1, base=(x, 0.0, 0.42), feet=feet)

    so_far = task.begun(at(0.0))
    assert task.footfall(so_far)[0] == 0.0
    so_far = task.followed(so_far, at(0.0), at(0.02))  # dragged
    assert task.footfall(so_far)[0] == pytest.approx(0.5)
    raised = moved(FL, z=0.0101) + moved(RR, z=0.0099) - STANDING  # one of the two swings
    so_far = task.followed(so_far, at(0.02), at(0.08, raised))  # three times as far
    assert task.footfall(so_far)[0] == pytest.approx(0.5 * (1.0 + 0.75 * 0.5))
    # What is not gained does not count: standing still, going back, coming to where one was.
    perfect = moved(FL, z=0.1) + moved(RR, z=0.1) - STANDING
    for before, after in ((0.08, 0.08), (0.08, 0.03), (0.03, 0.08)):
        so_far = task.followed(so_far, at(before), at(after, perfect))
    assert task.footfall(so_far)[0] == pytest.approx(0.5 * (1.0 + 0.75 * 0.5))
    assert so_far.nearest[0] == pytest.approx(task.distance - 0.08)
    flying = STANDING + np.array([0.0, 0.0, 0.05])
    so_far = task.followed(so_far, at(0.08), at(0.16, flying))
    assert task.footfall(so_far)[0] == pytest.approx(0.5 * (0.5 + (0.375 + 1.0) / 2))
    assert not so_far.violated[0]
    fallen = replace(at(0.17), com=np.array([[0.17, 0.0, 0.31]]))
    assert task.followed(so_far, at(0.16), fallen).violated[0]


# Measures


def test_work_by_hand() -> None:
    """Two joints of FR turn at 1 and -2 rad/s, 0.1 rad short of their held targets: the thigh's
    220 x 0.1 - 2 x 1 = 20 N m; the calf's 220 x 0.1 + 2 x 2 = 26 N m. The abduction of FL turns at
    3 rad/s and is asked for 220 x 0.2 - 0.3 x 3 = 43.1 N m, of which its motor gives 18.954."""
    task = make("laikago_walk")
    at = state()
    position, velocity = np.tile(NOMINAL, (1, 1)), np.zeros((1, 12))
    position[0, [1, 2, 3]] -= [0.1, 0.1, 0.2]
    velocity[0, [1, 2, 3]] = [1.0, -2.0, 3.0]
    at = replace(at, joint_position=position, joint_velocity=velocity)
    work = task.work(at, np.zeros((1, 12)))
    assert work[0] == pytest.approx((20.0 + 52.0 + 3.0 * 18.954) / 30.0)


def test_what_a_step_measures() -> None:
    """Without the distance, the reward of `test_reward_is_the_product`: exp(-0.34)."""
    task, feet = make("laikago_walk"), moved(FL, z=0.09)
    feet[FR, 0] += 0.01
    before, after = state(0.1 - STEP), state(0.1, feet=feet)
    found = task.measured(before, np.zeros((1, 12)), after)
    assert found["gait"][0] == pytest.approx(math.exp(-0.34))
    assert found["work"][0] == task.work(before, np.zeros((1, 12)))[0]
    assert set(task.measured(before, None, after)) == {"gait"}


def test_measures_by_hand() -> None:
    """Of two walks of 60 steps: 1.2 m in 2 s, to the goal, and a few centimetres."""
    task = make("laikago_walk")
    first = state(base=(0.0, 0.0, 0.42)).rows([0, 0])
    last = LaikagoState.joined(
        [state(2.0, base=(1.2, 0.0, 0.42)), state(2.0, base=(0.03, 0.04, 0.42))]
    )
    both = LaikagoCourse.joined([course(0.9, 0.8), course(1.0, 0.0)])
    sums = {"gait": np.array([30.0, 15.0]), "work": np.array([299.0, 10.0])}
    found = task.measures(first, last, both, sums, np.array([60, 60]))
    assert list(found) == list(task.measure_notes)
    expected = {
        "footfall agreement": [0.85, 0.5],
        "time to the goal, s": [2.0, math.nan],
        "speed over the gait's bound": [0.6 / 0.264, 0.025 / 0.264],
        "gait": [0.5, 0.25],
        "cost of transport": [299.0 / (25.433 * 9.81 * 1.2), math.nan],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-6, err_msg=name)
    spoiled = both.replace(violated=np.array([True, False]))
    found = task.measures(first, last, spoiled, sums, np.array([60, 60]))
    assert np.isnan(found["time to the goal, s"]).all()  # it arrived by falling
    del sums["work"]
    assert "cost of transport" not in task.measures(first, last, both, sums, np.array([60, 60]))


VARIANTS: tuple[tsbench.Variant | None, ...] = (None, *tsbench.VARIANTS)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", GAITS)
def test_both_endings_happen(name: str, variant: tsbench.Variant | None) -> None:
    """A standing robot lasts to the horizon. Folded legs fall, and a plan strays from the goal."""
    environment = Case(name, variant).load(seed=3, perturbed=False)
    if variant == "planning":
        still, away = np.zeros(7), -np.ones(7)
    else:
        still, away = np.zeros(12), np.where(np.arange(12) % 3 == 1, 1.0, -1.0)
    # An imitation begins anywhere along its reference.
    assert not all(ending(environment, lambda: still) for _ in range(20))
    assert any(ending(environment, lambda: away) for _ in range(20))


@pytest.mark.parametrize("name", GAITS)
def test_both_simulations_agree_to_the_horizon(name: str) -> None:
    task = make(name)
    starts = task.start(np.random.default_rng(11), 3, perturbed=True)
    assert compare(task, starts, np.zeros((task.horizon, 3, 12))) == [task.horizon] * 3


# Action and filter


def controls(actions: np.ndarray, start: LaikagoState | None = None) -> np.ndarray:
    """Joint targets (T, 12) for a sequence of actions."""
    task, at, targets = make("laikago_walk"), start or state(), []
    for action in actions:
        target, memory = task.control(at, action[None])
        at = replace(at, filter=memory)
        targets.append(target[0])
    return np.array(targets)


def test_filter_is_a_butterworth_low_pass() -> None:
    b, a = butter(2, 4.0, fs=30.0)
    np.testing.assert_allclose(laikago.C.filter_b, b, rtol=1e-12)
    np.testing.assert_allclose([1.0, *laikago.C.filter_a], a, rtol=1e-12)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 12))
    expected = NOMINAL + lfilter(b, a, 0.75 * actions, axis=0)
    np.testing.assert_allclose(controls(actions), expected, atol=1e-12)


def test_filter_response() -> None:
    """Gain 1 at rest and 1 / sqrt(2), which is -3 dB, at 4 Hz."""
    _, response = freqz(laikago.C.filter_b, [1.0, *laikago.C.filter_a], worN=[0.0, 4.0], fs=30.0)
    np.testing.assert_allclose(np.abs(response), [1.0, 0.7071068], rtol=1e-6)
    time = np.arange(300) / 30
    wave = np.tile(np.sin(2 * np.pi * 4.0 * time)[:, None], (1, 12))
    settled = controls(wave)[-150:] - NOMINAL  # twenty whole waves
    amplitude = np.sqrt(2.0 * np.mean(settled**2, axis=0))
    np.testing.assert_allclose(amplitude, 0.75 * 0.7071068, rtol=1e-3)
    # A held action is reached, the first step gives b0 of it, and no action exceeds the box.
    held = controls(np.full((90, 12), 5.0))
    np.testing.assert_allclose(held[0], NOMINAL + 0.108447 * 0.75, atol=1e-6)
    np.testing.assert_allclose(held[-1], NOMINAL + 0.75, atol=1e-9)


def test_filter_starts_settled() -> None:
    """The action that holds a start's joints holds them from the first step on."""
    task = make("laikago_trot")
    start = task.start(np.random.default_rng(3), 1, perturbed=True)
    joints = start.qpos[0, 7:]
    assert np.abs(joints - NOMINAL).max() > 0.01
    at = replace(state(), filter=start.memory)
    hold = np.tile((joints - NOMINAL) / 0.75, (20, 1))
    np.testing.assert_allclose(controls(hold, at), np.tile(joints, (20, 1)), atol=1e-12)


# Starts


def test_starts() -> None:
    task = make("laikago_walk")
    fixed = task.start(np.random.default_rng(0), 2)
    np.testing.assert_allclose(fixed.qpos[:, 7:], [NOMINAL] * 2)
    np.testing.assert_allclose(fixed.qpos[:, :7], [[0, 0, 0.42, 1, 0, 0, 0]] * 2, atol=2e-3)
    assert not np.any(fixed.qvel)
    assert not np.any(fixed.memory)

    count = 2000
    near = task.start(np.random.default_rng(0), count, perturbed=True)
    np.testing.assert_allclose(np.linalg.norm(near.qpos[:, 3:7], axis=-1), 1.0)
    turn = Rotation.from_quat(near.qpos[:, [4, 5, 6, 3]]).as_rotvec()
    uniform = {
        "joints": (near.qpos[:, 7:] - NOMINAL, 0.05),
        "turn": (turn, 0.05),
        "velocity": (near.qvel[:, :3], 0.1),
        "angular velocity": (near.qvel[:, 3:6], 0.2),
        "joint velocity": (near.qvel[:, 6:], 0.2),
    }
    for what, (values, bound) in uniform.items():
        assert np.abs(values).max() <= bound * (1 + 1e-9), what
        assert np.all(values.max(axis=0) > 0.97 * bound), what
        assert np.all(values.min(axis=0) < -0.97 * bound), what
        assert np.allclose(values.std(axis=0), bound / math.sqrt(3.0), rtol=0.06), what
    assert not np.any(near.qpos[:, :2])
    # It stands on the ground: no sole in it, nor the lowest one far above.
    physics = Physics(task, count, threads=1)
    lowest = physics.place(np.arange(count), near).feet[..., 2].min(axis=-1) - SOLE
    assert lowest.min() > -1e-3
    assert lowest.max() < 0.03


# From plan to reference motion


@pytest.mark.parametrize("name", GAITS)
def test_reference_of_the_naive_plan(
    name: str, naive_plan: Callable[[str], Plan], naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    task, plan, reference = make(name), naive_plan(name), naive_reference(name)
    times = np.arange(reference.steps + 1) * STEP
    assert reference.steps == task.horizon
    planned = len(plan.times)
    assert planned < task.horizon  # it arrives early, and the reference goes on
    np.testing.assert_array_equal(reference.tracked["contacts"], task.gait.contacts(times))
    # The base moves straight ahead at top speed once the feet have left their place under the hips.
    speed = task.gait.base_speed
    np.testing.assert_allclose(reference.qpos[:planned, 0], speed * times[:planned], atol=0.03)
    np.testing.assert_allclose(reference.qpos[:, 1:3], [[0.0, 0.42]] * len(times), atol=1e-3)
    np.testing.assert_allclose(reference.qvel[60 : planned - 1, 0], speed, atol=1e-9)
    # Then it slows down to the goal, and steps in place there.
    beyond = reference.qvel[planned - 1 :, 0]
    assert np.diff(beyond).max() < 0.01
    assert np.abs(beyond[-10:]).max() < 0.01
    np.testing.assert_allclose(reference.qpos[-1, :2], [task.distance, 0.0], atol=2e-3)
    cycle = round(task.gait.period * 30)
    hips = STANDING[:, 0] + task.distance
    np.testing.assert_allclose(reference.tracked["feet"][-cycle:, :, 0], [hips] * cycle, atol=0.02)
    # Feet rest in stance, and in swing rise in a half sine of 10 cm and go forward.
    soles = reference.tracked["feet"][..., 2] - SOLE
    assert np.abs(soles[reference.tracked["contacts"]]).max() < 2e-4
    steps = np.diff(reference.tracked["feet"][..., 0], axis=0)
    stance = reference.tracked["contacts"][1:] & reference.tracked["contacts"][:-1]
    assert np.abs(steps[stance]).max() < 3e-4
    assert steps[: planned - 1][~stance[: planned - 1]].min() > -3e-4
    assert steps[~stance].min() > -3e-3  # at the goal they settle under their hips
    share = (task.gait.phase(times) - task.gait.duty) / (1.0 - task.gait.duty)
    wanted = 0.1 * np.sin(np.pi * np.clip(share, 0.0, 1.0))
    assert np.abs(soles - wanted)[~reference.tracked["contacts"]].max() < 2e-4
    # The feet are those of the pose, and velocities are central differences.
    joints = reference.qpos[:, 7:]
    np.testing.assert_allclose(
        reference.qvel[1:-1, 6:], (joints[2:] - joints[:-2]) / (2 * STEP), atol=1e-9
    )
    physics = Physics(task, len(times), threads=1)
    memory = np.zeros((len(times), 48))
    posed = physics.place(
        np.arange(len(times)), Start(times, reference.qpos, reference.qvel, memory)
    )
    np.testing.assert_allclose(posed.feet, reference.tracked["feet"], atol=1e-9)
    np.testing.assert_allclose(posed.com, reference.tracked["com"], atol=1e-9)
    low, high = compiled("laikago").jnt_range[1:].T
    assert np.all((joints > low) & (joints < high))


def test_a_swing_by_hand(
    naive_plan: Callable[[str], Plan], naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    """Trot, FL lifts off at frame 0 and touches down at frame 8; frame 2 is a quarter of the way.

    The foot starts under its hip. Then it stands at its planned position until frame 16.
    """
    plan, reference = naive_plan("laikago_trot"), naive_reference("laikago_trot")
    planned = np.interp(reference.times, plan.times, plan.states[:, 3 + 3 * FL])
    touchdown = planned[8]
    assert touchdown > 0.35
    np.testing.assert_allclose(planned[8:16], touchdown, atol=1e-9)
    # It stands at the mean from touchdown to lift-off, where the plan's foot has begun to move.
    stands = planned[8:17].mean()
    assert stands == pytest.approx(touchdown, abs=0.006)
    # Eased as s^2 (3 - 2 s) = 2.5 / 16, raised by 0.1 sin(45 degrees).
    quarter = 0.21935 + 0.15625 * (stands - 0.21935)
    expected = [quarter, 0.1245, SOLE + 0.0707107]
    np.testing.assert_allclose(reference.tracked["feet"][2, FL], expected, atol=2e-4)
    np.testing.assert_allclose(reference.tracked["feet"][8:17, FL, 0], stands, atol=2e-4)


@pytest.mark.parametrize("name", GAITS)
def test_audit_passes_the_naive_plan(
    name: str, naive_plan: Callable[[str], Plan], naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    assert make(name).audit(naive_plan(name), naive_reference(name)).passed


def _slipping(plan: Plan, reference: ReferenceMotion) -> tuple[Plan, ReferenceMotion]:
    states = plan.states.copy()
    states[:, 3] = states[:, 0] + STANDING[0, 0]  # FR is dragged along
    changed = replace(plan, states=states)
    return changed, make("laikago_trot").reference(changed)


def _bent(plan: Plan, reference: ReferenceMotion) -> tuple[Plan, ReferenceMotion]:
    qpos = reference.qpos.copy()
    qpos[50, 9] = -0.61  # a calf that is stretched too far
    return plan, replace(reference, qpos=qpos)


def offset(reference: ReferenceMotion, name: str, by: float) -> ReferenceMotion:
    tracked = {**reference.tracked, name: reference.tracked[name] + by}
    return replace(reference, tracked=tracked)


def _flat(plan: Plan, reference: ReferenceMotion) -> tuple[Plan, ReferenceMotion]:
    feet = reference.tracked["feet"].copy()
    feet[:, RR, 2] = SOLE
    return plan, replace(reference, tracked={**reference.tracked, "feet": feet})


@pytest.mark.parametrize(
    ("spoil", "failure"),
    [
        (lambda p, r: (replace(p, states=p.states[:31], rewards=p.rewards[:30]), r),
         "distance of the plan's end from the goal"),
        (_slipping, "mean slip of a foot in stance"),
        (_bent, "joint angle beyond its limit"),
        (lambda p, r: (p, replace(r, qvel=3.0 * r.qvel)), "joint speed"),
        (lambda p, r: (p, offset(r, "feet", 0.003)), "inverse kinematics error"),
        (_flat, "missing swing clearance"),
        (lambda p, r: (p, offset(r, "com", 0.2)), "mean distance of CoM from support"),
    ],
)  # fmt: skip
def test_audit_finds_what_is_wrong(
    spoil: Callable[[Plan, ReferenceMotion], tuple[Plan, ReferenceMotion]],
    failure: str,
    naive_plan: Callable[[str], Plan],
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    name = "laikago_trot"
    plan, reference = spoil(naive_plan(name), naive_reference(name))
    failures = [item.what for item in make(name).audit(plan, reference).failures]
    assert failure in failures
    # A shorter plan also differs from its reference; a foot held down also misses its target.
    assert len(failures) <= 2


@pytest.mark.filterwarnings("error")
def test_a_foot_that_never_stands_does_not_slip(naive_plan: Callable[[str], Plan]) -> None:
    """Two feet of the trot swing in the first half of a cycle, which has 16 samples."""
    task, plan = make("laikago_trot"), naive_plan("laikago_trot")
    short = replace(plan, states=plan.states[:6], rewards=plan.rewards[:5])
    items = task.audit(short, task.reference(short)).items
    (slip,) = (item.value for item in items if "slip" in item.what)
    assert slip == pytest.approx(0.0, abs=1e-9)


def test_a_plan_of_tiny_steps_is_refused(naive_plan: Callable[[str], Plan]) -> None:
    """It would go on to the horizon for days."""
    plan = replace(naive_plan("laikago_trot"), timestep=1e-9)
    with pytest.raises(TsbenchError, match=r"plan has a time step of 1e-09 s, which does not fit"):
        make("laikago_trot").check_fit(plan)


@pytest.mark.parametrize("name", GAITS)
def test_audit_finds_dragged_feet(name: str, naive_plan: Callable[[str], Plan]) -> None:
    """The feet of the plan stay under their hips, also in stance."""
    task, plan = make(name), naive_plan(name)
    states = plan.states.copy()
    states[:, 3::3] = states[:, :1] + STANDING[:, 0]
    dragging = replace(plan, states=states)
    audit = task.audit(dragging, task.reference(dragging))
    assert any("slip" in item.what for item in audit.failures)


# Imitation


def on_reference(
    task: Laikago, reference: ReferenceMotion, frame: int, qpos: np.ndarray | None = None
) -> LaikagoState:
    """The state of a robot in the pose of a reference frame, or in `qpos` at its time."""
    physics = Physics(task, 1, threads=1)
    qpos = reference.qpos[frame] if qpos is None else qpos
    time = np.array([frame * STEP])
    memory = np.zeros((1, 48))
    return physics.place(np.array([0]), Start(time, qpos[None], reference.qvel[[frame]], memory))


def tracked(task: Laikago, reference: ReferenceMotion, at: LaikagoState) -> float:
    return float(task.tracker(reference).reward(at, np.zeros((1, 12)), at)[0])


@pytest.mark.parametrize("name", GAITS)
@pytest.mark.parametrize("frame", [0, 1, 77, -1])
def test_the_reference_itself_gets_everything(
    name: str, frame: int, naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    task, reference = make(name), naive_reference(name)
    at = on_reference(task, reference, frame % (reference.steps + 1))
    assert tracked(task, reference, at) == pytest.approx(1.0, abs=1e-9)
    assert task.tracker(reference).max_reward == 1.0
    assert task.tracker(reference).horizon == reference.steps


def test_tracking_terms(naive_reference: Callable[[str], ReferenceMotion]) -> None:
    task, reference = make("laikago_trot"), naive_reference("laikago_trot")
    at = on_reference(task, reference, 40)
    off = {
        # 0.65 exp(-2 x 12 x 0.01) + 0.35
        "joint_position": (at.joint_position + 0.1, 0.8613081),
        # 0.65 + 0.1 exp(-0.1 x 12) + 0.25
        "joint_velocity": (at.joint_velocity - 1.0, 0.9301194),
        # 0.65 + 0.1 + 0.15 exp(-40 x 4 x 0.0004) + 0.1
        "feet": (at.feet + np.array([0.0, 0.02, 0.0]), 0.9907007),
        # 0.9 + 0.1 exp(-10 x 0.0025)
        "com": (at.com + np.array([0.0, 0.0, 0.05]), 0.9975310),
    }
    for field, (value, expected) in off.items():
        assert tracked(task, reference, at.replace(**{field: value})) == pytest.approx(expected)
    # The base position by itself costs nothing: feet are relative to it, and the CoM is given.
    ahead = at.replace(base_position=at.base_position + 0.5, feet=at.feet + 0.5)
    assert tracked(task, reference, ahead) == pytest.approx(1.0)


def test_a_turned_robot_loses_only_its_orientation(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    """Yaw by 0.2 rad: 0.65 exp(-2 x 0.04) + 0.35, since feet are in the heading frame."""
    task, reference = make("laikago_trot"), naive_reference("laikago_trot")
    qpos = reference.qpos[40].copy()
    qpos[3:7] = [math.cos(0.1), 0.0, 0.0, math.sin(0.1)]
    at = on_reference(task, reference, 40, qpos)
    at = at.replace(com=reference.tracked["com"][[40]])
    assert tracked(task, reference, at) == pytest.approx(0.65 * 0.9231163 + 0.35)
    # Roll is not heading: it also shows in the feet.
    qpos[3:7] = [math.cos(0.1), math.sin(0.1), 0.0, 0.0]
    rolled = on_reference(task, reference, 40, qpos).replace(com=reference.tracked["com"][[40]])
    assert tracked(task, reference, rolled) < 0.65 * 0.9231163 + 0.33


def test_tracking_ends_at_a_fall(naive_reference: Callable[[str], ReferenceMotion]) -> None:
    task = make("laikago_trot")
    terminal = task.tracker(naive_reference("laikago_trot")).terminal

    def tilted(degrees: float, axis: int) -> tuple[float, ...]:
        half = math.radians(degrees) / 2
        vector = [0.0, 0.0, 0.0]
        vector[axis] = math.sin(half)
        return (math.cos(half), *vector)

    for axis in (0, 1):
        assert not terminal(state(orientation=tilted(89.0, axis)))[0]
        assert terminal(state(orientation=tilted(91.0, axis)))[0]
        assert terminal(state(orientation=tilted(-91.0, axis)))[0]
    assert not terminal(state(orientation=tilted(179.0, 2)))[0]
    assert terminal(state(com_height=0.3199))[0]
    assert not terminal(state(base=(3.78, 0.0, 0.42)))[0]  # the goal is no ending


def test_imitation_starts_along_the_reference(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    task, reference = make("laikago_trot"), naive_reference("laikago_trot")
    start = task.tracker(reference).start(np.random.default_rng(0), 4000)
    frames = np.rint(start.time * 30).astype(int)
    np.testing.assert_allclose(start.time, frames * STEP)
    assert (frames.min(), frames.max()) == (0, reference.steps - 1)
    later = frames > 0
    assert 0.70 < later.mean() < 0.80  # the others begin as evaluation does
    difference = start.qpos[later] - reference.qpos[frames[later]]
    assert np.abs(difference[:, 7:]).max() <= 0.025 * (1 + 1e-9)
    assert np.abs(difference[:, :2]).max() < 1e-12
    difference = start.qvel[later] - reference.qvel[frames[later]]
    assert np.abs(difference[:, :3]).max() <= 0.05 * (1 + 1e-9)
    assert np.abs(difference[:, 3:]).max() <= 0.1 * (1 + 1e-9)
    np.testing.assert_allclose(start.memory, np.tile(start.qpos[:, 7:] - NOMINAL, 4))


def test_no_other_imitation_reward(naive_reference: Callable[[str], ReferenceMotion]) -> None:
    with pytest.raises(TsbenchError, match=r"'progress'; allowed: deepmimic"):
        make("laikago_trot").tracker(naive_reference("laikago_trot"), "progress")


# Rotations, against scipy


def test_rotations() -> None:
    rng = np.random.default_rng(0)
    first, second = Rotation.random(50, rng=rng), Rotation.random(50, rng=rng)
    p, q = (rotation.as_quat(scalar_first=True) for rotation in (first, second))
    product = Rotation.from_quat(rotations.multiply(p, q), scalar_first=True)
    np.testing.assert_allclose(product.as_matrix(), (first * second).as_matrix(), atol=1e-12)
    angle = (first.inv() * second).magnitude()
    np.testing.assert_allclose(rotations.angle_between(p, q), angle, atol=1e-7)
    np.testing.assert_allclose(rotations.angle_between(p, -q), angle, atol=1e-7)
    np.testing.assert_allclose(rotations.upward(p), first.as_matrix()[:, 2, 2], atol=1e-12)
    # In the heading frame the base's own x axis has no y component.
    forward = first.as_matrix()[:, None, :, 0]
    heading = rotations.to_heading(forward, p)[:, 0]
    np.testing.assert_allclose(heading[:, 1], 0.0, atol=1e-12)
    assert np.all(heading[:, 0] >= 0.0)
    np.testing.assert_allclose(heading[:, 2], forward[:, 0, 2], atol=1e-12)
