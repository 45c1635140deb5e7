"""One episode at a time, as a `dm_control.rl.control.Environment`.

Each environment has one home for its randomness, a bit generator that `task.rng` and dm_control's
`task.random` both draw from, and one for its state: `physics.get_state()` is all that the next step
depends on beside the action, and `physics.set_state` goes on from there.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import dm_env
import dm_env.specs
import numpy as np
from dm_control import mujoco as dm_mujoco
from dm_control.mujoco.wrapper import MjModel
from dm_control.rl import control

from tsbench.core.arrays import Array, step_of
from tsbench.core.errors import TsbenchError
from tsbench.core.state import Batch, Course, Readings, Rng, State
from tsbench.core.task import MDP, SimulatedTask
from tsbench.sim.change import Change
from tsbench.sim.dynamics import as_action, expect_finite
from tsbench.sim.kinematic import Planning
from tsbench.sim.model import UNSTABLE, sensor_slices
from tsbench.sim.push import Push
from tsbench.sim.quiet import QUIET

B = TypeVar("B", bound=Batch)

ROW = np.array([0])  # the batch of one that every state here is


class Adapter(control.Task):
    """An MDP as dm_control steps it.

    Attributes:
        mdp: a task or a variant of one.
        state: the current one, with a batch axis of length one.
        course: of the episode so far.
        resumed: whether `physics.set_state` has put the environment into an episode that the next
            step goes on with.
    """

    def __init__(self, mdp: MDP[Any], rng: Rng) -> None:
        self.mdp = mdp
        self.rng = rng
        self.state: State
        self._previous: State
        self._action: Array
        self.course: Course
        self.resumed = False
        self._steps = 0

    @property
    def random(self) -> np.random.RandomState:
        """The generator under the name and of the kind that dm_control's wrappers expect. It draws
        from the bits of `rng`. Setting `_random`, as Shimmy does, replaces both."""
        return self._random

    @property
    def rng(self) -> Rng:
        """What the starts are drawn from."""
        return np.random.Generator(self._random._bit_generator)

    @rng.setter
    def rng(self, rng: Rng) -> None:
        self._random = np.random.RandomState(rng.bit_generator)

    @abstractmethod
    def begin(self, physics: TaskPhysics) -> None:
        """Sets `state` and the physics to the start of an episode."""

    def initialize_episode(self, physics: TaskPhysics) -> None:
        self.begin(physics)
        self._steps = self._step()
        self.course = self.mdp.begun(self.state)
        self.resumed = False

    def before_step(self, action: np.ndarray, physics: TaskPhysics) -> None:
        action = as_action(action, (self.mdp.action_size,))[None]
        expect_finite(np.array([self._steps + 1]), self.state, action)
        if not physics.current:
            self.reread(physics)
        self._previous = self.state
        self._action = action
        self._steps += 1

    def get_observation(self, physics: TaskPhysics) -> OrderedDict[str, np.ndarray]:
        if not physics.current:
            self.reread(physics)
        observation = self.mdp.observation(self.state)[0]  # may be a part of the state
        return OrderedDict({control.FLAT_OBSERVATION_KEY: observation.copy()})

    def get_reward(self, physics: TaskPhysics) -> float:
        return float(self.mdp.reward(self._previous, self._action, self.state)[0])

    def get_termination(self, physics: TaskPhysics) -> float | None:
        """The discount of an episode that ends: 0 at a terminal state, 1 at the last step."""
        if self.mdp.terminal(self.state)[0]:
            return 0.0
        return 1.0 if self._steps >= self.mdp.horizon else None

    def after_step(self, physics: TaskPhysics) -> None:
        self.follow(physics)
        self.course = self.mdp.followed(self.course, self._previous, self.state)

    @abstractmethod
    def follow(self, physics: TaskPhysics) -> None:
        """Sets `state` to the state after the step."""

    @abstractmethod
    def reread(self, physics: TaskPhysics) -> None:
        """Brings `state` up to date with positions and velocities that were changed between two
        steps."""

    def remembered(self) -> np.ndarray:
        """What the next steps depend on beside positions and velocities, shape (k,)."""
        return np.concatenate([self._memory(), _numbers(self.course)])

    def recall(self, numbers: np.ndarray, physics: TaskPhysics) -> None:
        """Goes on from positions and velocities that were set and from what was `remembered`."""
        split = len(numbers) - len(_numbers(self.course))
        self._recall(numbers[:split], physics)
        self.course = _filled(self.course, numbers[split:])
        self._steps = self._step()
        self.resumed = True

    @abstractmethod
    def _memory(self) -> np.ndarray:
        """The part of `remembered` that is not the course."""

    @abstractmethod
    def _recall(self, memory: np.ndarray, physics: TaskPhysics) -> None:
        """Sets `state` from positions, velocities and `memory`."""

    def _step(self) -> int:
        """The number of the present time step of the episode."""
        return int(step_of(self.state.time, self.mdp.timestep)[0])

    def spared(self) -> int:
        """Steps that the arrival which ended the episode spares (`MDP.spared`), else zero."""
        ended = bool(self.mdp.terminal(self.state)[0])
        return int(self.mdp.spared(self.state, self.course)[0]) if ended else 0

    def quality(self) -> float:
        """Worth of each spared step as a share of a perfect step (`MDP.quality`), in [0, 1]."""
        return float(self.mdp.quality(self.course)[0])

    def action_spec(self, physics: TaskPhysics) -> dm_env.specs.BoundedArray:
        # A bound for each number: dm_control's noise wrapper draws as many as there are bounds.
        bound = np.ones(self.mdp.action_size)
        return dm_env.specs.BoundedArray(bound.shape, np.float64, -bound, bound, "action")

    def observation_spec(self, physics: TaskPhysics) -> OrderedDict[str, dm_env.specs.Array]:
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
        if push is not None:
            push.expect_count(1)
        self.task = task
        self.plant = task.plant
        self.perturbed = perturbed
        self.push = push
        self._remembers: Array  # the memory that the controls of the step leave

    def begin(self, physics: TaskPhysics) -> None:
        start = self.task.start(self.rng, 1, perturbed=self.perturbed)
        self._sensors = sensor_slices(physics.model.ptr)
        physics.data.time = float(start.time[0])
        physics.data.qpos[:] = start.qpos[0]
        physics.data.qvel[:] = start.qvel[0]
        physics.forward()
        self._read(physics, start.time, start.memory)

    def before_step(self, action: np.ndarray, physics: TaskPhysics) -> None:
        super().before_step(action, physics)
        ctrl, self._remembers = self.plant.control(self.state, self._action)
        physics.set_control(ctrl[0])
        if self.push is not None:
            force = self.push.during(self.state.time, self.task.timestep)
            body = physics.model.name2id(self.plant.pushed, "body")
            physics.data.xfrc_applied[body, :3] = force[0]

    def follow(self, physics: TaskPhysics) -> None:
        if physics.diverged:
            physics.current = True  # the episode ends in the state before
        else:
            self._read(physics, self.state.time + self.task.timestep, self._remembers)

    def reread(self, physics: TaskPhysics) -> None:
        self._read(physics, self.state.time, self.plant.memory(self.state))

    def _memory(self) -> np.ndarray:
        return np.concatenate([self.state.time, self.plant.memory(self.state)[0]])

    def _recall(self, memory: np.ndarray, physics: TaskPhysics) -> None:
        physics.data.time = memory[0]
        self._read(physics, memory[:1], memory[None, 1:])

    def after_step(self, physics: TaskPhysics) -> None:
        super().after_step(physics)
        if physics.diverged:
            self.course = self.course.replace(violated=np.ones(1, bool))

    def get_reward(self, physics: TaskPhysics) -> float:
        return 0.0 if physics.diverged else super().get_reward(physics)

    def get_termination(self, physics: TaskPhysics) -> float | None:
        return 0.0 if physics.diverged else super().get_termination(physics)

    def _read(self, physics: TaskPhysics, time: np.ndarray, memory: np.ndarray) -> None:
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
        physics.current = True


class PlanningAdapter(Adapter):
    """A planning variant, in which inverse kinematics gives every abstract state a full pose."""

    def __init__(self, planning: Planning[Any], rng: np.random.Generator) -> None:
        super().__init__(planning, rng)
        self.planning = planning

    def begin(self, physics: TaskPhysics) -> None:
        self.state = self.planning.begin(self.rng, ROW)
        self._pose(physics)

    def follow(self, physics: TaskPhysics) -> None:
        self.state = self.planning.advance(self.state, self._action)
        self._pose(physics)

    def reread(self, physics: TaskPhysics) -> None:
        self._pose(physics)  # which follows from the abstract state

    def _memory(self) -> np.ndarray:
        return _numbers(self.state)

    def _recall(self, memory: np.ndarray, physics: TaskPhysics) -> None:
        self.state = _filled(self.state, memory)
        self._pose(physics)

    def _pose(self, physics: TaskPhysics) -> None:
        abstraction = self.planning.abstraction
        physics.data.qpos[:] = abstraction.poses(abstraction.flatten(self.state))[0]
        physics.data.qvel[:] = 0.0
        physics.data.time = float(self.state.time[0])
        physics.forward()
        physics.current = True


class TaskPhysics(dm_mujoco.Physics):
    """The physics of an environment, whose state is that of the environment.

    After a reset the state is computed with actuators enabled. dm_control disables them, and their
    damping would then see zero velocities in the first step.

    As everywhere in dm_control, `forward()` has to follow a change of `data`. The task then reads
    the new positions and velocities; its clock, its memory and the course of the episode stay.

    Attributes:
        task: of the environment; None for a copy, which is mere physics.
        current: whether the task's state is that of the positions and velocities.
        diverged: whether the last step could not be computed.
    """

    task: Adapter | None = None
    current = False
    diverged = False

    def get_state(self, sig: int | None = None) -> np.ndarray:
        """The whole state: positions and velocities as dm_control has them, then what the task
        remembers: its clock, the memory of its controller, the course of the episode, and in the
        planning variant the abstract state. With `sig`, mujoco's own state of that signature."""
        state: np.ndarray = super().get_state(sig)
        if sig is not None or self.task is None:
            return state
        return np.concatenate([state, self.task.remembered()])

    def set_state(self, physics_state: np.ndarray, sig: int | None = None) -> None:
        """Sets a state that `get_state` returned; the next step of the environment goes on from it,
        even if the present episode has ended. With `sig`, only mujoco's state of that signature.

        Raises:
            TsbenchError: the state has another size, or is not finite. Nothing has changed.
        """
        if sig is not None or self.task is None:
            super().set_state(physics_state, sig)
            self.forward()
            return
        state = np.asarray(physics_state, float)
        own, size = super().get_state().size, self.get_state().size
        if state.shape != (size,):
            raise TsbenchError(
                f"a state of {self.task.mdp.name} has the shape ({size},), not {state.shape}: "
                f"{own} positions and velocities, and what physics.get_state() adds to them"
            )
        if not np.isfinite(state).all():
            raise TsbenchError("the state is not finite")
        super().set_state(state[:own])
        self.forward()
        self.task.recall(state[own:], self)

    def after_reset(self) -> None:
        current = self.current
        self.forward()
        self.current = current  # nothing has changed since the task read it

    def __getstate__(self) -> tuple[Any, Adapter | None]:
        return super().__getstate__(), self.task

    def __setstate__(self, state: tuple[Any, Adapter | None]) -> None:
        data, self.task = state
        super().__setstate__(data)


