"""How far two physics engines lie apart: step by step from the same places, and over episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tsbench.core.arrays import Array
from tsbench.core.state import Start
from tsbench.core.task import Task
from tsbench.sim.change import Change
from tsbench.sim.dynamics import Engine
from tsbench.sim.physics import Physics
from tsbench.sim.push import Push, direction


@dataclass(frozen=True)
class Gaps:
    """What differs between two engines over n steps.

    Attributes:
        state: largest absolute difference within each quantity of the state, by name, each (n,).
        observation: the same of the observation, shape (n,).
        reward: largest relative difference of a term of the reward, shape (n,).
        ending: whether only one of them ends the episode there, shape (n,).
    """

    state: dict[str, np.ndarray]
    observation: np.ndarray
    reward: np.ndarray
    ending: np.ndarray


def disagreements(gaps: Gaps) -> list[str]:
    """Where two engines differ by more than float32 and the instants of contacts explain, over
    single steps. In SI units and radians; none if they agree.

    95 % of the steps agree to the precision of float32. In the others a contact is made or lost one
    physics step earlier in one of the engines, or a quaternion's sign turns.
    """
    found = [
        f"{name}: {np.quantile(apart, 0.95):.1e}"
        for name, apart in {**gaps.state, "observation": gaps.observation}.items()
        if not np.quantile(apart, 0.95) < 5e-4
    ]
    found += [f"{n}: once {apart.max():.1e}" for n, apart in gaps.state.items() if apart.max() >= 1]
    if not np.quantile(gaps.reward, 0.95) < 2e-4 or gaps.reward.max() >= 0.05:
        found.append(f"reward: {np.quantile(gaps.reward, 0.95):.1e}, once {gaps.reward.max():.1e}")
    if gaps.ending.sum() > 1:
        found.append(f"ending: in {int(gaps.ending.sum())} steps")
    return found


def wavering(task: Task[Any], rng: np.random.Generator, count: int) -> np.ndarray:
    """Actions that vary smoothly and at random over most of their range: sums of three sines."""
    steps = np.arange(task.horizon)[:, None, None, None]
    shape = (1, count, task.action_size, 3)
    periods, phases = rng.uniform(10.0, 60.0, shape), rng.uniform(0.0, 2.0 * np.pi, shape)
    action: np.ndarray = np.sin(2.0 * np.pi * steps / periods + phases).sum(axis=-1) / 3.0
    return action


def one_step_gaps(
    task: Task[Any],
    engine: Engine,
    *,
    episodes: int = 2,
    seed: int = 0,
    change: Change | None = None,
    pushed: float = 0.0,
) -> Gaps:
    """Every step of some episodes in C MuJoCo, played in the other engine from the same place.

    The episodes go on to their last step whatever happens in them, so that fallen robots are
    compared too. Errors do not add up, as each step begins where C MuJoCo was.

    Args:
        task: from its perturbed starts.
        engine: the other one.
        episodes: side by side.
        seed: of starts, actions and pushes.
        change: to both physics.
        pushed: newtons at most of a push that covers a part of each step, at any heading.
    """
    rng = np.random.default_rng(seed)
    actions = wavering(task, rng, episodes)
    physics: Physics[Any] = Physics(task, episodes, change=change, perturbed=True, threads=1)
    state = physics.begin(rng, np.arange(episodes))
    begins, afters, pushes = [], [], []
    for action in actions:
        begins.append(Start(state.time, *physics.pose(), task.memory(state)))
        physics.push = _some_push(task, rng, state.time, pushed)
        pushes.append(physics.push)
        state = physics.advance(state, action)
        afters.append(state)
    count = len(actions) * episodes
    first, wanted = Start.joined(begins), type(state).joined(afters)
    other = engine(task, count, change=change, threads=1)
    other.push = Push(*(np.concatenate([getattr(p, f) for p in pushes]) for f in vars(pushes[0])))
    before = other.place(np.arange(count), first)
    scripted = actions.reshape(count, -1)
    found = other.advance(before, scripted)
    known: Physics[Any] = Physics(task, count, change=change, threads=1)
    return _gaps(task, known.place(np.arange(count), first), scripted, wanted, before, found)


def whole_episode_gaps(task: Task[Any], engine: Engine, *, episodes: int = 4) -> Gaps:
    """Whole episodes in both engines from the same starts under the same actions; the largest
    difference so far grows with every step. Over the steps of all episodes, in C MuJoCo's count:
    what comes after its ending is left out."""
    rng = np.random.default_rng(0)
    actions = wavering(task, rng, episodes)
    start = task.start(rng, episodes, perturbed=True)
    rows = np.arange(episodes)
    physics, other = Physics(task, episodes, threads=1), engine(task, episodes, threads=1)
    one, two = physics.place(rows, start), other.place(rows, start)
    going = np.ones(episodes, bool)
    found: list[Gaps] = []
    for action in actions:
        next_one, next_two = physics.advance(one, action), other.advance(two, action)
        kept = [batch.rows(going) for batch in (one, next_one, two, next_two)]
        found.append(_gaps(task, kept[0], action[going], kept[1], kept[2], kept[3]))
        one, two = next_one, next_two
        going &= ~task.terminal(one)
        if not going.any():
            break
    return Gaps(
        state={n: np.concatenate([gaps.state[n] for gaps in found]) for n in found[0].state},
        observation=np.concatenate([gaps.observation for gaps in found]),
        reward=np.concatenate([gaps.reward for gaps in found]),
        ending=np.concatenate([gaps.ending for gaps in found]),
    )


def _some_push(task: Task[Any], rng: np.random.Generator, time: np.ndarray, most: float) -> Push:
    """Pushes that begin somewhere in the step at `time` and last up to two steps."""
    begin = time + rng.uniform(-1.0, 1.0, len(time)) * task.timestep
    duration = rng.uniform(0.0, 2.0, len(time)) * task.timestep
    heading = rng.uniform(0.0, 2.0 * np.pi, len(time))
    size = rng.uniform(0.0, most, len(time))
    return Push(begin, duration, size[:, None] * direction(task, heading))


def _gaps(task: Task[Any], one: Any, action: Array, next_one: Any, two: Any, next_two: Any) -> Gaps:
    def largest(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        apart = np.abs(np.asarray(first, float) - second).reshape(len(first), -1)
        return apart.max(axis=1, initial=0.0)

    def relative(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.abs(first - second) / np.maximum(np.abs(first), 1e-300)

    first = task.reward_terms(one, action, next_one)
    second = task.reward_terms(two, action, next_two)
    pairs = {name: (value, getattr(next_two, name)) for name, value in vars(next_one).items()}
    return Gaps(
        state={name: largest(*pair) for name, pair in pairs.items()},
        observation=largest(task.observation(next_one), task.observation(next_two)),
        reward=np.max([relative(first[name], second[name]) for name in first], axis=0),
        ending=np.asarray(task.terminal(next_one) != task.terminal(next_two)),
    )
