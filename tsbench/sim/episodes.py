"""Whole episodes under a policy, many side by side, each played once to its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic

import numpy as np

from tsbench.core.arrays import Array, step_of
from tsbench.core.state import Course, S
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
        spared: steps that an arrival at the goal left of the horizon, shape (n,).
        course: the course of each episode. Diverged physics is a violation. It ends the episode
            with a reward of zero for that step.
        diverged: whether the physics diverged, shape (n,).
        cut: whether the episode ended for a reason other than its goal or its last step, (n,).
        credit: the reward of the spared steps (`MDP.credit`), shape (n,).
        first: the first state of each episode.
        final: the last state of each episode.
        sums: the results of `measure`, summed over the steps of each episode, by name, each of
            shape (n,). A step at which the physics diverged adds nothing.
        states: the results of `record` for every state, the start included, shape
            (T + 1, n, ...). An episode's last result is repeated after its end. None without
            `record`.
        actions: the applied actions, shape (T, n, action_size), zero after an episode's end.
        max_reward: per time step.
    """

    rewards: np.ndarray
    lengths: np.ndarray
    limits: np.ndarray
    spared: np.ndarray
    course: Course
    diverged: np.ndarray
    cut: np.ndarray
    credit: np.ndarray
    first: S
    final: S
    sums: dict[str, np.ndarray]
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
        """Whether the episode went on without a violation to its goal or last step, shape (n,)."""
        survived: np.ndarray = ~self.course.violated & ~self.cut
        return survived


def play(
    mdp: MDP[S],
    dynamics: Dynamics[S],
    policy: PolicyFunction | Array,
    count: int,
    seed: int = 0,
    record: Callable[[S], np.ndarray] | None = None,
    *,
    begin: S | None = None,
    course: Course | None = None,
    delay: int = 0,
    measure: Callable[[S, Array, S], Mapping[str, Array]] | None = None,
) -> Episodes[S]:
    """Plays `count` episodes.

    Args:
        mdp: what is played.
        dynamics: what steps it.
        policy: sees only the episodes that have not ended. Or the actions to play, shape
            (steps, count, action_size), of which those after an episode's end are not used.
        count: of episodes.
        seed: of their starts.
        record: what to keep of all states.
        begin: the states to go on from instead of new starts; `dynamics` must be there.
        course: that led to them, by default none.
        delay: steps between an action's observation and its use; zero actions come before it.
        measure: what to sum over the steps of each episode, by name (`Task.measured`).

    Raises:
        NotFiniteError: a number in action, state or reward is not finite.
    """
    rows = np.arange(count)
    state = dynamics.begin(np.random.default_rng(seed), rows) if begin is None else begin
    first = final = state
    begun = step_of(state.time, mdp.timestep)
    limits = mdp.horizon - begun
    longest = int(limits.max())
    diverged, cut = (np.zeros(count, bool) for _ in range(2))
    course = mdp.begun(state) if course is None else course
    sums: dict[str, np.ndarray] = {}
    lengths, spared = np.zeros(count, int), np.zeros(count, int)
    rewards = np.zeros((longest, count))
    actions = np.zeros((longest, count, mdp.action_size))
    pending = np.zeros((delay, count, mdp.action_size))
    recorded = [record(state)] if record else []
    for step in range(longest):
        if callable(policy):
            action = np.asarray(policy(mdp.observation(state)))
        else:
            action = policy[step, rows]
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
        if measure is not None:
            for name, value in measure(state, action, following).items():
                sums.setdefault(name, np.zeros(count))[rows] += np.where(failed, 0.0, value)
        actions[step, rows] = action
        diverged[rows] = failed
        passed = mdp.followed(course.rows(rows), state, following)
        passed.violated[failed] = True
        course = course.updated(rows, passed)
        terminal, at_goal = mdp.terminal(following) | failed, mdp.reached(following)
        spared[rows] = np.where(terminal, mdp.spared(following, passed), 0)
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
        course=course,
        diverged=diverged,
        cut=cut,
        credit=mdp.credit(spared, mdp.quality(course)),
        first=first,
        final=final,
        sums=sums,
        states=np.stack(recorded) if record else None,
        actions=actions,
        max_reward=mdp.max_reward,
    )
