"""Returns of whole episodes, on a task whose every reward is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from tsbench.core.arrays import Array
from tsbench.core.errors import TsbenchError
from tsbench.core.state import State
from tsbench.core.task import MDP
from tsbench.sim.episodes import Episodes, play

HORIZON = 10


@dataclass(frozen=True)
class Line(State):
    """Walkers on a line.

    Attributes:
        x: metres, shape (...,).
        speed: metres per step that the policy asks for, shape (...,).
        hurt: whether this step is a violation, shape (...,).
    """

    x: Array
    speed: Array
    hurt: Array


class Walk(MDP[Line]):
    """The reward is the distance walked. Goals are x = 4 and 5, violations x = 5 and 7; x = -3 is a
    cliff, which ends the episode."""

    name, version, horizon, timestep = "walk", 1, HORIZON, 0.5
    observation_size, action_size, max_reward = 3, 1, 2.0
    diverged = np.zeros(0, int)
    seconds = 0.0  # of physics

    def __init__(self, starts: list[float], speeds: list[float]) -> None:
        self.starts, self.speeds = np.array(starts), np.array(speeds)
        self.advanced: list[int] = []  # how many walkers, each time

    def observation(self, state: Line) -> Array:
        return np.stack([state.time, state.x, state.speed], axis=-1)

    def reward(self, previous: Line, action: Array, state: Line) -> Array:
        return state.x - previous.x

    def terminal(self, state: Line) -> Array:
        return np.isin(state.x, [4.0, 5.0, -3.0])

    def reached(self, state: Line) -> Array:
        return np.isin(state.x, [4.0, 5.0])

    def violated(self, state: Line) -> Array:
        return state.hurt

    def begin(self, rng: np.random.Generator, rows: np.ndarray) -> Line:
        self.drawn = float(rng.uniform())
        return Line(
            np.zeros(len(rows)), self.starts[rows], self.speeds[rows], np.zeros(len(rows), bool)
        )

    def advance(self, state: Line, action: Array, rows: np.ndarray | None = None) -> Line:
        assert rows is not None
        np.testing.assert_array_equal(state.speed, self.speeds[rows])
        self.advanced.append(len(rows))
        x = state.x + action[..., 0]
        return Line(state.time + self.timestep, x, state.speed, np.isin(x, [5.0, 7.0]))


def wanted(observation: np.ndarray) -> np.ndarray:
    return observation[:, 2:]


def walk(starts: list[float], speeds: list[float], **options: Any) -> Episodes[Line]:
    mdp = Walk(starts, speeds)
    return play(mdp, mdp, wanted, len(starts), seed=0, **options)


@pytest.mark.parametrize(
    ("start", "speed", "length", "reached", "violated", "total"),
    [
        (0.0, 1.0, 4, True, False, 4 * 1.0 + 6 * 2.0),  # six missing steps count as perfect
        (0.0, 2.0, 2, True, False, 2 * 2.0 + 8 * 2.0),
        (0.0, -1.0, 3, False, False, -3.0),  # seven missing steps count as nothing
        (0.0, 0.0, 10, False, False, 0.0),
        (0.0, 0.25, 10, False, False, 2.5),
        (1.5, 0.25, 10, True, False, 2.5),  # at the goal with the last step: nothing is missing
        (6.0, 1.0, 10, False, True, 10.0),  # hurt once on the way: spoiled for good
        (6.0, -1.0, 1, False, True, -1.0),  # at a goal, but hurt: no credit
        (7.0, -1.0, 2, False, True, -2.0),
    ],
)
def test_one_episode(
    start: float, speed: float, length: int, reached: bool, violated: bool, total: float
) -> None:
    episodes = walk([start], [speed])
    assert episodes.lengths.tolist() == [length]
    assert episodes.spared.tolist() == [10 - length if reached else 0]
    assert episodes.course.violated.tolist() == [violated]
    assert episodes.returns.tolist() == pytest.approx([total])
    assert episodes.normalized.tolist() == pytest.approx([total / 20.0])  # 2 x 10 steps
    assert episodes.final.x.tolist() == pytest.approx([start + length * speed])
    assert episodes.final.time.tolist() == pytest.approx([0.5 * length])


def test_an_action_that_is_not_finite_ends_the_play() -> None:
    """Though the state may stay finite: physics takes such an action for zero."""
    mdp = Walk([0.0], [0.0])
    mdp.advance = lambda state, action, rows=None: Line(  # type: ignore[method-assign]
        state.time + 0.5, state.x, state.speed, state.hurt
    )
    with pytest.raises(TsbenchError, match="action of environment 0 is not finite at step 1"):
        play(mdp, mdp, lambda observation: np.full((1, 1), np.nan), 1)


def test_many_side_by_side() -> None:
    """An episode's results depend neither on the steps after its end nor on other episodes."""
    starts, speeds = [0.0, 0.0, 6.0, 0.0], [1.0, -1.0, 1.0, 0.25]
    together = walk(starts, speeds, record=lambda state: state.x)
    for index, (start, speed) in enumerate(zip(starts, speeds, strict=True)):
        alone = walk([start], [speed])
        assert alone.course.violated[0] == together.course.violated[index]
        for name in ("returns", "lengths", "spared", "normalized"):
            assert getattr(together, name)[index] == getattr(alone, name)[0]
        np.testing.assert_array_equal(together.rewards[:, index], alone.rewards[:, 0])
        np.testing.assert_array_equal(together.actions[:, index], alone.actions[:, 0])
        assert together.final.x[index] == alone.final.x[0]
    assert together.rewards.shape == (HORIZON, 4)
    assert together.rewards[:, 0].tolist() == [1.0] * 4 + [0.0] * 6
    assert together.actions[:, 1, 0].tolist() == [-1.0] * 3 + [0.0] * 7
    assert together.states is not None
    assert together.states[:, 0].tolist() == [0, 1, 2, 3, 4, 4, 4, 4, 4, 4, 4]
    assert together.states[:, 1].tolist() == [0, -1, -2] + [-3] * 8


