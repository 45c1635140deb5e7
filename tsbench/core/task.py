"""The interfaces that tasks implement.

Four interfaces, each of which adds to the one before:

- `MDP`: observations, rewards and endings as functions of states, independent of the dynamics.
- `SimulatedTask`: an MDP that is stepped in full physics, by the `Plant` that it names.
- `Task`: a simulated task that can be scored. It defines success, further measures, the instants of
  pushes, and the best motion known.
- `Plannable`: with a planning variant (`Abstraction`) and an imitation variant (`Tracker`).

A new task is one class that implements `Task` or `Plannable`. Everything here is pure functions
over arrays whose leading axes are batch axes, written on the array API standard, so that one
environment, thousands stepped together and a GPU run the same code. No function keeps data between
calls: memory across time steps is an explicit field of the state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Generic

import mujoco
import numpy as np

from tsbench.core.arrays import Array, array_namespace, step_of
from tsbench.core.drawing import Drawing
from tsbench.core.errors import TsbenchError, unknown
from tsbench.core.motion import Audit, Plan, ReferenceMotion, Roadmap
from tsbench.core.roadmap import Lattice, RoadmapSpace
from tsbench.core.state import Course, Readings, Rng, S, Start

Vector = tuple[float, float, float]

# How much a plan or a reference motion may be longer than an episode: in time, and in frames.
LONGEST_MOTION = 4
MOST_FRAMES = 16


class MDP(ABC, Generic[S]):
    """Observations, rewards and endings of states. Shared by a task and its variants.

    Attributes:
        name: of the task.
        version: version of the task; any change that can affect a score raises it.
        horizon: time steps in an episode.
        timestep: seconds between actions.
        observation_size: dimensions of an observation.
        action_size: dimensions of an action, which lies in the box [-1, 1].
        max_reward: the largest reward of a time step, which normalises returns.
    """

    name: str
    version: int
    horizon: int
    timestep: float
    observation_size: int
    action_size: int
    max_reward: float

    @abstractmethod
    def observation(self, state: S) -> Array:
        """The observation, shape (..., observation_size)."""

    def value_observation(self, state: S) -> Array:
        """The critic's observation, shape (..., any). Only training uses the critic, so it may see
        more than the policy."""
        return self.observation(state)

    @abstractmethod
    def reward(self, previous: S, action: Array, state: S) -> Array:
        """Reward of the step from `previous` to `state`, shape (...,).

        The planning variant has this reward too, and gives it the planner's action: a change of the
        state, of another size than an action of the task. A plan or reference motion is valued with
        actions of zero. So a term that depends on the action, such as a cost of torques, means
        something else there.
        """

    @abstractmethod
    def terminal(self, state: S) -> Array:
        """Whether the episode ends here for a reason other than its last step, shape (...,)."""

    def reward_terms(self, previous: S, action: Array, state: S) -> dict[str, Array]:
        """The terms of the reward by name, each of shape (...,), for display. Each task combines
        its terms in its own way; by default the only term is the reward."""
        return {"reward": self.reward(previous, action, state)}

    def reached(self, state: S) -> Array:
        """Whether an episode that ends in this state ends at its goal, shape (...,)."""
        return state.time < 0.0

    def violated(self, state: S) -> Array:
        """Whether this state spoils the episode for good (a fall, a collision), shape (...,)."""
        return state.time < 0.0

    def begun(self, state: S) -> Course:
        """The course of episodes that begin in these states."""
        return Course(violated=self.violated(state) & False)

    def followed(self, course: Course, previous: S, state: S) -> Course:
        """The course after the step from `previous` to `state`."""
        return course.replace(violated=course.violated | self.violated(state))

    # Arriving: one rule for scores and learners. An episode that ends at its goal without a
    # violation is credited for the steps that it spares. Without this credit, hovering just outside
    # the goal would earn more than arriving.

    def spared(self, state: S, course: Course) -> Array:
        """The number of steps that an arrival leaves of the horizon, zero for an episode that has
        not arrived; integers, shape (...,).

        Args:
            state: the state in which the episode ended, for a reason other than its last step.
            course: the course of the episode.
        """
        xp = array_namespace(state.time)
        arrived = self.reached(state) & ~course.violated
        return xp.where(arrived, self.horizon - step_of(state.time, self.timestep), 0)

    def quality(self, course: Course) -> Array:
        """The worth of a spared step as a share of a perfect step, in [0, 1], shape (...,). It says
        how well the episode met the task's demands on the way, such as the footfall; by default
        1."""
        return 1.0 - 0.0 * course.violated

    def credit(self, spared: Array, quality: Array, discount: float = 1.0) -> Array:
        """The reward of spared steps, shape (...,).

        Args:
            spared: numbers of steps as floating-point numbers, shape (...,).
            quality: worth of each step as a share of a perfect step, shape (...,).
            discount: gamma per time step; the first spared step is discounted once.
        """
        if discount != 1.0:
            spared = discount * (1.0 - discount**spared) / (1.0 - discount)
        return self.max_reward * quality * spared


class Plant(ABC, Generic[S]):
    """The system that MuJoCo steps: a model, the effect of actions on its actuators, and the state
    that its sensors measure.

    Attributes:
        timestep: seconds between actions.
        substeps: physics steps in one control step.
        action_size: dimensions of an action, which lies in the box [-1, 1].
        pushed: the body that pushes act on, at its centre of mass.
        push_plane: two axes of the world. The heading of a push is the angle from the first axis
            towards the second.
    """

    timestep: float
    substeps: int
    action_size: int
    pushed: str
    push_plane: tuple[Vector, Vector]

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """The model, with goal and obstacles in it. The viewer frames and labels what is named
        `goal` (a site) and `obstacle_1`, `obstacle_2`, ... (spheres)."""

    def control(self, state: S, action: Array) -> tuple[Array, Array]:
        """Actuator controls (..., nu) for an action, and the memory (..., m) for the next state. By
        default the controls are the clipped action, and the memory stays as it is."""
        return array_namespace(action).clip(action, -1.0, 1.0), self.memory(state)

    @abstractmethod
    def read(self, readings: Readings) -> S:
        """The task's state from the readings of the physics."""

    def memory(self, state: S) -> Array:
        """The memory that `control` returned for a state, shape (..., m); by default none."""
        return state.time[..., None][..., :0]

    def drawing(self) -> Drawing:
        """Things to draw in addition to the model."""
        return Drawing()


