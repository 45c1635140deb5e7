"""Recordings: they hold exactly the values of the physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.motion import ReferenceMotion
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.protocol import SMOKE
from tsbench.sim.episodes import PolicyFunction
from tsbench.sim.push import Push
from tsbench.tasks.laikago import LaikagoState
from tsbench.viewer.recording import record_episode, record_motion


def steadily(*action: float) -> PolicyFunction:
    return lambda observation: np.tile(action, (len(observation), 1))


def test_an_episode_is_the_one_that_is_scored() -> None:
    task = tasks.make("rocket_obstacles")
    policy = steadily(0.7, 0.0)
    recording = record_episode(task, policy)
    score = evaluate(policy, task, protocol=SMOKE)
    assert len(recording.times) == len(recording.states.time) == score.nominal.steps + 1
    assert recording.goal_distance[-1] == score.nominal.goal_distance
    earned = recording.reward_terms["reward"].sum() / (task.max_reward * task.horizon)
    assert earned == pytest.approx(score.nominal.normalized_reward, rel=1e-12)
    assert (recording.solved, recording.violated) == (False, True)  # it leaves the world
    for name, value in recording.measures.items():
        assert value == pytest.approx(score.nominal.measures[name]), name
    np.testing.assert_array_equal(recording.qpos[0], 0.0)
    np.testing.assert_allclose(recording.controls, [(35.0, 0.0)] * len(recording.actions))


def test_reward_terms_make_up_the_reward() -> None:
    rocket = record_episode(tasks.make("rocket_obstacles"), steadily(0.7, 0.0)).reward_terms
    assert list(rocket) == ["near the goal", "near obstacle 1", "near obstacle 2", "reward"]
    np.testing.assert_allclose(
        sum(values for name, values in rocket.items() if name != "reward"), rocket["reward"]
    )
    laikago = record_episode(tasks.make("laikago_trot"), steadily(*[0.0] * 12)).reward_terms
    factors = [values for name, values in laikago.items() if name != "reward"]
    assert len(factors) == 4
    np.testing.assert_allclose(np.prod(factors, axis=0), laikago["reward"])


def test_who_stands_still_is_held_where_his_mass_is() -> None:
    """At rest all four feet press on the ground, and the centre of pressure is below the centre of
    mass."""
    recording = record_episode(tasks.make("laikago_trot"), steadily(*[0.0] * 12))
    support = recording.support
    assert support.contacts[90:].all()
    np.testing.assert_allclose(support.pressure[150:, :2], support.com[150:, :2], atol=1e-3)
    np.testing.assert_allclose(support.pressure[150:, 2], 0.0, atol=2e-3)
    assert support.feet.shape == (181, 4, 3)
    assert isinstance(recording.states, LaikagoState)
    np.testing.assert_array_equal(support.feet, recording.states.feet)


def test_contacts_are_of_the_step_that_led_to_a_state() -> None:
    """The schedule is paired with them: a force upwards in step 120 lifts the feet that the state
    at its end, 121, is about."""
    still = record_episode(tasks.make("laikago_trot"), steadily(*[0.0] * 12))
    forces = still.forces.copy()
    forces[120, 1:, 2] = 1000.0  # on every body
    contacts = replace(still, forces=forces).support.contacts
    assert contacts[119:121].all()
    assert not contacts[121].any()
    assert contacts[122:].all()


def test_a_push_is_recorded_as_it_acted() -> None:
    recording = record_episode(
        tasks.make("laikago_trot"),
        steadily(*[0.0] * 12),
        Push(0.5, 0.1, np.array([0.0, 50.0, 0.0])),
    )
    still = record_episode(tasks.make("laikago_trot"), steadily(*[0.0] * 12))
    steps = np.flatnonzero(recording.forces.any(axis=(1, 2)))
    np.testing.assert_array_equal(steps, [15, 16, 17])
    body = recording.task.spec().compile().body(recording.task.pushed).id
    np.testing.assert_allclose(recording.forces[15:18, body, :3], [(0.0, 50.0, 0.0)] * 3)
    assert not still.forces.any()
    np.testing.assert_array_equal(recording.qpos[:16], still.qpos[:16])
    assert recording.qpos[18, 1] > still.qpos[18, 1] + 0.005  # the body went where it was pushed


def test_a_motion_is_seen_as_the_task_sees_it(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    task, motion = tasks.make("laikago_walk"), naive_reference("laikago_walk")
    recording = record_motion(task, motion)
    assert recording.duration == pytest.approx(motion.duration)
    assert recording.goal_distance[0] == pytest.approx(1.25)
    np.testing.assert_allclose(recording.support.feet, motion.tracked["feet"], atol=1e-9)
    assert recording.scheduled is not None
    np.testing.assert_array_equal(recording.scheduled, motion.tracked["contacts"])
    assert recording.solved is None
    # All but the samples where a half sine begins, still below 1 cm.
    assert 0.9 < (recording.measures["footfall agreement"] or 0.0) < 1.0
    assert "cost of transport" not in recording.measures  # nothing acted
    with pytest.raises(TsbenchError, match="is for laikago_walk version 1, not for laikago_trot"):
        record_motion(tasks.make("laikago_trot"), motion)
