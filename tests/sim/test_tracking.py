"""The imitation variant, and DeepMimic's reward against that paper's constants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tsbench import TsbenchError, tasks
from tsbench.core.motion import ReferenceMotion
from tsbench.sim.physics import Physics
from tsbench.sim.tracking import Imitation, deepmimic_reward
from tsbench.testing.episodes import plannable_tasks

NAMES = plannable_tasks()


def tracking(
    pose: float = 0.0, velocity: float = 0.0, foot: float = 0.0, com: float = 0.0
) -> float:
    """Twelve joints off by `pose` and `velocity`, four feet and the CoM by so many metres."""
    along = np.array([0.6, 0.0, 0.8])
    return float(
        deepmimic_reward(
            pose=np.full((1, 12), pose),
            velocity=np.full((1, 12), velocity),
            end_effectors=np.tile(foot * along, (1, 4, 1)),
            com=com * along[None],
        )[0]
    )


@pytest.mark.parametrize(
    ("error", "weight", "term"),
    [
        # facts.md C, "Term sizes", and to more places by hand
        ({"pose": 0.1}, 0.65, 0.7866279),  # exp(-2 x 12 x 0.01)
        ({"pose": -0.1}, 0.65, 0.7866279),
        ({"velocity": 1.0}, 0.1, 0.3011942),  # exp(-0.1 x 12)
        ({"velocity": 2.0}, 0.1, 0.0082297),  # exp(-0.1 x 48)
        ({"foot": 0.02}, 0.15, 0.9380050),  # exp(-40 x 4 x 0.0004)
        ({"foot": 0.05}, 0.15, 0.6703200),  # exp(-40 x 4 x 0.0025)
        ({"com": 0.05}, 0.1, 0.9753099),  # exp(-10 x 0.0025)
        ({"com": 0.2}, 0.1, 0.6703200),  # exp(-10 x 0.04)
    ],
)
def test_terms(error: dict[str, float], weight: float, term: float) -> None:
    assert tracking(**error) == pytest.approx(1.0 - weight + weight * term, abs=1e-7)


def test_sum_of_terms() -> None:
    assert tracking() == 1.0
    everything = tracking(pose=0.1, velocity=1.0, foot=0.02, com=0.05)
    expected = 0.65 * 0.7866279 + 0.1 * 0.3011942 + 0.15 * 0.9380050 + 0.1 * 0.9753099
    assert everything == pytest.approx(expected, abs=1e-7)
    assert tracking(pose=9.0, velocity=99.0, foot=9.0, com=9.0) == pytest.approx(0.0, abs=1e-12)


@pytest.fixture(params=NAMES)
def imitation(
    request: pytest.FixtureRequest, naive_reference: Callable[[str], ReferenceMotion]
) -> Imitation[Any]:
    return Imitation(tasks.make(request.param), naive_reference(request.param))


def test_only_reward_start_and_ending_differ(imitation: Imitation[Any]) -> None:
    task = imitation.task
    physics = Physics(task, 50, threads=1, perturbed=True)
    rng = np.random.default_rng(0)
    state = physics.begin(rng, np.arange(50))
    action = rng.uniform(-1.0, 1.0, (50, task.action_size))
    following = physics.advance(state, action)
    assert imitation.plant is task
    for question in ("observation", "value_observation", "violated"):
        answer = getattr(imitation, question)(following)
        np.testing.assert_array_equal(answer, getattr(task, question)(following))
    assert not np.any(imitation.reached(following))  # no ending that credits missing steps
    np.testing.assert_array_equal(
        imitation.reward(state, action, following),
        imitation.tracker.reward(state, action, following),
    )
    assert not np.any(imitation.reward(state, action, following) == task.reward(
        state, action, following
    ))  # fmt: skip


def test_starts(imitation: Imitation[Any]) -> None:
    """Starts lie along the reference in training, and near the task's own start if perturbed."""
    count = 200
    along = imitation.start(np.random.default_rng(0), count)
    assert np.sum(along.time > 0.0) > count / 2
    near = imitation.start(np.random.default_rng(0), count, perturbed=True)
    expected = imitation.task.start(np.random.default_rng(0), count, perturbed=True)
    assert not np.any(near.time)
    np.testing.assert_array_equal(near.qpos, expected.qpos)
    np.testing.assert_array_equal(near.qvel, expected.qvel)
    np.testing.assert_array_equal(near.memory, expected.memory)


@pytest.mark.parametrize(
    "foreign", [{"task": "laikago_walk"}, {"task_version": 2}, {"task": "rocket_navigation"}]
)
def test_foreign_references_are_refused(
    foreign: dict[str, Any], naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    reference = replace(naive_reference("laikago_trot"), **foreign)
    with pytest.raises(TsbenchError, match=r"not for laikago_trot version 1$"):
        Imitation(tasks.make("laikago_trot"), reference)


def test_references_of_other_sizes_are_refused(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    reference = naive_reference("laikago_trot")
    narrow = replace(reference, qvel=reference.qvel[:, :-1])
    with pytest.raises(TsbenchError, match="reference motion has 17 qvel a step, not 18"):
        Imitation(tasks.make("laikago_trot"), narrow)


def test_references_at_another_rate_are_refused(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    """Its frames are counted as control steps."""
    slow = replace(naive_reference("laikago_trot"), timestep=0.1)
    with pytest.raises(TsbenchError, match=r"a time step of 0\.1 s, which does not fit"):
        Imitation(tasks.make("laikago_trot"), slow)


def test_form(naive_reference: Callable[[str], ReferenceMotion]) -> None:
    name = "rocket_navigation"
    task, reference = tasks.make(name), naive_reference(name)
    assert Imitation(task, reference).max_reward == 1.2
    assert Imitation(task, reference, "paper").max_reward == 0.9
    with pytest.raises(TsbenchError, match="allowed: paper, progress"):
        Imitation(task, reference, "deepmimic")


def test_following_the_reference_pays_more_and_more(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    """The reward of the progress form rises from 0.1 to 1 along the way of 60 m."""
    name = "rocket_obstacles"
    reference = naive_reference(name)
    task = Imitation(tasks.make(name), reference)
    state = task.task.ideal()
    state = state.replace(
        position=reference.qpos[: len(state.time), :2],
        time=state.time[: len(reference.qpos)],
        angle=state.angle[: len(reference.qpos)],
        clearance=np.ones((min(len(state.time), len(reference.qpos)), 2)),
    )
    reward = task.reward(state, np.zeros((len(state.time), 2)), state)
    arrival = int(np.argmax(reward >= 1.0 - 1e-9))
    assert reward[0] == pytest.approx(0.1)
    assert np.all(np.diff(reward[: arrival + 1]) > 0.0)
    np.testing.assert_allclose(reward[arrival:], 1.0)