class SimulatedTask(MDP[S]):
    """An MDP in full physics: a task, or a variant of one with the same plant.

    Attributes:
        plant: the system that MuJoCo steps.
    """

    @property
    @abstractmethod
    def plant(self) -> Plant[S]: ...

    @abstractmethod
    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """The task's start, or `count` starts from its perturbed distribution."""


class Task(SimulatedTask[S], Plant[S]):
    """A task that can be scored. It is its own plant.

    Attributes:
        measure_notes: the meaning of each of `measures` in words, by name.
    """

    measure_notes: Mapping[str, str] = MappingProxyType({})

    @property
    def plant(self) -> Plant[S]:
        return self

    @property
    def mishap(self) -> str:
        """A violation in words that follow "without", such as "a fall"."""
        return "a violation"

    @abstractmethod
    def success(self, state: S, course: Course) -> Array:
        """Whether an episode that ended in `state` after this course is solved, shape (...,)."""

    # Measures: figures of an episode with a meaning and unit of their own.

    def measured(self, previous: S, action: Array | None, state: S) -> dict[str, Array]:
        """The terms that a step adds to the episode's sums for `measures`, by name, each of shape
        (...,); by default none. `action` is None for a plan; terms that need an action are then
        left out."""
        return {}

    def measures(
        self, first: S, last: S, course: Course, sums: Mapping[str, Array], steps: Array
    ) -> dict[str, Array]:
        """Figures of finished episodes beside their reward, by name, the main ones first. A name
        includes the unit. A figure is not a number for an episode without it. By default there are
        none.

        Args:
            first: the state in which the episode began.
            last: the state in which the episode ended.
            course: the course of the episode.
            sums: the sums of the terms that its steps `measured`.
            steps: the number of its steps, shape (...,).

        Returns:
            Each of shape (...,).
        """
        return {}

    @abstractmethod
    def goal_distance(self, state: S) -> Array:
        """Metres between robot and goal, shape (...,)."""

    @property
    @abstractmethod
    def push_steps(self) -> tuple[int, ...]:
        """The control steps at which the protocol's pushes begin: the phases of the motion."""

    @abstractmethod
    def ideal(self) -> S:
        """The states of the best motion known under the task's speed limits, one per control
        step from the start, time as the batch axis (horizon + 1). Physics need not allow it."""

    @abstractmethod
    def constants(self) -> Mapping[str, Any]:
        """The values that decide a score and do not stand in the MJCF, by name: numbers, strings,
        and lists or mappings of them. Scores made with different values are not comparable, so
        values that matter only to a learner are left out. Their hash is what tells one task's
        scores from another's: a value that decides a score and is left out, such as Laikago's
        least number of cycles, must stay as it is within a `version`."""