def test_kept_actions_are_played_instead_of_a_policy() -> None:
    """Each episode takes its own, whichever others have ended before."""
    starts = [0.0, 0.0, 6.0, 0.0]
    once = walk(starts, [1.0, -1.0, 1.0, 0.25])
    mdp = Walk(starts, [1.0, -1.0, 1.0, 0.25])
    again = play(mdp, mdp, once.actions, 4)
    assert len(set(once.lengths.tolist())) > 2
    np.testing.assert_array_equal(again.actions, once.actions)
    np.testing.assert_array_equal(again.rewards, once.rewards)
    np.testing.assert_array_equal(again.final.x, once.final.x)


def test_record_after_the_last_end() -> None:
    """Ended episodes are not stepped, and play stops when all have ended. The record still has
    full length."""
    mdp = Walk([0.0, 0.0], [2.0, -1.0])
    episodes = play(
        mdp, mdp, wanted, 2, record=lambda state: np.stack([state.x, state.time], axis=-1)
    )
    assert mdp.advanced == [2, 2, 1]
    assert episodes.states is not None
    assert episodes.states.shape == (HORIZON + 1, 2, 2)
    assert episodes.states[-1].tolist() == [[4.0, 1.0], [-3.0, 1.5]]
    assert walk([0.0], [1.0]).states is None


@pytest.mark.parametrize(
    ("start", "speed", "survived"),
    [
        (0.0, 1.0, True),  # at the goal
        (0.0, 0.25, True),  # to the last step
        (1.5, 0.25, True),  # both
        (0.0, -1.0, False),  # over the cliff
        (6.0, 0.125, False),  # to the last step, but hurt at 7
        (6.0, -1.0, False),  # at the goal, but hurt
        (-1.75, -0.125, False),  # over the cliff with the last step
    ],
)
def test_survival(start: float, speed: float, survived: bool) -> None:
    assert walk([start], [speed]).survived.tolist() == [survived]


def test_going_on_from_states() -> None:
    """Episodes that begin late have fewer steps, and returns are normalised by that number."""
    mdp = Walk([0.0] * 3, [0.25, 1.0, 0.25])
    begin = Line(
        np.array([4.0, 2.0, 0.0]), np.array([0.0, 0.0, 1.0]), mdp.speeds, np.zeros(3, bool)
    )
    episodes = play(mdp, mdp, wanted, 3, begin=begin)
    assert episodes.limits.tolist() == [2, 6, 10]
    assert episodes.lengths.tolist() == [2, 4, 10]
    assert episodes.survived.tolist() == [True, True, True]
    assert episodes.returns.tolist() == pytest.approx([0.5, 4.0 + 2 * 2.0, 2.5])
    assert episodes.normalized.tolist() == pytest.approx([0.5 / 4.0, 8.0 / 12.0, 2.5 / 20.0])
    assert episodes.final.time.tolist() == [5.0, 4.0, 5.0]


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_late_actions(delay: int) -> None:
    """Each step uses the action of the observation `delay` steps before, zero at first."""
    mdp = Walk([0.0, 0.5], [0.0, 0.0])
    episodes = play(mdp, mdp, lambda observation: 0.1 + 0.01 * observation[:, :1], 2, delay=delay)
    expected = [0.0] * delay + [0.1 + 0.005 * step for step in range(HORIZON - delay)]
    for row in range(2):
        assert episodes.actions[:, row, 0].tolist() == pytest.approx(expected)
    assert episodes.final.x[0] == pytest.approx(sum(expected))


def test_the_seed_is_the_starts() -> None:
    drawn = []
    for seed in (3, 3, 4):
        mdp = Walk([0.0], [0.0])
        play(mdp, mdp, wanted, 1, seed)
        drawn.append(mdp.drawn)
    assert drawn[0] == drawn[1] != drawn[2]


def test_the_policy_sees_the_present() -> None:
    """Observation, action and reward of a step belong together."""
    seen: list[Any] = []

    def policy(observation: np.ndarray) -> np.ndarray:
        seen.append(observation.tolist())
        return np.array([[0.5]])

    mdp = Walk([0.0], [0.0])
    play(mdp, mdp, policy, 1, seed=0)
    assert seen == [[[0.5 * step, 0.5 * step, 0.0]] for step in range(8)]
