"""A wrong gait must not pay: a policy that arrives in another way than the task asks for, or not at
all, has not solved the task, and earns less than half of what the right gait earns."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsbench import tasks
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.oracle import outcome
from tsbench.evaluation.protocol import V1
from tsbench.evaluation.references import POLICIES, stored
from tsbench.evaluation.score import Score
from tsbench.runs.directory import RunDirectory
from tsbench.sim.episodes import PolicyFunction
from tsbench.sim.physics import Physics
from tsbench.tasks.laikago import HIPS, C, Laikago, LaikagoState

BOARDS = Path(__file__).parents[2] / "leaderboards"
ENTRIES = sorted(path.parent for path in BOARDS.glob("v1/*/*/*/policy.json"))
KEPT_ROWS = {name: rows for name in tasks.names() if (rows := stored(name)) is not None}
GAITS = [name for name in tasks.names() if isinstance(tasks.make(name), Laikago)]
PAIRS = list(itertools.permutations(GAITS, 2))
FEW = replace(V1, perturbed=20, conditions=(), headings=1, phases=100, forces=(100.0,))
CLOCK = slice(37, 40)  # of Laikago's observation: share of the episode, sine, cosine
GOAL = slice(40, 43)  # offset and distance

Seen = Callable[[np.ndarray], np.ndarray]  # observations to what the policy is shown instead


def entry_of(name: str) -> RunDirectory:
    """The best kept entry of a task, which the others are held against."""
    entries = [RunDirectory(entry) for entry in ENTRIES if entry.parts[-3] == name]
    return max(entries, key=lambda entry: entry.record().score.solved_reward)


def laikago(name: str) -> Laikago:
    task = tasks.make(name)
    assert isinstance(task, Laikago)
    return task


def check_worthless(score: Score, kept: Score) -> None:
    assert score.solved_reward == 0.0
    assert score.success == 0.0
    assert score.normalized_reward < 0.5 * kept.normalized_reward


# Doing nothing, doing anything


@pytest.mark.parametrize("policy", sorted(POLICIES))
@pytest.mark.parametrize("name", KEPT_ROWS)
def test_nothing_and_anything(name: str, policy: str) -> None:
    """They never solve a task, and earn next to nothing; another test remakes these rows."""
    row = KEPT_ROWS[name]["rows"][policy]
    assert row["solved_reward"] == row["success"] == row["recovery_100N"] == 0.0
    assert row["against_plan"] < 0.05


# Motions that no physics moved


def gliding(task: Laikago, speed: float, until: float = 0.0) -> LaikagoState:
    """A level base that goes at `speed` to `until` metres before the goal, all feet dragged along
    on the ground; there it steps in place, as scheduled."""
    time = np.arange(task.horizon + 1) * task.timestep
    x = np.minimum(speed * time, task.distance - until)
    base = np.stack([x, 0.0 * x, C.stand_height + 0.0 * x], axis=-1)
    states = task.kinematic(time, base, x[:, None] + HIPS[:, 0])
    feet = states.feet.copy()
    moving = np.diff(x, prepend=-1.0) > 0.0
    feet[moving, :, 2] = C.foot_radius
    return states.replace(feet=feet)


@pytest.mark.parametrize("speed", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("name", GAITS)
def test_dragged_feet(name: str, speed: float) -> None:
    task = laikago(name)
    ideal, dragged = outcome(task, task.ideal()), outcome(task, gliding(task, speed))
    assert ideal.solved
    assert ideal.measures["footfall agreement"] == pytest.approx(1.0)
    assert dragged.measures["time to the goal, s"] == pytest.approx(
        (task.distance - 0.1) / speed, abs=0.05
    )
    assert dragged.measures["footfall agreement"] == pytest.approx(0.5)
    assert not dragged.solved
    assert dragged.normalized < 0.2 * ideal.normalized


@pytest.mark.parametrize("name", GAITS)
def test_a_dash_is_not_whitewashed_by_stepping_in_place(name: str) -> None:
    """The paper's reward pays for it, and so the headline counts only what is solved."""
    task = laikago(name)
    dash = outcome(task, gliding(task, 3.0, until=0.12))
    assert not dash.solved
    assert dash.measures["footfall agreement"] == pytest.approx(0.5)
    # Nor if it steps the last centimetres, and arrives.
    states = gliding(task, 3.0, until=0.12)
    base = np.array(states.base_position)
    base[120:, 0] += 0.03
    arrived = outcome(task, states.replace(base_position=base))
    assert arrived.measures["time to the goal, s"] == pytest.approx(4.0)
    assert not arrived.solved
    assert 0.5 < (arrived.measures["footfall agreement"] or 1.0) < 0.6


@pytest.mark.parametrize("name", GAITS)
def test_arriving_rightly_beats_hovering(name: str) -> None:
    """A step saved by the footfall that a good policy has, 0.85, is worth more than a step of
    stepping in place just outside of the goal."""
    task = laikago(name)
    hover = gliding(task, 3.0, until=0.1001)
    before, after = hover.rows(slice(150, 151)), hover.rows(slice(151, 152))
    assert task.reward(before, np.zeros((1, 12)), after)[0] < 0.85


# The kept policies, led astray


def behind(policy: PolicyFunction, seen: Seen) -> PolicyFunction:
    return lambda observation: policy(seen(observation))