class Abstraction(ABC, Generic[S]):
    """The kinematics of a task's planning variant, in which an action is a change of the state.

    Attributes:
        timestep: seconds between plan states.
        horizon: plan steps in an episode.
        action_size: dimensions of an action; each lies in [-1, 1].
        observation_size: dimensions of the planner's observation.
        coordinates: names of the abstract coordinates that a plan stores.
    """

    timestep: float
    horizon: int
    action_size: int
    observation_size: int
    coordinates: tuple[str, ...]

    @abstractmethod
    def start(self, count: int) -> S:
        """`count` states at the task's start."""

    @abstractmethod
    def sample(self, rng: Rng, count: int) -> S:
        """`count` random states from the region that plans can pass through."""

    @abstractmethod
    def advance(self, state: S, action: Array) -> S:
        """The next states, s' = s + a."""

    @abstractmethod
    def observation(self, state: S) -> Array:
        """The planner's observation, shape (..., observation_size)."""

    def value_observation(self, state: S) -> Array:
        """The observation of the planner's critic, which may see more, shape (..., any)."""
        return self.observation(state)

    def dynamics_reward(self, state: S) -> Array:
        """Factor in (0, 1] that stands for the physics which the kinematics leave out (R_dyn of
        the paper), shape (...,); by default there is none."""
        return 1.0 + 0.0 * state.time

    @abstractmethod
    def flatten(self, state: S) -> Array:
        """Abstract coordinates, shape (..., len(coordinates))."""

    @abstractmethod
    def naive(self, state: S) -> Array:
        """The action of a hand-made planner, a baseline for learned plans, (..., action_size)."""

    @abstractmethod
    def poses(self, coordinates: np.ndarray) -> np.ndarray:
        """Full poses: abstract coordinates (k, len(coordinates)) -> qpos (k, nq)."""

    # For planners that do not learn

    def roadmap_space(self) -> RoadmapSpace[S] | None:
        """The points that a roadmap joins; by default there are none."""
        return None

    def lattice(self) -> Lattice | None:
        """The nodes of a cyclic motion that keeps the task's schedule; by default there are
        none."""
        return None


class Tracker(ABC, Generic[S]):
    """The reward, ending and start of a task's imitation variant, given a reference motion.

    Attributes:
        max_reward: the largest reward of a time step.
        horizon: time steps in an episode.
    """

    max_reward: float
    horizon: int

    @abstractmethod
    def reward(self, previous: S, action: Array, state: S) -> Array:
        """Tracking reward, shape (...,), at most `max_reward`."""

    @abstractmethod
    def terminal(self, state: S) -> Array:
        """Whether to end the episode early, shape (...,)."""

    @abstractmethod
    def start(self, rng: Rng, count: int) -> Start:
        """Starts along the reference motion (reference-state initialisation)."""


