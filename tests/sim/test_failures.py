"""Failures of a simulation: counted, ended and reported, equally for one and many episodes."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from tsbench import tasks
from tsbench.core.errors import NotFiniteError, TsbenchError
from tsbench.core.state import Start, State
from tsbench.core.task import Task
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.episodes import play
from tsbench.sim.physics import Physics
from tsbench.sim.single import environment

STILL = np.zeros((3, 12))


class Altered:
    """A task with some attributes replaced."""

    def __init__(self, task: Task[Any], **changes: Any) -> None:
        self.task = task
        vars(self).update({"plant": self, **changes})

    def __getattr__(self, name: str) -> Any:
        return getattr(self.task, name)


def altered(task: Task[Any], **changes: Any) -> Any:
    return Altered(task, **changes)


@pytest.fixture
def task() -> Task[Any]:
    return tasks.make("laikago_trot")


def bursting(task: Task[Any], rows: list[int]) -> Any:
    """The task with starts in `rows` that are too fast to be computed."""

    def start(rng: np.random.Generator, count: int, *, perturbed: bool = False) -> Start:
        begun = task.start(rng, count)
        begun.qvel[[row for row in rows if row < count], 0] = 1e9
        return begun

    return altered(task, start=start)


def test_a_diverged_episode_ends_and_the_next_begins(task: Task[Any]) -> None:
    physics: Physics[Any] = Physics(task, 3, threads=1)
    many = BatchedEnvironment(task, physics, 3, 0)
    first = many.reset()
    whole = BatchedEnvironment(task, Physics(task, 3, threads=1), 3, 0)
    whole.reset()
    physics.batch.qvel[1, 0] = 1e9
    one, other = many.step(STILL), whole.step(STILL)
    assert physics.diverged.tolist() == [1]
    assert one.terminal.tolist() == [False, True, False]
    assert one.reward[1] == 0.0
    np.testing.assert_array_equal(one.observation[1], first[1])  # where the next one begins
    assert many.steps.tolist() == [1, 0, 1]
    for row in (0, 2):
        np.testing.assert_array_equal(one.observation[row], other.observation[row])
        assert one.reward[row] == other.reward[row] > 0.0
    assert many.step(STILL).terminal.tolist() == [False, False, False]
    assert physics.diverged.tolist() == []
    assert physics.warned() == {"mjWARN_BADQACC": 1}


def test_one_and_many_agree_on_a_diverged_episode(task: Task[Any]) -> None:
    wild = bursting(task, [0])
    single = environment(wild, seed=0)
    first = single.reset().observation["observations"]
    last = single.step(np.zeros(12))
    many = BatchedEnvironment(task, Physics(wild, 1, threads=1), 1, 0)
    np.testing.assert_array_equal(many.reset()[0], first)
    transition = many.step(STILL[:1])
    assert last.last()
    assert (last.reward, last.discount) == (0.0, 0.0)
    assert (transition.reward[0], transition.terminal[0]) == (0.0, True)
    np.testing.assert_array_equal(last.observation["observations"], first)
    # The next episode is one like any other.
    single.task.task = task
    assert single.reset().first()
    assert single.step(np.zeros(12)).reward > 0.0


def test_a_diverged_episode_is_scored_as_a_failure(task: Task[Any]) -> None:
    """The episode is not dropped: it counts, with the rewards before the divergence."""
    wild = bursting(task, [1])
    episodes = play(task, Physics(wild, 3, threads=1), lambda o: np.zeros((len(o), 12)), 3, 0)
    assert episodes.diverged.tolist() == [False, True, False]
    assert episodes.course.violated[1]
    assert not episodes.spared[1]
    assert episodes.lengths[1] == 1
    assert episodes.lengths[0] == episodes.lengths[2] > 10
    assert episodes.returns[1] == 0.0 < episodes.returns[0]
    assert np.isfinite(episodes.normalized).all()


def test_mujoco_writes_no_files_and_says_nothing(
    task: Task[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    physics: Physics[Any] = Physics(task, 3)
    state = physics.begin(np.random.default_rng(0), np.arange(3))
    for _ in range(3):
        physics.batch.qvel[:, 0] = 1e9
        state = physics.advance(state, STILL)
    assert physics.warned() == {"mjWARN_BADQACC": 9}
    assert list(tmp_path.iterdir()) == []
    assert "WARNING" not in "".join(capfd.readouterr())


def pile(memory: int) -> mujoco.MjSpec:
    """Twenty balls that touch each other and the ground."""
    spec = mujoco.MjSpec()
    spec.memory = memory
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5.0, 5.0, 1.0])
    for i in range(20):
        ball = spec.worldbody.add_body(
            name=f"ball_{i}", pos=[0.15 * (i % 5), 0.15 * (i // 5), 0.099]
        )
        ball.add_freejoint()
        ball.add_geom(size=[0.1, 0.0, 0.0])
    return spec


def piled(task: Task[Any], memory: int) -> Physics[Any]:
    """Three piles instead of three robots."""
    qpos = np.tile(pile(1_000_000).compile().qpos0, (3, 1))
    start = Start(np.zeros(3), qpos, np.zeros((3, 120)), np.zeros((3, 0)))
    changed = altered(
        task,
        pushed="ball_0",
        spec=lambda: pile(memory),
        start=lambda *_, **__: start,
        control=lambda state, action: (np.zeros((3, 0)), np.zeros((3, 0))),
        read=lambda readings: State(readings.time),
    )
    return Physics(changed, 3, threads=1)


def test_a_full_arena_is_counted_and_ends_nothing(task: Task[Any]) -> None:
    """mujoco leaves out contacts that do not fit: the physics is wrong but continues."""
    physics = piled(task, 30_000)
    physics.advance(physics.begin(np.random.default_rng(0), np.arange(3)), STILL)
    assert physics.diverged.tolist() == []
    assert physics.warned().keys() == {"mjWARN_CONTACTFULL", "mjWARN_CNSTRFULL"}
    assert min(physics.warned().values()) >= 3


def test_an_arena_far_too_small_is_told_in_one_line(task: Task[Any]) -> None:
    physics = piled(task, 20_000)
    with pytest.raises(
        TsbenchError, match=r"the physics cannot go on: MuJoCo raised in 3 of 3"
    ) as e:
        physics.advance(physics.begin(np.random.default_rng(0), np.arange(3)), STILL)
    assert "\n" not in str(e.value)


def wrong_reward(task: Task[Any]) -> Any:
    def reward(previous: Any, action: Any, state: Any) -> Any:
        value = task.reward(previous, action, state)
        value[2] = np.nan
        return value

    return altered(task, reward=reward)


def test_a_reward_that_is_no_number_is_told(task: Task[Any]) -> None:
    many = BatchedEnvironment(wrong_reward(task), Physics(task, 3, threads=1), 3, 0)
    many.reset()
    before = many.state
    with pytest.raises(
        NotFiniteError, match=r"^reward of environment 2 is not finite at step 1 of"
    ) as caught:
        many.step(STILL)
    arrays = caught.value.arrays
    assert np.isnan(arrays["reward"][2])
    np.testing.assert_array_equal(arrays["action"], STILL)
    np.testing.assert_array_equal(arrays["previous_base_position"], before.base_position)


def test_a_state_that_is_no_number_is_told(task: Task[Any]) -> None:
    def read(readings: Any) -> Any:
        state = task.read(readings)
        feet = state.feet.copy()
        feet[-1, 0, 2] = np.inf if readings.time[-1] > 0.05 else feet[-1, 0, 2]
        return replace(state, feet=feet)

    many = BatchedEnvironment(task, Physics(altered(task, read=read), 3, threads=1), 3, 0)
    many.reset()
    many.step(STILL)
    with pytest.raises(NotFiniteError, match=r"^feet of environment 2 is not finite at step 2 of"):
        many.step(STILL)


def test_an_action_that_is_no_number_is_told(task: Task[Any]) -> None:
    action = STILL.copy()
    action[1, 7] = np.nan
    many = BatchedEnvironment(task, Physics(task, 3, threads=1), 3, 0)
    many.reset()
    with pytest.raises(NotFiniteError, match=r"^action of environment 1 is not finite at step 1"):
        many.step(action)
    single = environment(task, seed=0)
    single.reset()
    with pytest.raises(NotFiniteError, match=r"^action of environment 0 is not finite"):
        single.step(action[1])


def test_a_score_is_not_made_from_what_is_no_number(task: Task[Any]) -> None:
    physics: Physics[Any] = Physics(task, 3, threads=1)
    with pytest.raises(TsbenchError, match="reward of environment 2 is not finite at step 1"):
        play(wrong_reward(task), physics, lambda o: np.zeros((len(o), 12)), 3, 0)


def test_what_is_no_number_can_leave_the_process_of_a_pool() -> None:
    error = NotFiniteError("reward is not finite", {"state": STILL})
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error)
    assert np.array_equal(again.arrays["state"], STILL)
