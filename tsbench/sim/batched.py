"""Many episodes of one MDP at once.

The physics runs on `mujoco.batch`, which steps every simulation on a pool of threads that is as
wide as the machine and then brings position and velocity sensors up to date. The bare
`mujoco.rollout` leaves them one substep behind, and mending that takes an extra step.
docs/speed.md says how near the whole comes to the bare rollout.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Generic, Protocol

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from tsbench.core.arrays import Array, step_of
from tsbench.core.errors import NotFiniteError, TsbenchError
from tsbench.core.state import Readings, Rng, S, Start, State
from tsbench.core.task import MDP, SimulatedTask
from tsbench.sim.change import Change
from tsbench.sim.model import UNSTABLE, sensor_slices
from tsbench.sim.push import Push
from tsbench.sim.quiet import QUIET

_CURRENT = int(mujoco.mjtStage.mjSTAGE_VEL)
_NUMBER = 1  # of a kind of warning, beside what it was about, in `Batch.warning`


class Dynamics(Protocol[S]):
    """What turns actions into states, for a fixed number of episodes.

    Attributes:
        diverged: rows in which the last step could not be computed, sorted. They keep the state
            they had before it, and their episodes have to end.
        seconds: spent in a physics engine so far, wall-clock.
    """

    diverged: np.ndarray
    seconds: float

    def begin(self, rng: Rng, rows: np.ndarray) -> S:
        """Starts new episodes in `rows` and returns their states."""

    def advance(self, state: S, action: Array, rows: np.ndarray | None = None) -> S:
        """The states one time step later, of all episodes or only of those in `rows`."""


class LastingDynamics(Dynamics[S], Protocol[S]):
    """Dynamics that can be saved and go on later."""

    def snapshot(self) -> dict[str, Any]:
        """All that it remembers between two calls: plain values and arrays."""

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Goes on from where `snapshot` was taken."""


