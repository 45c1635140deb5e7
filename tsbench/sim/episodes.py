"""Whole episodes under a policy, many side by side, each played once to its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic

import numpy as np

from tsbench.mdp import MDP, S
from tsbench.sim.batched import Dynamics, expect_finite

PolicyFunction = Callable[[np.ndarray], np.ndarray]  # observations (n, o) -> actions (n, a)


@dataclass(frozen=True)
class Episodes(Generic[S]):
    """n episodes of at most T steps.

    Attributes:
        rewards: shape (T, n); zero once an episode has ended.
        lengths: steps taken, shape (n,).
        reached: whether the episode ended at its goal, unspoiled, shape (n,).
        violated: whether something spoiled it on the way, shape (n,). Its physics having diverged,
            which ends it with a reward of zero for that step, does.
        diverged: whether that happened, shape (n,).
        final: the last state of each episode.
        states: what `record` made of every state, start included, shape (T + 1, n, ...), each
            episode's last one repeated after its end; None without `record`.
        actions: shape (T, n, action_size), zero once an episode has ended.
        max_reward: per time step.
    """

    rewards: np.ndarray
    lengths: np.ndarray
    reached: np.ndarray
    violated: np.ndarray
    diverged: np.ndarray
    final: S
    states: np.ndarray | None
    actions: np.ndarray
    max_reward: float

    @property
    def returns(self) -> np.ndarray:
        """Undiscounted, shape (n,). The steps missing from an episode that ended at its goal
        count as perfect ones, those missing from any other as nothing."""
        credit = self.reached * (len(self.rewards) - self.lengths) * self.max_reward
        total: np.ndarray = self.rewards.sum(axis=0) + credit
        return total

    @property
    def normalized(self) -> np.ndarray:
        """Returns over the largest conceivable one, shape (n,)."""
        return self.returns / (self.max_reward * len(self.rewards))


def play(
    mdp: MDP[S],
    dynamics: Dynamics[S],
    policy: PolicyFunction,
    count: int,
    seed: int,
    record: Callable[[S], np.ndarray] | None = None,
    disturb: Callable[[int], None] | None = None,
) -> Episodes[S]:
    """Plays `count` episodes. `disturb` is called with the step's number before each step.

    Raises:
        NotFiniteError: a number in action, state or reward is not finite.
    """
    rng = np.random.default_rng(seed)
    state: Any = dynamics.begin(rng, np.arange(count))
    final = state
    alive = np.ones(count, bool)
    reached, violated, diverged = (np.zeros(count, bool) for _ in range(3))
    lengths = np.zeros(count, int)
    rewards = np.zeros((mdp.horizon, count))
    actions = np.zeros((mdp.horizon, count, mdp.action_size))
    recorded = [record(state)] if record else []
    for step in range(mdp.horizon):
        if disturb is not None:
            disturb(step)
        action = policy(mdp.observation(state))
        following = dynamics.advance(state, action)
        reward = mdp.reward(state, action, following)
        failed = np.zeros(count, bool)
        failed[dynamics.diverged] = True
        reward[failed] = 0.0
        expect_finite(lengths + 1, state, action, following, reward)
        rewards[step, alive] = reward[alive]
        actions[step, alive] = action[alive]
        lengths[alive] += 1
        diverged |= alive & failed
        violated |= alive & (mdp.violated(following) | failed)
        rows = np.flatnonzero(alive)
        final = final.updated(rows, following.rows(rows))
        ended = alive & (mdp.terminal(following) | failed)
        reached |= ended & mdp.reached(following) & ~violated
        alive &= ~ended
        state = following
        if record:
            playing = _like(lengths == step + 1, recorded[-1])
            recorded.append(np.where(playing, record(state), recorded[-1]))
        if not alive.any():
            break
    if record:
        recorded += [recorded[-1]] * (mdp.horizon + 1 - len(recorded))
    return Episodes(
        rewards=rewards,
        lengths=lengths,
        reached=reached,
        violated=violated,
        diverged=diverged,
        final=final,
        states=np.stack(recorded) if record else None,
        actions=actions,
        max_reward=mdp.max_reward,
    )


def _like(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    return mask.reshape(-1, *[1] * (values.ndim - 1))
