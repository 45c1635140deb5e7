"""One episode at a time, as a `dm_control.rl.control.Environment`."""

from __future__ import annotations

from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import dm_env.specs
import numpy as np
from dm_control import mujoco as dm_mujoco
from dm_control.mujoco.wrapper import MjModel
from dm_control.rl import control

from tsbench.core.arrays import Array, step_of
from tsbench.core.state import Course, Readings, State
from tsbench.core.task import MDP, SimulatedTask
from tsbench.sim.change import Change
from tsbench.sim.dynamics import expect_finite, expect_shape
from tsbench.sim.kinematic import Planning
from tsbench.sim.model import UNSTABLE, sensor_slices
from tsbench.sim.push import Push
from tsbench.sim.quiet import QUIET

ROW = np.array([0])  # the batch of one that every state here is


class Adapter(control.Task):
    """An MDP as dm_control steps it.

    Attributes:
        mdp: a task or a variant of one.
        state: the current one, with a batch axis of length one.
    """

    def __init__(self, mdp: MDP[Any], rng: np.random.Generator) -> None:
        self.mdp = mdp
        self.rng = rng
        self.state: State
        self._previous: State
        self._action: Array
        self.course: Course
        self._steps = 0

    @abstractmethod
    def begin(self, physics: dm_mujoco.Physics) -> None:
        """Sets `state` and the physics to the start of an episode."""

    def initialize_episode(self, physics: dm_mujoco.Physics) -> None:
        self.begin(physics)
        self._steps = int(step_of(self.state.time, self.mdp.timestep)[0])
        self.course = self.mdp.begun(self.state)

    def before_step(self, action: np.ndarray, physics: dm_mujoco.Physics) -> None:
        self._previous = self.state
        self._action = np.asarray(action, float)[None]
        expect_shape(self._action[0], (self.mdp.action_size,))
        self._steps += 1
        expect_finite(np.array([self._steps]), self._previous, self._action)

    def get_observation(self, physics: dm_mujoco.Physics) -> OrderedDict[str, np.ndarray]:
        observation = self.mdp.observation(self.state)[0]  # may be a part of the state
        return OrderedDict({control.FLAT_OBSERVATION_KEY: observation.copy()})

    def get_reward(self, physics: dm_mujoco.Physics) -> float:
        return float(self.mdp.reward(self._previous, self._action, self.state)[0])

    def get_termination(self, physics: dm_mujoco.Physics) -> float | None:
        """The discount of an episode that ends: 0 at a terminal state, 1 at the last step."""
        if self.mdp.terminal(self.state)[0]:
            return 0.0
        return 1.0 if self._steps >= self.mdp.horizon else None

    def after_step(self, physics: dm_mujoco.Physics) -> None:
        self.follow(physics)
        self.course = self.mdp.followed(self.course, self._previous, self.state)

    @abstractmethod
    def follow(self, physics: dm_mujoco.Physics) -> None:
        """Sets `state` to the state after the step."""

    def spared(self) -> int:
        """Steps that the arrival which ended the episode spares (`MDP.spared`), else zero."""
        ended = bool(self.mdp.terminal(self.state)[0])
        return int(self.mdp.spared(self.state, self.course)[0]) if ended else 0

    def quality(self) -> float:
        """Worth of each spared step as a share of a perfect step (`MDP.quality`), in [0, 1]."""
        return float(self.mdp.quality(self.course)[0])

    def action_spec(self, physics: dm_mujoco.Physics) -> dm_env.specs.BoundedArray:
        return dm_env.specs.BoundedArray(
            (self.mdp.action_size,), np.float64, minimum=-1.0, maximum=1.0, name="action"
        )

    def observation_spec(self, physics: dm_mujoco.Physics) -> OrderedDict[str, dm_env.specs.Array]:
        name = control.FLAT_OBSERVATION_KEY
        spec = dm_env.specs.Array((self.mdp.observation_size,), np.float64, name=name)
        return OrderedDict({name: spec})