class ExactPhysics(TaskPhysics):
    """dm_control's physics, but after a step that could not be computed the episode ends, as in the
    batched environment. dm_control would raise an error."""

    @contextmanager
    def check_invalid_state(self) -> Iterator[None]:
        """The context of every computation of dm_control."""
        self.current = False
        warnings = self.data.ptr.warning.number
        warnings[:] = 0
        with QUIET:
            yield
        self.diverged = bool(warnings[UNSTABLE].any())


class StillPhysics(TaskPhysics):
    """A physics whose poses are set and never integrated."""

    def forward(self) -> None:
        super().forward()
        self.current = False

    def step(self, nstep: int = 1) -> None:
        pass

    def timestep(self) -> float:
        """Seconds between two poses."""
        return super().timestep() if self.task is None else self.task.mdp.timestep


class Environment(control.Environment):
    """A dm_control environment that can go on from any of its states.

    A step before the first reset, or after the end of an episode, begins a new episode and ignores
    the action, as dm_env has it. An action that is refused changes nothing.
    """

    @property
    def over(self) -> bool:
        """Whether the next step begins a new episode."""
        return bool(self._reset_next_step and not self._task.resumed)

    def step(self, action: Any) -> dm_env.TimeStep:
        if self._task.resumed:
            self._task.resumed = self._reset_next_step = False
        return super().step(action)


