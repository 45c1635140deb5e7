"""Whole episodes under a policy, many side by side, each played once to its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic

import numpy as np

from tsbench.core.arrays import step_of
from tsbench.core.state import S
from tsbench.core.task import MDP
from tsbench.sim.dynamics import Dynamics, expect_finite

PolicyFunction = Callable[[np.ndarray], np.ndarray]  # observations (n, o) -> actions (n, a)


@dataclass(frozen=True)
class Episodes(Generic[S]):
    """n episodes of at most T steps.

    Attributes:
        rewards: shape (T, n); zero once an episode has ended.
        lengths: steps taken, shape (n,).
        limits: steps that could be taken, shape (n,): T, or less where an episode began late.
        spared: steps that the episode did not need, since it arrived at its goal, shape (n,).
        violated: whether something spoiled it on the way, shape (n,). Its physics having diverged,
            which ends it with a reward of zero for that step, does.
        diverged: whether that happened, shape (n,).
        cut: whether the episode ended for a reason other than its goal or its last step, (n,).
        credit: what the spared steps earn (`MDP.credit`), shape (n,).
        final: the last state of each episode.
        states: results of `record` for every state, start included, shape (T + 1, n, ...); the last
            one is repeated after an episode's end. None without `record`.
        actions: as they were applied, shape (T, n, action_size), zero once an episode has ended.
        max_reward: per time step.
    """

    rewards: np.ndarray
    lengths: np.ndarray
    limits: np.ndarray
    spared: np.ndarray
    violated: np.ndarray
    diverged: np.ndarray
    cut: np.ndarray
    credit: np.ndarray
    final: S
    states: np.ndarray | None
    actions: np.ndarray
    max_reward: float

    @property
    def returns(self) -> np.ndarray:
        """Undiscounted returns, shape (n,). They include the credit of steps spared by arrivals."""
        total: np.ndarray = self.rewards.sum(axis=0) + self.credit
        return total

    @property
    def normalized(self) -> np.ndarray:
        """Returns divided by the return of `max_reward` in every step, shape (n,)."""
        return self.returns / (self.max_reward * self.limits)

    @property
    def survived(self) -> np.ndarray:
        """Whether it went on unspoiled to its goal or its last step, shape (n,)."""
        return ~self.violated & ~self.cut


def play(
    mdp: MDP[S],
    dynamics: Dynamics[S],
    policy: PolicyFunction,
    count: int,
    seed: int = 0,
    record: Callable[[S], np.ndarray] | None = None,
    *,
    begin: S | None = None,
    delay: int = 0,
) -> Episodes[S]:
    """Plays `count` episodes.

    Args:
        mdp: the task or variant to play.
        dynamics: the dynamics that step it.
        policy: gets the observations of only the episodes that have not ended.
        count: number of episodes.
        seed: seed of the starts.
        record: function of the state whose results are kept for all states.
        begin: states to continue from instead of new starts; `dynamics` must be in these states.
        delay: time steps from an observation to the use of its action; actions are zero until then.

    Raises:
        NotFiniteError: a number in action, state or reward is not finite.
    """
    rows = np.arange(count)
    state = dynamics.begin(np.random.default_rng(seed), rows) if begin is None else begin
    final = state
    begun = step_of(state.time, mdp.timestep)
    limits = mdp.horizon - begun
    longest = int(limits.max())
    violated, diverged, cut = (np.zeros(count, bool) for _ in range(3))
    lengths, spared = np.zeros(count, int), np.zeros(count, int)
    rewards = np.zeros((longest, count))
    actions = np.zeros((longest, count, mdp.action_size))
    pending = np.zeros((delay, count, mdp.action_size))
    recorded = [record(state)] if record else []
    for step in range(longest):
        action = np.asarray(policy(mdp.observation(state)))
        if delay:
            due = pending[step % delay, rows]
            pending[step % delay, rows] = action
            action = due
        following = dynamics.advance(state, action, rows)
        reward = mdp.reward(state, action, following)
        failed = np.isin(rows, dynamics.diverged)
        reward[failed] = 0.0
        lengths[rows] += 1
        expect_finite(lengths[rows], state, action, following, reward, rows)
        rewards[step, rows] = reward
        actions[step, rows] = action
        diverged[rows] = failed
        violated[rows] |= mdp.violated(following) | failed
        terminal, at_goal = mdp.terminal(following) | failed, mdp.reached(following)
        spared[rows] = np.where(terminal, mdp.spared(following, violated[rows]), 0)
        cut[rows] = terminal & ~at_goal
        going = ~terminal & (lengths[rows] < limits[rows])
        if record:
            final = final.updated(rows, following)
            recorded.append(record(final))
        else:
            final = final.updated(rows[~going], following.rows(~going))
        state, rows = following.rows(going), rows[going]
        if not len(rows):
            break
    if record:
        recorded += [recorded[-1]] * (longest + 1 - len(recorded))
    return Episodes(
        rewards=rewards,
        lengths=lengths,
        limits=limits,
        spared=spared,
        violated=violated,
        diverged=diverged,
        cut=cut,
        credit=mdp.credit(spared),
        final=final,
        states=np.stack(recorded) if record else None,
        actions=actions,
        max_reward=mdp.max_reward,
    )
