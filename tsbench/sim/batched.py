"""Many episodes of one MDP that are stepped together and begin anew as they end."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Generic

import numpy as np

from tsbench.core.arrays import step_of
from tsbench.core.errors import TsbenchError
from tsbench.core.state import Course, Rng, S
from tsbench.core.task import MDP
from tsbench.sim.dynamics import LastingDynamics, as_action, expect_finite


@dataclass(frozen=True)
class Transition(Generic[S]):
    """The result of a step; shapes are (n,) unless said otherwise.

    Attributes:
        observation: observation of the next state, shape (n, observation_size); where an episode
            ended and the next one began, of its start.
        reward: reward of the step; zero where the physics diverged.
        terminal: whether the episode ended for a reason other than its last step. Divergence of
            the physics is such a reason.
        truncated: whether the episode ended with its last step.
        ended: rows in which an episode ended, shape (k,).
        final: the last states of those episodes, k of them.
        spared: steps that an episode which arrived at its goal did not need (`MDP.spared`).
        quality: what each of those is worth beside a perfect one, in [0, 1].
    """

    observation: np.ndarray
    reward: np.ndarray
    terminal: np.ndarray
    truncated: np.ndarray
    ended: np.ndarray
    final: S
    spared: np.ndarray
    quality: np.ndarray


class BatchedEnvironment(Generic[S]):
    """Episodes of an MDP that are stepped together.

    An action that is refused changes nothing. After a step that failed in any other way, only
    `reset` goes on. The environment belongs to the process that made it, because the threads of its
    physics do not survive a fork.

    Attributes:
        rng: what the starts are drawn from: one generator, or a list of one for each row.
        state: of all episodes.
        steps: steps taken in each episode since its start, shape (n,). An episode that starts
            along a reference motion starts with the steps that lie before.
        course: of all episodes so far.
        seconds: spent in `step` and `advance` so far, wall-clock.
    """

    def __init__(
        self,
        mdp: MDP[S],
        dynamics: LastingDynamics[S],
        count: int,
        seed: int | Sequence[int | None] | None,
    ) -> None:
        """`seed` determines all starts, or is a list of one for each row, which then begins as an
        environment of its own would; None draws fresh entropy."""
        self.mdp = mdp
        self.dynamics = dynamics
        self.count = count
        self.rng: Rng | list[Rng] = (
            [np.random.default_rng(one) for one in seed]
            if isinstance(seed, Sequence)
            else np.random.default_rng(seed)
        )
        self.state: S
        self.steps = np.zeros(count, int)
        self.course: Course
        self.seconds = 0.0
        self._ready = False  # not before `reset`, nor after a failure
        self._process = os.getpid()

    def reset(self) -> np.ndarray:
        """Starts all episodes; returns the observations, shape (n, observation_size).

        Raises:
            TsbenchError: another process has made the environment.
        """
        self._expect_own_process()
        self.state = self._started(np.arange(self.count))
        self.steps = step_of(self.state.time, self.mdp.timestep)
        self.course = self.mdp.begun(self.state)
        self._ready = True
        return self.observation()

    def step(self, action: np.ndarray) -> Transition[S]:
        """One time step of all episodes; where an episode ends, the next one begins.

        Args:
            action: shape (n, action_size).

        Raises:
            TsbenchError: the action is refused, `reset` must come first, or another process has
                made the environment.
            NotFiniteError: a number in action, state or reward is not finite.
        """
        return self._stepped(action, None, begin=True)

    def advance(self, action: np.ndarray, rows: np.ndarray | None = None) -> Transition[S]:
        """As `step`, but no episode begins: those that end wait for `begin`.

        Args:
            action: shape (n, action_size).
            rows: the episodes to step, at least one; None for all. The others stay as they are, and
                have a reward of zero.
        """
        return self._stepped(action, rows, begin=False)

    def begin(self, rows: np.ndarray) -> None:
        """Starts new episodes in `rows`.

        Raises:
            TsbenchError: as `step`.
        """
        self.expect_ready()
        fresh = self._started(rows)
        self.steps[rows] = step_of(fresh.time, self.mdp.timestep)
        self.course = self.course.updated(rows, self.mdp.begun(fresh))
        self.state = self.state.updated(rows, fresh)

    def expect_ready(self) -> None:
        """Checks that the episodes can go on.

        Raises:
            TsbenchError: `reset` must come first, or another process has made the environment.
        """
        self._expect_own_process()
        if not self._ready:
            raise TsbenchError(
                "call reset() first: the environments were never reset, or their last step failed"
            )

    def observation(self) -> np.ndarray:
        """Of all episodes, shape (n, observation_size)."""
        observation: np.ndarray = self.mdp.observation(self.state)
        return observation

    def value_observation(self) -> np.ndarray:
        """What a critic sees, shape (n, any): as the MDP says, and what the dynamics hide."""
        value: np.ndarray = self.mdp.value_observation(self.state)
        unseen = self.dynamics.unseen()
        return np.column_stack([value, *unseen]) if unseen else value

    def snapshot(self) -> dict[str, Any]:
        """Everything that the next step depends on besides the action: plain values and arrays."""
        states = [rng.bit_generator.state for rng in self._generators]
        return {
            "rng": states if isinstance(self.rng, list) else states[0],
            "steps": self.steps,
            "course": vars(self.course),
            "state": vars(self.state),
            "dynamics": self.dynamics.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot.

        Raises:
            TsbenchError: as `step`.
        """
        self.expect_ready()
        states = snapshot["rng"]
        states = states if isinstance(self.rng, list) else [states]
        for rng, state in zip(self._generators, states, strict=True):
            rng.bit_generator.state = state
        self.steps = snapshot["steps"]
        self.course = self.course.replace(**snapshot["course"])
        self.state = self.state.replace(**snapshot["state"])
        self.dynamics.restore(snapshot["dynamics"])

    @property
    def _generators(self) -> list[Rng]:
        return self.rng if isinstance(self.rng, list) else [self.rng]

    def _started(self, rows: np.ndarray) -> S:
        """The first states of new episodes in `rows`."""
        if not isinstance(self.rng, list):
            return self.dynamics.begin(self.rng, rows)
        alone = [self.dynamics.begin(self.rng[row], rows[i : i + 1]) for i, row in enumerate(rows)]
        return alone[0].joined(alone)

    def _stepped(
        self, action: np.ndarray, rows: np.ndarray | None, *, begin: bool
    ) -> Transition[S]:
        began = perf_counter()
        self.expect_ready()
        action = as_action(action, (self.count, self.mdp.action_size))
        previous, course, steps = self.state, self.course, self.steps + 1
        if rows is not None:
            previous, course = previous.rows(rows), course.rows(rows)
            action, steps = action[rows], steps[rows]
        expect_finite(steps, previous, action, rows=rows)
        self._ready = False
        state = self.dynamics.advance(previous, action, rows)
        reward = self.mdp.reward(previous, action, state)
        expect_finite(steps, previous, action, state, reward, rows)
        terminal = self.mdp.terminal(state)
        diverged = self.dynamics.diverged
        if rows is not None:
            diverged = np.flatnonzero(np.isin(rows, diverged))
        if len(diverged):
            reward[diverged], terminal[diverged] = 0.0, True
        course = self.mdp.followed(course, previous, state)
        course.violated[diverged] = True
        truncated = (steps >= self.mdp.horizon) & ~terminal
        ended = np.flatnonzero(terminal | truncated)
        final = state.rows(ended)
        spared, quality = np.zeros(len(steps), int), np.zeros(len(steps))
        if len(ended):
            history = course.rows(ended)
            spared[ended] = np.where(terminal[ended], self.mdp.spared(final, history), 0)
            quality[ended] = self.mdp.quality(history)
        if rows is not None:
            state, course = self.state.updated(rows, state), self.course.updated(rows, course)
            steps = self._among_all(rows, steps, self.steps)
            reward, terminal, truncated, spared, quality = (
                self._among_all(rows, part)
                for part in (reward, terminal, truncated, spared, quality)
            )
            ended = rows[ended]
        self.state, self.course, self.steps = state, course, steps
        self._ready = True
        if begin and len(ended):
            self.begin(ended)
        observation = self.observation()
        self.seconds += perf_counter() - began
        return Transition(observation, reward, terminal, truncated, ended, final, spared, quality)

    def _among_all(
        self, rows: np.ndarray, values: np.ndarray, others: np.ndarray | None = None
    ) -> np.ndarray:
        """Values of all rows: those of `rows`, and of the others, by default zero."""
        among = np.zeros(self.count, values.dtype) if others is None else others.copy()
        among[rows] = values
        return among

    def _expect_own_process(self) -> None:
        if os.getpid() != self._process:
            raise TsbenchError(
                "these environments were made in another process, and their threads are not in "
                "this one: make them in the process that steps them"
            )
