"""What a task must say.

Four interfaces, each of which adds to the one before:

- `MDP`: observations, rewards and endings of states, whatever steps them.
- `SimulatedTask`: an MDP that is stepped in full physics, by the `Plant` that it names.
- `Task`: that can be scored: what success is, when to push, which motion is the best known.
- `Plannable`: with a planning variant (`Abstraction`) and an imitation variant (`Tracker`).

A new task is one class that implements `Task` or `Plannable`. Everything here is pure functions
over arrays whose leading axes are batch axes, written on the array API standard, so that one
environment, thousands stepped together and a GPU run the same code. Nothing remembers anything
between calls: memory across time steps is an explicit field of the state.
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
from tsbench.core.motion import Audit, Plan, ReferenceMotion
from tsbench.core.state import Readings, Rng, S, Start

Vector = tuple[float, float, float]


class MDP(ABC, Generic[S]):
    """States to observations, rewards and endings. Shared by a task and its variants.

    Attributes:
        name: of the task.
        version: of the task; whatever can change a score raises it.
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
        """Shape (..., observation_size)."""

    def value_observation(self, state: S) -> Array:
        """What a critic sees, which only helps to learn and is free to know more, (..., any)."""
        return self.observation(state)

    @abstractmethod
    def reward(self, previous: S, action: Array, state: S) -> Array:
        """Reward of the step from `previous` to `state`, shape (...,)."""

    @abstractmethod
    def terminal(self, state: S) -> Array:
        """Whether the episode ends here for a reason other than its last step, shape (...,)."""

    def reward_terms(self, previous: S, action: Array, state: S) -> dict[str, Array]:
        """What the reward is made of, by name, each of shape (...,), for people to look at. How
        the terms combine is each task's own; by default there is only the reward itself."""
        return {"reward": self.reward(previous, action, state)}

    def reached(self, state: S) -> Array:
        """Whether an episode that ends in this state ends at its goal, shape (...,)."""
        return state.time < 0.0

    def violated(self, state: S) -> Array:
        """Whether something happened that spoils the episode for good (a fall, a collision),
        shape (...,)."""
        return state.time < 0.0

    # Arriving: the one rule that scores and learners share. An episode that ends at its goal,
    # with nothing violated on the way, is credited for the steps that it spares: else hovering
    # just outside the goal would earn more than arriving.

    def spared(self, state: S, violated: Array) -> Array:
        """Steps that an episode which ends in this state does not need, since it has arrived;
        integers, zero unless it has, shape (...,).

        Args:
            state: that the episode ended in, for a reason other than its last step.
            violated: whether anything was violated on the way, shape (...,).
        """
        xp = array_namespace(state.time)
        arrived = self.reached(state) & ~violated
        return xp.where(arrived, self.horizon - step_of(state.time, self.timestep), 0)

    def credit(self, spared: Array, discount: float = 1.0) -> Array:
        """What spared steps earn: as much as perfect ones.

        Args:
            spared: steps, floating-point numbers, shape (...,).
            discount: gamma per time step; the first spared step is discounted once.
        """
        if discount == 1.0:
            return self.max_reward * spared
        return self.max_reward * (discount * (1.0 - discount**spared) / (1.0 - discount))


class Plant(ABC, Generic[S]):
    """What MuJoCo steps: a model, what actions do to its actuators, what its sensors mean.

    Attributes:
        timestep: seconds between actions.
        substeps: physics steps in one control step.
        action_size: dimensions of an action, which lies in the box [-1, 1].
        pushed: the body that pushes act on, at its centre of mass.
        push_plane: two axes of the world. A push has a heading from the first to the second.
    """

    timestep: float
    substeps: int
    action_size: int
    pushed: str
    push_plane: tuple[Vector, Vector]

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """The model, with goal and obstacles in it."""

    @abstractmethod
    def control(self, state: S, action: Array) -> tuple[Array, Array]:
        """Actuator controls (..., nu) for an action, and what to remember (..., m)."""

    @abstractmethod
    def read(self, readings: Readings) -> S:
        """The task's state from what the physics tells."""

    def memory(self, state: S) -> Array:
        """What `control` remembered on the way to a state, shape (..., m); by default nothing."""
        return state.time[..., None][..., :0]

    def drawing(self) -> Drawing:
        """What pictures show beyond the model."""
        return Drawing()


class SimulatedTask(MDP[S]):
    """An MDP in full physics: a task, or a variant of one with the same plant.

    Attributes:
        plant: what steps it.
    """

    @property
    @abstractmethod
    def plant(self) -> Plant[S]: ...

    @abstractmethod
    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """The task's start, or `count` starts from its perturbed distribution."""


class Task(SimulatedTask[S], Plant[S]):
    """A task that can be scored. It is its own plant."""

    @property
    def plant(self) -> Plant[S]:
        return self

    @abstractmethod
    def success(self, state: S) -> Array:
        """Whether an episode that ends in `state`, without violation, counts as solved."""

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
        step from the start, time as the batch axis (horizon + 1). Physics does not bind it."""

    @abstractmethod
    def constants(self) -> Mapping[str, Any]:
        """Every value that decides a score and does not stand in the MJCF, by name: numbers,
        strings, and lists or mappings of them. A score made with other values is not comparable,
        so that values which only matter to a learner stay out."""


class Abstraction(ABC, Generic[S]):
    """A task's kinematic view, in which one samples states instead of actions.

    Attributes:
        timestep: seconds between plan states.
        horizon: plan steps in an episode.
        action_size: dimensions of an action; each lies in [-1, 1].
        observation_size: dimensions of what the planner sees.
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
        """`count` states from anywhere that a plan could pass."""

    @abstractmethod
    def advance(self, state: S, action: Array) -> S:
        """The next states, s' = s + a."""

    @abstractmethod
    def observation(self, state: S) -> Array:
        """What the planner sees, shape (..., observation_size)."""

    def value_observation(self, state: S) -> Array:
        """What the planner's critic sees, which is free to know more, (..., any)."""
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
        """The action of a planner made by hand, which learned plans should beat."""

    @abstractmethod
    def poses(self, coordinates: np.ndarray) -> np.ndarray:
        """Full poses: abstract coordinates (k, len(coordinates)) -> qpos (k, nq)."""


class Tracker(ABC, Generic[S]):
    """What the imitation variant replaces in a task, given a reference motion.

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
        tracked: what a reference motion of the task holds beside poses and velocities, by name,
            each with its shape in one frame.
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
        """Whether the physics could follow the plan."""

    @abstractmethod
    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> Tracker[S]:
        """The imitation variant's reward; `form` picks one of `imitation_forms`."""

    def imitation_form(self, form: str | None) -> str:
        """The tracking reward of that name, None for the default.

        Raises:
            TsbenchError: there is none of that name.
        """
        if form is None:
            return self.imitation_forms[0]
        if form not in self.imitation_forms:
            raise unknown(f"imitation reward of {self.name}", form, self.imitation_forms)
        return form

    def check_fit(self, motion: Plan | ReferenceMotion) -> None:
        """
        Raises:
            TsbenchError: the motion is for another task or version of it, or has other sizes.
        """
        if (motion.task, motion.task_version) != (self.name, self.version):
            raise TsbenchError(
                f"the {motion.kind} is for {motion.task} version {motion.task_version}, "
                f"not for {self.name} version {self.version}"
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
    """The task, as one with a planning variant.

    Raises:
        TsbenchError: it has none.
    """
    if not isinstance(task, Plannable):
        raise TsbenchError(f"{task.name} has no planning variant, which this needs")
    return task