def shifted(share: float) -> Seen:
    """A clock that is ahead by a share of the gait's cycle."""

    def see(observation: np.ndarray) -> np.ndarray:
        seen, turn = observation.copy(), 2.0 * math.pi * share
        sine, cosine = observation[:, CLOCK][:, 1:].T
        seen[:, CLOCK.start + 1] = sine * math.cos(turn) + cosine * math.sin(turn)
        seen[:, CLOCK.start + 2] = cosine * math.cos(turn) - sine * math.sin(turn)
        return seen

    return see


def inverted(observation: np.ndarray) -> np.ndarray:
    """Half a cycle: feet swing when they are to stand."""
    seen = observation.copy()
    seen[:, CLOCK.start + 1 : CLOCK.stop] *= -1.0
    return seen


def clocked(task: Laikago, period: float) -> Seen:
    """A clock with another period."""

    def see(observation: np.ndarray) -> np.ndarray:
        seen = observation.copy()
        time = observation[:, CLOCK.start] * task.horizon * task.timestep
        cycle = 2.0 * math.pi * time / period
        seen[:, CLOCK.start + 1] = np.sin(cycle)
        seen[:, CLOCK.start + 2] = np.cos(cycle)
        return seen

    return see


def elsewhere(task: Laikago, other: Laikago) -> Seen:
    """The clock and the goal of another gait's task."""
    tick = clocked(task, other.gait.period)

    def see(observation: np.ndarray) -> np.ndarray:
        seen = tick(observation)
        seen[:, GOAL.start] += other.distance - task.distance
        seen[:, GOAL.stop - 1] = np.linalg.norm(seen[:, GOAL][:, :2], axis=-1)
        return seen

    return see


@pytest.mark.parametrize("name", GAITS)
def test_where_clock_and_goal_stand(name: str) -> None:
    """The wrong clocks below are as wrong as their names say."""
    task = laikago(name)
    rng = np.random.default_rng(0)
    physics: Physics[LaikagoState] = Physics(task, 5, threads=1, perturbed=True)
    state = physics.begin(rng, np.arange(5)).replace(time=rng.integers(0, 180, 5) / 30.0)
    seen = task.observation(state)
    np.testing.assert_allclose(seen[:, CLOCK], task.clock(state))
    np.testing.assert_allclose(seen[:, GOAL][:, :2], task.goal_offset(state))
    np.testing.assert_allclose(seen[:, GOAL][:, 2], task.goal_distance(state))
    np.testing.assert_allclose(clocked(task, task.gait.period)(seen), seen, atol=1e-9)
    np.testing.assert_allclose(shifted(0.5)(seen), inverted(seen), atol=1e-12)
    later = state.replace(time=state.time + 0.25 * task.gait.period)
    ahead = task.observation(later)[:, CLOCK][:, 1:]
    np.testing.assert_allclose(shifted(0.25)(seen)[:, CLOCK][:, 1:], ahead, atol=1e-9)
    for there in map(laikago, GAITS):
        found = elsewhere(there, task)(there.observation(state))
        np.testing.assert_allclose(found[:, CLOCK.start :], seen[:, CLOCK.start :], atol=1e-9)


@pytest.mark.parametrize("name", KEPT_ROWS)
def test_the_kept_policy_is_worth_more_than_nothing(name: str) -> None:
    kept, rows = entry_of(name).record().score, KEPT_ROWS[name]["rows"]
    assert kept.solved_reward > 0.0
    for policy in POLICIES:
        assert rows[policy]["normalized_reward"] < 0.5 * kept.normalized_reward


WRONG: dict[str, Callable[[Laikago], Seen]] = {
    "footfall inverted": lambda task: inverted,
    "a quarter ahead": lambda task: shifted(0.25),
    "a quarter behind": lambda task: shifted(-0.25),
    "three eighths ahead": lambda task: shifted(0.375),
    "three eighths behind": lambda task: shifted(-0.375),
    "a slower clock": lambda task: clocked(task, 1.25 * task.gait.period),
    "a faster clock": lambda task: clocked(task, 0.8 * task.gait.period),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", GAITS)
def test_the_kept_policy_with_a_wrong_clock(name: str, wrong: str) -> None:
    entry, task = entry_of(name), laikago(name)
    policy = behind(entry.policy(), WRONG[wrong](task))
    check_worthless(evaluate(policy, task, protocol=FEW), entry.record().score)


@pytest.mark.parametrize(("name", "other"), PAIRS)
def test_the_kept_policy_of_another_gait(name: str, other: str) -> None:
    task = laikago(name)
    policy = behind(entry_of(other).policy(), elsewhere(task, laikago(other)))
    check_worthless(evaluate(policy, task, protocol=FEW), entry_of(name).record().score)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_lunge_that_was_learned(seed: int) -> None:
    """Plain PPO on the walk learned to throw the robot to its goal in less than a cycle, with its
    feet in the air and on the ground as half a cycle wants them."""
    entry = RunDirectory(BOARDS / "v1" / "laikago_walk" / "monolithic" / f"seed{seed}")
    task = laikago("laikago_walk")
    score = evaluate(entry.policy(), task, protocol=FEW)
    seconds = score.perturbed.measures["time to the goal, s"]
    assert seconds is not None
    assert seconds < task.gait.period
    assert (score.success, score.solved_reward) == (0.0, 0.0)


@pytest.mark.parametrize("name", GAITS)
def test_the_kept_policy_as_it_is(name: str) -> None:
    """The wrapping alone changes nothing, so the tests above judge the clock."""
    entry, task = entry_of(name), laikago(name)
    right: Any = evaluate(behind(entry.policy(), shifted(0.0)), task, protocol=FEW)
    assert right.success >= 0.9
    kept = entry.record().score
    assert right.normalized_reward == pytest.approx(kept.normalized_reward, rel=0.2)