class PhysicsAdapter(Adapter):
    """A task, or its imitation variant, in full physics.

    Attributes:
        push: the push that disturbs the episodes, or None.
    """

    def __init__(
        self, task: SimulatedTask[Any], rng: np.random.Generator, perturbed: bool, push: Push | None
    ) -> None:
        super().__init__(task, rng)
        self.task = task
        self.plant = task.plant
        self.perturbed = perturbed
        self.push = push

    def begin(self, physics: dm_mujoco.Physics) -> None:
        start = self.task.start(self.rng, 1, perturbed=self.perturbed)
        self._sensors = sensor_slices(physics.model.ptr)
        physics.data.qpos[:] = start.qpos[0]
        physics.data.qvel[:] = start.qvel[0]
        physics.forward()
        self._read(physics, start.time, start.memory)

    def before_step(self, action: np.ndarray, physics: dm_mujoco.Physics) -> None:
        super().before_step(action, physics)
        ctrl, self._memory = self.plant.control(self.state, self._action)
        physics.set_control(ctrl[0])
        body = physics.model.name2id(self.plant.pushed, "body")
        physics.data.xfrc_applied[body] = 0.0
        if self.push is not None:
            force = self.push.during(self.state.time, self.task.timestep)
            physics.data.xfrc_applied[body, :3] = force[0]

    def follow(self, physics: dm_mujoco.Physics) -> None:
        if not physics.diverged:
            self._read(physics, self.state.time + self.task.timestep, self._memory)

    def after_step(self, physics: dm_mujoco.Physics) -> None:
        super().after_step(physics)
        if physics.diverged:
            self.course = self.course.replace(violated=np.ones(1, bool))

    def get_reward(self, physics: dm_mujoco.Physics) -> float:
        return 0.0 if physics.diverged else super().get_reward(physics)

    def get_termination(self, physics: dm_mujoco.Physics) -> float | None:
        return 0.0 if physics.diverged else super().get_termination(physics)

    def _read(self, physics: dm_mujoco.Physics, time: np.ndarray, memory: np.ndarray) -> None:
        data = physics.data
        self.state = self.plant.read(
            Readings(
                time=time,
                qpos=data.qpos[None].copy(),
                qvel=data.qvel[None].copy(),
                sensors={
                    name: data.sensordata[part][None].copy() for name, part in self._sensors.items()
                },
                memory=memory,
            )
        )


class PlanningAdapter(Adapter):
    """A planning variant, in which inverse kinematics gives every abstract state a full pose."""

    def __init__(self, planning: Planning[Any], rng: np.random.Generator) -> None:
        super().__init__(planning, rng)
        self.planning = planning

    def begin(self, physics: dm_mujoco.Physics) -> None:
        self.state = self.planning.begin(self.rng, ROW)
        self._pose(physics)

    def follow(self, physics: dm_mujoco.Physics) -> None:
        self.state = self.planning.advance(self.state, self._action)
        self._pose(physics)

    def _pose(self, physics: dm_mujoco.Physics) -> None:
        abstraction = self.planning.abstraction
        physics.data.qpos[:] = abstraction.poses(abstraction.flatten(self.state))[0]
        physics.data.qvel[:] = 0.0
        physics.data.time = float(self.state.time[0])
        physics.forward()


class ExactPhysics(dm_mujoco.Physics):
    """dm_control's physics with two changes.

    After a reset the state is computed with actuators enabled. dm_control disables them, and their
    damping would then see zero velocities in the first step. After a step that could not be
    computed the episode ends, as in the batched environment. dm_control would raise an error.

    Attributes:
        diverged: whether the last step could not be computed.
    """

    diverged = False

    def after_reset(self) -> None:
        self.forward()

    @contextmanager
    def check_invalid_state(self) -> Iterator[None]:
        """The context of every computation of dm_control."""
        warnings = self.data.ptr.warning.number
        warnings[:] = 0
        with QUIET:
            yield
        self.diverged = bool(warnings[UNSTABLE].any())


class StillPhysics(dm_mujoco.Physics):
    """A physics whose poses are set and never integrated.

    Attributes:
        plan_timestep: seconds between two poses.
    """

    plan_timestep: float

    def step(self, nstep: int = 1) -> None:
        pass

    def timestep(self) -> float:
        return self.plan_timestep


def environment(
    mdp: SimulatedTask[Any] | Planning[Any],
    seed: int | None = None,
    *,
    perturbed: bool = False,
    push: Push | None = None,
    change: Change | None = None,
) -> control.Environment:
    """One environment of a task or of its planning or imitation variant. `push` disturbs every
    episode and `change` changes the physics; both have no effect on planning."""
    rng = np.random.default_rng(seed)
    if isinstance(mdp, Planning):
        physics = StillPhysics.from_model(MjModel(mdp.task.spec().compile()))
        physics.plan_timestep = mdp.timestep
        return control.Environment(physics, PlanningAdapter(mdp, rng), n_sub_steps=1)
    model = mdp.plant.spec().compile()
    change = change or Change()
    change.apply(model)
    physics = ExactPhysics.from_model(MjModel(model))
    return control.Environment(
        physics,
        PhysicsAdapter(mdp, rng, perturbed, push),
        n_sub_steps=mdp.plant.substeps * change.refine,
    )
