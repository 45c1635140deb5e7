"""Many episodes of one MDP that are stepped together and begin anew as they end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Generic

import numpy as np

from tsbench.core.arrays import step_of
from tsbench.core.state import Course, S
from tsbench.core.task import MDP
from tsbench.sim.dynamics import LastingDynamics, expect_finite, expect_shape


@dataclass(frozen=True)
class Transition(Generic[S]):
    """The result of a step; shapes are (n,) unless said otherwise.

    Attributes:
        observation: observation of the next state, shape (n, observation_size); where an episode
            ended, of the start of the next episode.
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
    """Episodes of an MDP that are stepped together and begin anew as they end.

    Attributes:
        state: of all episodes.
        steps: steps taken in each episode since its start, shape (n,). An episode that starts
            along a reference motion starts with the steps that lie before.
        course: of all episodes so far.
        seconds: spent in `step` so far, wall-clock.
    """

    def __init__(self, mdp: MDP[S], dynamics: LastingDynamics[S], count: int, seed: int) -> None:
        self.mdp = mdp
        self.dynamics = dynamics
        self.count = count
        self.rng = np.random.default_rng(seed)
        self.state: S
        self.steps = np.zeros(count, int)
        self.course: Course
        self.seconds = 0.0

    def reset(self) -> np.ndarray:
        """Starts all episodes; returns the observations, shape (n, observation_size)."""
        self.state = self.dynamics.begin(self.rng, np.arange(self.count))
        self.steps = step_of(self.state.time, self.mdp.timestep)
        self.course = self.mdp.begun(self.state)
        observation: np.ndarray = self.mdp.observation(self.state)
        return observation

    def step(self, action: np.ndarray) -> Transition[S]:
        """One time step of all episodes; `action` has shape (n, action_size).

        Raises:
            TsbenchError: the action has another shape.
            NotFiniteError: a number in action, state or reward is not finite.
        """
        began = perf_counter()
        expect_shape(action, (self.count, self.mdp.action_size))
        previous = self.state
        self.steps += 1
        expect_finite(self.steps, previous, action)
        state = self.dynamics.advance(previous, action)
        reward = self.mdp.reward(previous, action, state)
        expect_finite(self.steps, previous, action, state, reward)
        terminal = self.mdp.terminal(state)
        diverged = self.dynamics.diverged
        if len(diverged):
            reward[diverged], terminal[diverged] = 0.0, True
        self.course = self.mdp.followed(self.course, previous, state)
        self.course.violated[diverged] = True
        truncated = (self.steps >= self.mdp.horizon) & ~terminal
        ended = np.flatnonzero(terminal | truncated)
        final = state.rows(ended)
        spared, quality = np.zeros(self.count, int), np.zeros(self.count)
        if len(ended):
            course = self.course.rows(ended)
            spared[ended] = np.where(terminal[ended], self.mdp.spared(final, course), 0)
            quality[ended] = self.mdp.quality(course)
            fresh = self.dynamics.begin(self.rng, ended)
            self.steps[ended] = step_of(fresh.time, self.mdp.timestep)
            self.course = self.course.updated(ended, self.mdp.begun(fresh))
            state = state.updated(ended, fresh)
        self.state = state
        observation = self.mdp.observation(state)
        self.seconds += perf_counter() - began
        return Transition(observation, reward, terminal, truncated, ended, final, spared, quality)

    def value_observation(self) -> np.ndarray:
        """What a critic sees, shape (n, any): as the MDP says, and what the dynamics hide."""
        value: np.ndarray = self.mdp.value_observation(self.state)
        unseen = self.dynamics.unseen()
        return np.column_stack([value, *unseen]) if unseen else value

    def snapshot(self) -> dict[str, Any]:
        """Everything that the next step depends on besides the action: plain values and arrays."""
        return {
            "rng": self.rng.bit_generator.state,
            "steps": self.steps,
            "course": vars(self.course),
            "state": vars(self.state),
            "dynamics": self.dynamics.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot; `reset` must have been called before."""
        self.rng.bit_generator.state = snapshot["rng"]
        self.steps = snapshot["steps"]
        self.course = self.course.replace(**snapshot["course"])
        self.state = self.state.replace(**snapshot["state"])
        self.dynamics.restore(snapshot["dynamics"])