class Plannable(Task[S]):
    """A task with a planning and an imitation variant.

    Attributes:
        imitation_forms: tracking rewards on offer, the default first.
        tracked: arrays that a reference motion of the task has besides poses and velocities, by
            name, each with its shape in one frame.
    """

    imitation_forms: tuple[str, ...]
    tracked: Mapping[str, tuple[int, ...]] = MappingProxyType({})

    @abstractmethod
    def abstraction(self) -> Abstraction[S]:
        """The planning variant's kinematics."""

    @abstractmethod
    def reference(self, plan: Plan) -> ReferenceMotion:
        """The plan as full poses at the control rate."""

    @abstractmethod
    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        """Measures whether physics can follow the plan."""

    @abstractmethod
    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> Tracker[S]:
        """The imitation variant's reward; `form` picks one of `imitation_forms`."""

    def imitation_form(self, form: str | None) -> str:
        """The name of a tracking reward; None stands for the default.

        Raises:
            TsbenchError: the task has no tracking reward of that name.
        """
        if form is None:
            return self.imitation_forms[0]
        if form not in self.imitation_forms:
            raise unknown(f"imitation reward of {self.name}", form, self.imitation_forms)
        return form

    def check_origin(self, made: Plan | ReferenceMotion | Roadmap) -> None:
        """Checks that something was made for this task.

        Raises:
            TsbenchError: it was made for another task or version.
        """
        if (made.task, made.task_version) != (self.name, self.version):
            raise TsbenchError(
                f"the {made.kind} is for {made.task} version {made.task_version}, "
                f"not for {self.name} version {self.version}"
            )

    def check_fit(self, motion: Plan | ReferenceMotion) -> None:
        """Checks that a plan or reference motion belongs to this task.

        Raises:
            TsbenchError: the motion is for another task or version, is far longer than an episode,
                its time step is far shorter than a control step or, of a reference motion, another,
                or its arrays have other sizes.
        """
        self.check_origin(motion)
        frames = len(next(iter(motion.arrays.values())))
        longest = LONGEST_MOTION * self.horizon
        if frames > MOST_FRAMES * self.horizon or frames * motion.timestep > (
            longest * self.timestep
        ):
            raise TsbenchError(
                f"the {motion.kind} is too long: {frames} frames every {motion.timestep:g} s, "
                f"where an episode has {self.horizon} steps of {self.timestep:g} s"
            )
        if motion.timestep * MOST_FRAMES < self.timestep or (
            isinstance(motion, ReferenceMotion) and not np.isclose(motion.timestep, self.timestep)
        ):
            raise TsbenchError(
                f"the {motion.kind} has a time step of {motion.timestep:g} s, which does not fit "
                f"the control steps of {self.timestep:g} s"
            )
        found: dict[str, tuple[int, ...]]
        wanted: dict[str, tuple[int, ...]]
        if isinstance(motion, Plan):
            found = {"states": motion.states.shape[1:]}
            wanted = {"states": (len(self.abstraction().coordinates),)}
        else:
            model = self.spec().compile()
            found = {name: values.shape[1:] for name, values in motion.arrays.items()}
            wanted = {"qpos": (model.nq,), "qvel": (model.nv,), **self.tracked}
        for name, shape in wanted.items():
            if name not in found:
                raise TsbenchError(f"the {motion.kind} lacks {name}")
            if found[name] != shape:
                here, there = (" x ".join(map(str, one)) for one in (found[name], shape))
                raise TsbenchError(f"the {motion.kind} has {here} {name} a step, not {there}")


def plannable(task: MDP[S]) -> Plannable[S]:
    """The same task, typed as one with a planning variant.

    Raises:
        TsbenchError: the task has no planning variant.
    """
    if not isinstance(task, Plannable):
        raise TsbenchError(f"{task.name} has no planning variant, which this needs")
    return task


def roadmap_space(task: MDP[S], method: str) -> RoadmapSpace[S]:
    """The points that a roadmap of the task joins.

    Raises:
        TsbenchError: the task has none, so that the method cannot do it, or no planning variant.
    """
    space = plannable(task).abstraction().roadmap_space()
    if space is None:
        raise TsbenchError(f"the method {method} cannot do {task.name}: it has no roadmap space")
    return space