class Physics(Generic[S]):
    """A task's full physics.

    Attributes:
        batch: the simulations.
        push: what disturbs the episodes, or None.
        substeps: physics steps done so far, all episodes together.
        warnings: how often mujoco has warned, of each kind (mjtWarning), all episodes together.
        diverged: rows in which mujoco met a number that is not finite, or huge, in the last step.
            mujoco itself resets such a simulation and goes on in its midst.
        seconds: spent in mujoco so far, wall-clock.
    """

    def __init__(
        self,
        task: SimulatedTask[S],
        count: int,
        *,
        threads: int | None = None,
        perturbed: bool = False,
        push: Push | None = None,
        change: Change | None = None,
    ) -> None:
        """`threads` None means all cores; `perturbed` picks the task's perturbed starts."""
        self.task = task
        self.plant = task.plant
        self.perturbed = perturbed
        self.push = push
        self.substeps = 0
        self.seconds = 0.0
        self.warnings = np.zeros(int(mujoco.mjtWarning.mjNWARNING), int)
        self.diverged = np.zeros(0, int)
        spec = self.plant.spec()
        spec.compiler.discardvisual = True  # 10 % faster, the same states to the last bit
        model = spec.compile()
        if change is not None:
            change.apply(model)
        # With memory of its own a simulation goes on from the sensors that were brought up to date,
        # which otherwise costs half a substep; among twenty substeps that does not pay.
        self.batch = Batch(model, count, threads or 0, persistent=self.plant.substeps == 1)
        self._sensors = sensor_slices(model)
        self._qpos = self.batch.bind("qpos")
        self._qvel = self.batch.bind("qvel")
        self._ctrl = self.batch.bind("ctrl")
        self._sensordata = self.batch.bind("sensordata")
        self._force = self.batch.bind("xfrc_applied")[:, model.body(self.plant.pushed).id, :3]

    def begin(self, rng: Rng, rows: np.ndarray) -> S:
        return self.place(rows, self.task.start(rng, len(rows), perturbed=self.perturbed))

    def place(self, rows: np.ndarray, start: Start) -> S:
        """Puts the simulations in `rows` where `start` says and returns their states."""
        ids = np.asarray(rows, np.int32)
        began = perf_counter()
        self.batch.reset(ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self._qpos[rows] = start.qpos
        self._qvel[rows] = start.qvel
        with _computing():
            self.batch.forward(ids, stage=_CURRENT)
        self.seconds += perf_counter() - began
        return self._read(rows, start.time, start.memory)

    def advance(self, state: S, action: Array, rows: np.ndarray | None = None) -> S:
        control, memory = self.plant.control(state, action)
        at = slice(None) if rows is None else rows
        self._ctrl[at] = control
        self._force[at] = self.push_force(state.time, at)
        self.batch.warning[:] = 0
        began = perf_counter()
        with _computing():
            ids = None if rows is None else np.asarray(rows, np.int32)
            self.batch.step(ids, nstep=self.plant.substeps, stage=_CURRENT)
        self.seconds += perf_counter() - began
        self.substeps += len(control) * self.plant.substeps
        following = self._read(at, state.time + self.task.timestep, memory)
        warned = self.batch.warning[at, :, _NUMBER]
        self.warnings += warned.sum(axis=0)
        failed = np.flatnonzero(warned[:, UNSTABLE].any(axis=1))
        self.diverged = failed if rows is None else rows[failed]
        if len(failed):
            following = following.updated(failed, state.rows(failed))
        return following

    def push_force(self, time: np.ndarray, rows: np.ndarray | slice) -> np.ndarray:
        """Newtons in the world frame on the pushed body of the simulations in `rows`, over the
        control steps that begin at `time` (n,); shape (n, 3)."""
        if self.push is None:
            return np.zeros((len(time), 3))
        return self.push.rows(rows).during(time, self.task.timestep)

    def warned(self) -> dict[str, int]:
        """How often mujoco has warned, by mujoco's names; without those that never came."""
        return {
            mujoco.mjtWarning(kind).name: int(self.warnings[kind])
            for kind in np.flatnonzero(self.warnings)
        }

    def snapshot(self) -> dict[str, Any]:
        # The rows of mjSTATE_INTEGRATION, from which mujoco continues to the last bit.
        return {
            "simulations": self.batch.state,
            "substeps": self.substeps,
            "warnings": self.warnings,
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.batch.state[:] = snapshot["simulations"]
        self.substeps = snapshot["substeps"]
        self.warnings = snapshot["warnings"]

    def _read(self, rows: Any, time: np.ndarray, memory: np.ndarray) -> S:
        # Copies: the batch's arrays change under whoever holds them.
        sensordata = self._sensordata[rows].copy()
        return self.plant.read(
            Readings(
                time=time,
                qpos=self._qpos[rows].copy(),
                qvel=self._qvel[rows].copy(),
                sensors={name: sensordata[..., part] for name, part in self._sensors.items()},
                memory=memory,
            )
        )


@contextmanager
def _computing() -> Iterator[None]:
    """Silences mujoco's warnings, and tells in one line what it refuses to compute."""
    try:
        with QUIET:
            yield
    except SimulationError as error:
        reason = " ".join(str(error).split())
        raise TsbenchError(f"the physics cannot go on: {reason}") from None


@dataclass(frozen=True)
class Transition(Generic[S]):
    """What a step gave; shapes (n,) unless said otherwise.

    Attributes:
        observation: of the state that follows, shape (n, observation_size); where an episode
            ended, of the next one's start.
        reward: of the step.
        terminal: the episode ended for a reason other than its last step. Its physics having
            diverged is one; the reward of that step is zero.
        truncated: the episode ended with its last step.
        ended: the rows of either kind of ending, shape (k,).
        final: the states that those episodes ended in, k of them.
        spared: steps that an episode which arrived at its goal did not need (`MDP.spared`).
    """

    observation: np.ndarray
    reward: np.ndarray
    terminal: np.ndarray
    truncated: np.ndarray
    ended: np.ndarray
    final: S
    spared: np.ndarray


class BatchedEnvironment(Generic[S]):
    """Episodes of an MDP that are stepped together and begin anew as they end.

    Attributes:
        state: of all episodes.
        steps: steps taken in each episode since its start, shape (n,). An episode that starts
            along a reference motion starts with the steps that lie before.
        violated: whether anything was violated in each episode so far, shape (n,).
        seconds: spent in `step` so far, wall-clock.
    """

    def __init__(self, mdp: MDP[S], dynamics: LastingDynamics[S], count: int, seed: int) -> None:
        self.mdp = mdp
        self.dynamics = dynamics
        self.count = count
        self.rng = np.random.default_rng(seed)
        self.state: S
        self.steps = np.zeros(count, int)
        self.violated = np.zeros(count, bool)
        self.seconds = 0.0

    def reset(self) -> np.ndarray:
        """Starts all episodes; returns the observations, shape (n, observation_size)."""
        self.state = self.dynamics.begin(self.rng, np.arange(self.count))
        self.steps = step_of(self.state.time, self.mdp.timestep)
        self.violated = np.zeros(self.count, bool)
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
        self.violated |= self.mdp.violated(state)
        self.violated[diverged] = True
        truncated = (self.steps >= self.mdp.horizon) & ~terminal
        ended = np.flatnonzero(terminal | truncated)
        final = state.rows(ended)
        spared = np.zeros(self.count, int)
        if len(ended):
            arrived = self.mdp.spared(final, self.violated[ended])
            spared[ended] = np.where(terminal[ended], arrived, 0)
            fresh = self.dynamics.begin(self.rng, ended)
            self.steps[ended] = step_of(fresh.time, self.mdp.timestep)
            self.violated[ended] = False
            state = state.updated(ended, fresh)
        self.state = state
        observation = self.mdp.observation(state)
        self.seconds += perf_counter() - began
        return Transition(observation, reward, terminal, truncated, ended, final, spared)

    def snapshot(self) -> dict[str, Any]:
        """All that the next step depends on, but for the action: plain values and arrays."""
        return {
            "rng": self.rng.bit_generator.state,
            "steps": self.steps,
            "violated": self.violated,
            "state": vars(self.state),
            "dynamics": self.dynamics.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Goes on from where `snapshot` was taken; `reset` must have been called before."""
        self.rng.bit_generator.state = snapshot["rng"]
        self.steps = snapshot["steps"]
        self.violated = snapshot["violated"]
        self.state = self.state.replace(**snapshot["state"])
        self.dynamics.restore(snapshot["dynamics"])


def expect_shape(action: np.ndarray, shape: tuple[int, ...]) -> None:
    """
    Raises:
        TsbenchError: the action has another shape; numpy would stretch or cut some of them.
    """
    if np.shape(action) != shape:
        raise TsbenchError(f"the action has shape {np.shape(action)}, not {shape}")


def expect_finite(
    steps: np.ndarray,
    previous: State,
    action: np.ndarray,
    state: State | None = None,
    reward: np.ndarray | None = None,
    rows: np.ndarray | None = None,
) -> None:
    """Looks at a step of many episodes.

    Args:
        steps: of each episode so far, shape (n,).
        previous: the state before the step.
        action: shape (n, action_size).
        state: the state after it, once it is known.
        reward: of the step, shape (n,), once it is known.
        rows: which of the environments these are, shape (n,), where they are not all.

    Raises:
        NotFiniteError: a number is not finite. It names the episode, its step and the quantity.
    """
    looked_at: dict[str, np.ndarray] = {"action": action}
    if state is not None and reward is not None:
        looked_at = {**vars(state), "reward": reward}
    for name, values in looked_at.items():
        if np.isfinite(values).all():
            continue
        finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
        row = int(np.flatnonzero(~finite)[0])
        before = {f"previous_{key}": value for key, value in vars(previous).items()}
        which = row if rows is None else rows[row]
        raise NotFiniteError(
            f"{name} of environment {which} is not finite at step {steps[row]} of its episode",
            {"steps": steps, **before, "action": action, **looked_at},
        )
