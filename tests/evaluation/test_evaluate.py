"""Scores of policies whose worth is known."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.policy import Policy, PolicyInfo
from tsbench.core.task import plannable
from tsbench.evaluation.evaluate import check_fit, evaluate
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.protocol import SMOKE, Protocol
from tsbench.evaluation.score import Summary
from tsbench.sim.episodes import PolicyFunction
from tsbench.sim.model import fingerprint
from tsbench.tasks.laikago import LaikagoState
from tsbench.tasks.rocket import Rocket, RocketState

COS30 = 0.8660254037844387


def idle(size: int) -> PolicyFunction:
    return lambda observation: np.zeros((len(observation), size))


def few(episodes: int) -> Protocol:
    """A protocol of seconds."""
    return replace(SMOKE, perturbed=episodes, conditions=(), phases=16, forces=(100.0,), headings=2)


def artefact(name: str, seed: int = 0, **constants: Any) -> Policy:
    """A policy for the task that nobody trained."""
    task = tasks.make(name, **constants)
    layers = (task.observation_size, 8, task.action_size)
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return (0.3 * rng.normal(size=shape)).astype(np.float32)

    info = PolicyInfo(name, task.version, fingerprint(task.spec()), "none", "tanh", layers)
    return Policy(
        info,
        mean=np.zeros(layers[0], np.float32),
        scale=np.ones(layers[0], np.float32),
        weights=(draw(8, layers[0]), draw(layers[2], 8)),
        biases=(draw(8), draw(layers[2])),
    )


# Known scores


def fall(distance: float, horizon: int) -> tuple[float, int]:
    """Return and length of a rocket that does nothing, at rest at first.

    h = 0.02 s, 5 kg, 12.5 N of weight, drag 2.5 N s/m taken implicitly:
    v_k = -5 (1 - (5 / 5.05)^k) m/s, and below -10 m it is out of the world.
    """
    goal = distance * np.array([COS30, 0.5])
    z, total = 0.0, 0.0
    for k in range(1, horizon + 1):
        z += 0.02 * -5.0 * (1.0 - (5.0 / 5.05) ** k)
        total += 0.9 * math.exp(-0.25 * math.hypot(goal[0], goal[1] - z))
        if z < -10.0:
            return total, k
    return total, horizon


@pytest.mark.parametrize(("distance", "horizon"), [(6.0, 78), (24.0, 312)])
def test_a_falling_rocket(distance: float, horizon: int) -> None:
    task = tasks.make("rocket_navigation", distance=distance)
    assert task.horizon == horizon
    total, length = fall(distance, horizon)
    assert (length < horizon) == (distance > 10.0)
    score = evaluate(idle(2), task, protocol=few(3), threads=1)
    assert score.normalized_reward == pytest.approx(total / (0.9 * horizon), rel=1e-9)
    assert score.optimality == pytest.approx(total / best_return(task), rel=1e-9)
    assert score.success == 0.0
    assert score.nominal.episodes == 1
    assert score.nominal.normalized_reward == score.normalized_reward
    assert score.nominal.steps == length
    assert score.nominal.violations == 0.0
    assert score.perturbed.episodes == 3
    assert score.perturbed.success == 0.0
    assert score.perturbed.normalized_reward != score.normalized_reward
    assert score.perturbed.normalized_reward == pytest.approx(score.normalized_reward, rel=0.5)


def pilot(observation: np.ndarray) -> np.ndarray:
    """Flies a rocket by hand: leans to where the thrust is wanted."""
    angle, spin = observation[:, 2], observation[:, 5]
    velocity, offset = observation[:, 3:5], observation[:, 6:8]
    wanted = np.clip(0.6 * offset, -4.0, 4.0)
    force = 5.0 * (1.5 * (wanted - velocity) + 0.5 * velocity + np.array([0.0, 2.5]))
    force[:, 1] = np.maximum(force[:, 1], 5.0)
    lean = np.clip(np.arctan2(-force[:, 0], force[:, 1]), -1.0, 1.0)
    main = np.linalg.norm(force, axis=-1) / 50.0
    main = np.where(main < 0.25, 0.0, np.maximum(main, 0.5))
    return np.stack([main, 8.0 * (lean - angle) - 4.0 * spin], axis=-1)


def test_a_pilot_arrives() -> None:
    """The standard task can be solved, from every perturbed start too."""
    score = evaluate(pilot, tasks.make("rocket_navigation"), protocol=few(10), threads=1)
    assert (score.success, score.perturbed.success) == (1.0, 1.0)
    assert score.nominal.goal_distance < 1.0
    assert 0.3 < score.optimality < 1.0
    assert score.nominal.steps == score.perturbed.steps == 779


def test_a_standing_robot() -> None:
    """It neither falls nor arrives, and its score is that of the dm_control environment."""
    task = tasks.make("laikago_walk")
    score = evaluate(idle(12), task, protocol=few(4), threads=1)
    assert score.success == score.perturbed.success == 0.0
    assert score.nominal.violations == score.perturbed.violations == 0.0
    assert score.nominal.steps == 180
    assert score.nominal.goal_distance == pytest.approx(1.584, abs=0.03)
    # exp(-3.96) = 0.019 for the distance, a fifth of it for feet that should swing.
    assert 0.001 < score.normalized_reward < 0.019


@pytest.mark.parametrize("name", tasks.names())
def test_the_score_is_the_dm_control_environments(name: str) -> None:
    policy, task = artefact(name), tasks.make(name)
    score = evaluate(policy, task, protocol=few(2), threads=1)
    environment = tsbench.load(name)
    time_step = environment.reset()
    rewards = []
    while not time_step.last():
        (observation,) = time_step.observation.values()
        time_step = environment.step(policy(observation))
        rewards.append(time_step.reward)
    assert score.nominal.steps == len(rewards)
    total = np.sum([*rewards, *[0.0] * (task.horizon - len(rewards))], axis=0)
    assert score.normalized_reward == pytest.approx(
        total / (task.max_reward * task.horizon), rel=1e-12
    )
    state = cast(Any, environment.task).state
    assert score.nominal.goal_distance == task.goal_distance(state)[0]
    assert score.nominal.violations == float(task.violated(state)[0])


def test_repeatable() -> None:
    policy, task = artefact("laikago_trot"), tasks.make("laikago_trot")
    score = evaluate(policy, task, protocol=few(5), threads=1)
    assert evaluate(policy, task, protocol=few(5), threads=2) == score
    other = evaluate(policy, task, protocol=replace(few(5), seed=1), threads=1)
    assert other.nominal == score.nominal
    assert other.perturbed != score.perturbed
    assert json.loads(json.dumps(score.as_dict()))["perturbed"]["episodes"] == 5


def test_success_needs_an_episode_without_violation() -> None:
    """A collision on the way spoils an episode that ends at the goal."""

    class Harsh(Rocket):
        def violated(self, state: RocketState) -> Any:
            return state.position[..., 0] > 20.0

    task = cast(Rocket, tasks.make("rocket_navigation"))
    harsh = Harsh(task.name, task.distance, task.obstacles, task.horizon)
    score = evaluate(pilot, harsh, protocol=few(2), threads=1)
    assert score.nominal.goal_distance < 1.0
    assert score.success == score.perturbed.success == 0.0
    assert score.nominal.violations == score.perturbed.violations == 1.0
    assert score.nominal.steps == 779


# What is reachable


@pytest.mark.parametrize(
    ("field", "value"),
    [("episodes", 0), ("episodes", 10**400), ("success", 1.01), ("violations", -0.01)],
)
def test_a_summary_that_cannot_be(field: str, value: float) -> None:
    summary = Summary(1, 0.5, 1.0, 0.0, 95.0, 0.1)
    changed: dict[str, Any] = {field: value}
    with pytest.raises(ValueError, match=field):
        replace(summary, **changed)


def test_progress_rises_to_the_end() -> None:
    """Which is told before the last actions are known, and never too much."""
    task = tasks.make("rocket_navigation", distance=6.0)
    shares: list[float] = []
    score = evaluate(idle(2), task, protocol=few(2), progress=shares.append)
    assert shares == sorted(shares)
    assert 0.0 < shares[0] < 0.1
    assert 0.9 < shares[-1] <= 1.0
    assert evaluate(idle(2), task, protocol=few(2)) == score


def test_best_return_of_the_rocket_by_hand() -> None:
    """4 m at 30 degrees: 0.1 m per step and axis, 20 steps up and 34.6 along, 52 in all."""
    task = tasks.make("rocket_navigation", distance=4.0)
    assert task.horizon == 52
    x, z = 4.0 * COS30, 2.0
    total = 0.0
    for k in range(1, 53):
        total += 0.9 * math.exp(-0.25 * math.hypot(x - min(0.1 * k, x), z - min(0.1 * k, z)))
    assert best_return(task) == pytest.approx(total, rel=1e-12)
    # Roughly 0.9 from step 35 on.
    assert total > 18 * 0.9


@pytest.mark.parametrize(
    ("name", "distance", "step", "motion"),
    [
        # Trot: two feet swing at 1.26 m/s: exp(-4 x 2 x 0.042). Walk: one at 1.056 m/s.
        ("laikago_trot", 3.78, 0.021, 0.7146230),
        ("laikago_walk", 1.584, 0.0088, 0.8686631),
    ],
)
def test_best_return_of_a_gait_by_hand(
    name: str, distance: float, step: float, motion: float
) -> None:
    """At top speed until 5 cm before the goal; the missing steps count as perfect ones."""
    total, k = 0.0, 0
    while distance - step * k >= 0.05:
        k += 1
        total += math.exp(-2.5 * (distance - step * k)) * motion
    assert 170 < k < 180
    assert best_return(tasks.make(name)) == pytest.approx(total + 180 - k, rel=1e-6)


@pytest.mark.parametrize("name", tasks.names())
def test_ideal_obeys_the_speed_limits(name: str) -> None:
    task = tasks.make(name)
    ideal = task.ideal()
    start = plannable(task).abstraction().start(1)
    assert len(ideal.time) == task.horizon + 1
    np.testing.assert_allclose(ideal.time, np.arange(task.horizon + 1) * task.timestep)
    assert task.goal_distance(ideal)[0] == pytest.approx(task.goal_distance(start)[0])
    assert task.goal_distance(ideal)[-1] < 1e-9
    assert not np.any(task.violated(ideal))
    if isinstance(ideal, RocketState):
        assert np.abs(np.diff(ideal.position, axis=0)).max() <= 5.0 * 0.02 + 1e-12
        return
    assert isinstance(ideal, LaikagoState)
    speed, swing = {
        "laikago_walk": (0.264, 1.65 * 0.48),
        "laikago_trot": (0.63, 1.26 * 0.50),
    }[name]
    moves = np.linalg.norm(np.diff(ideal.base_position, axis=0), axis=-1)
    assert moves.max() <= speed / 30 + 1e-12
    about_hip = np.diff(ideal.feet[..., 0] - ideal.base_position[:, :1], axis=0)
    assert np.abs(about_hip).max() <= swing / 30 + 1e-9
    gait = cast(Any, task).gait
    contacts = gait.contacts(ideal.time)
    np.testing.assert_allclose(ideal.feet[..., 2] - 0.0265, np.where(contacts, 0.0, 0.1))
    stance = contacts[1:] & contacts[:-1]
    assert np.abs(np.diff(ideal.feet[..., 0], axis=0))[stance].max() < 1e-9
    # No foot is ever farther from its hip than a leg can reach.
    reach = ideal.feet[..., 0] - ideal.base_position[:, :1] - [0.21935, 0.21935, -0.21935, -0.21935]
    assert np.abs(reach).max() < 0.2


@pytest.mark.parametrize("name", tasks.names())
def test_nothing_planned_beats_the_ideal(name: str) -> None:
    """Random plans under the same limits get less than it."""
    task = tasks.make(name)
    abstraction = plannable(task).abstraction()
    rng = np.random.default_rng(0)
    state = abstraction.start(50)
    total = np.zeros(50)
    for _ in range(abstraction.horizon):
        action = rng.uniform(-1.0, 1.0, (50, abstraction.action_size))
        action[:25] = abstraction.naive(state.rows(slice(0, 25))) + 0.1 * action[:25]
        following = abstraction.advance(state, action)
        total += task.reward(state, action, following)
        state = following
    assert total.max() * abstraction.timestep < best_return(task) * task.timestep


# Whose policy it is


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "laikago_trot"}, "for laikago_trot version 1, not for laikago_walk version 1"),
        ({"task_version": 2}, "for laikago_walk version 2, not for laikago_walk version 1"),
        ({"physics": "0" * 64}, "another model or other constants"),
    ],
)
def test_foreign_policies_are_refused(change: dict[str, Any], message: str) -> None:
    policy, task = artefact("laikago_walk"), tasks.make("laikago_walk")
    check_fit(policy, task)
    with pytest.raises(TsbenchError, match=message):
        evaluate(replace(policy, info=replace(policy.info, **change)), task, protocol=few(1))
    with pytest.raises(TsbenchError, match="another model or other constants"):
        evaluate(policy, tasks.make("laikago_walk", distance=1.0), protocol=few(1))