def environment(
    mdp: SimulatedTask[Any] | Planning[Any],
    seed: int | None = None,
    *,
    perturbed: bool = False,
    push: Push | None = None,
    change: Change | None = None,
) -> Environment:
    """One environment of a task or of its planning or imitation variant. `push` disturbs every
    episode and `change` changes the physics; both have no effect on planning."""
    scratch = np.random.default_rng(0)  # before the first reset it stands at some start
    if isinstance(mdp, Planning):
        physics = StillPhysics.from_model(MjModel(mdp.task.spec().compile()))
        task: Adapter = PlanningAdapter(mdp, scratch)
        substeps = 1
    else:
        model = mdp.plant.spec().compile()
        change = change or Change()
        change.apply(model)
        physics = ExactPhysics.from_model(MjModel(model))
        task = PhysicsAdapter(mdp, scratch, perturbed, push)
        substeps = mdp.plant.substeps * change.refine
    physics.task = task
    with physics.reset_context():
        task.initialize_episode(physics)
    task.rng = np.random.default_rng(seed)
    return Environment(physics, task, n_sub_steps=substeps)


def _numbers(batch: Batch) -> np.ndarray:
    """All numbers of a batch of one, shape (k,)."""
    return np.concatenate([np.ravel(values).astype(float) for values in vars(batch).values()])


def _filled(batch: B, numbers: np.ndarray) -> B:
    """The batch with the numbers (k,) that `_numbers` gives of another like it."""
    old = vars(batch)
    splits = np.cumsum([values.size for values in old.values()])[:-1]
    new = zip(old.items(), np.split(numbers, splits), strict=True)
    return batch.replace(**{name: a.reshape(v.shape).astype(v.dtype) for (name, v), a in new})
