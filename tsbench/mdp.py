"""What a task must say: states, observations, rewards, endings and starts.

Everything here is pure functions over arrays whose leading axes are batch axes, written on the
array API standard, so that one environment, thousands stepped together and (later) a GPU backend
run the same code. Nothing remembers anything between calls: memory across time steps is an
explicit field of the state.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Self, TypeVar, cast

import array_api_compat
import mujoco
import numpy as np

from tsbench.errors import TsbenchError, unknown
from tsbench.motion import Audit, Plan, ReferenceMotion

Array = Any  # an array of any library that follows the array API standard
Rng = np.random.Generator
Vector = tuple[float, float, float]


def array_namespace(array: Array) -> Any:
    """The functions of the array API standard, of the library that made `array`.

    numpy keeps the standard itself. array_api_compat takes 12 us to say so, and its clip, for
    instance, 49 us instead of 6: with some dozens of rockets that was a third of a step.
    """
    if type(array) is np.ndarray:
        return np
    return array_api_compat.array_namespace(array)


@dataclass(frozen=True)
class State:
    """What a task knows at one time step; every field has the same leading batch axes.

    Attributes:
        time: seconds since the start of the episode, shape (...,).
    """

    time: Array

    def replace(self, **changes: Array) -> Self:
        return dataclasses.replace(self, **changes)

    def updated(self, rows: np.ndarray, other: Self) -> Self:
        """This state with the states of `other` in place of `rows` (first batch axis)."""

        def merge(field: dataclasses.Field[Any]) -> Array:
            values = getattr(self, field.name).copy()
            values[rows] = getattr(other, field.name)
            return values

        return self.replace(**{f.name: merge(f) for f in dataclasses.fields(self)})

    def rows(self, rows: np.ndarray | slice) -> Self:
        """The states of some members of the batch (first batch axis)."""
        return self.replace(
            **{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)}
        )


S = TypeVar("S", bound=State)


@dataclass(frozen=True)
class Start:
    """Where episodes begin.

    Attributes:
        time: seconds, shape (n,). Zero but in training that starts along a reference motion.
        qpos: generalised positions, shape (n, nq).
        qvel: generalised velocities, shape (n, nv).
        memory: what `Task.control` remembers, shape (n, m).
    """

    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    memory: np.ndarray

    def rows(self, rows: np.ndarray | slice) -> Start:
        """Some of the starts."""
        return Start(self.time[rows], self.qpos[rows], self.qvel[rows], self.memory[rows])

    @classmethod
    def joined(cls, starts: Sequence[Start]) -> Start:
        """All of them, one after the other."""
        fields = [field.name for field in dataclasses.fields(cls)]
        return cls(*(np.concatenate([getattr(start, f) for start in starts]) for f in fields))


@dataclass(frozen=True)
class Readings:
    """What the physics tells the task after a control step.

    Attributes:
        time: seconds since the start of the episode, shape (...,).
        qpos: generalised positions, shape (..., nq).
        qvel: generalised velocities, shape (..., nv).
        sensors: the MJCF's sensors by name, each (..., dim), current at qpos and qvel. Only
            position and velocity sensors are: those of the acceleration stage lag a substep.
        memory: what `Task.control` remembers, shape (..., m).
    """

    time: Array
    qpos: Array
    qvel: Array
    sensors: Mapping[str, Array]
    memory: Array


class MDP(ABC, Generic[S]):
    """States to observations, rewards and endings. Shared by a task and its variants."""

    name: str
    version: int
    horizon: int  # time steps in an episode
    timestep: float  # seconds between actions
    observation_size: int
    action_size: int  # every action lies in the box [-1, 1]
    max_reward: float  # per time step: the bound that normalises returns

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
        """Whether the ending is the goal; the missing steps then count as perfect ones."""
        return state.time < 0.0

    def violated(self, state: S) -> Array:
        """Whether something happened that spoils the episode for good (a fall, a collision)."""
        return state.time < 0.0

    def spared(self, state: S) -> np.ndarray:
        """Steps that an episode which ends in this state does not need, since it is at its goal:
        they count as perfect, else hovering just outside would beat arriving; shape (...,)."""
        arrived = np.asarray(self.reached(state) & ~self.violated(state))
        steps = np.rint(np.asarray(state.time) / self.timestep).astype(int)
        return np.where(arrived, self.horizon - steps, 0)


@dataclass(frozen=True)
class Abstraction(Generic[S]):
    """A task's kinematic view, in which one samples states instead of actions.

    Attributes:
        timestep: seconds between plan states.
        horizon: plan steps in an episode.
        action_size: dimensions of an action; each lies in [-1, 1].
        coordinates: names of the abstract coordinates that a plan stores.
        start: number of states -> states at the task's start.
        sample: (rng, number of states) -> states from anywhere that a plan could pass.
        advance: (state, action) -> next state, s' = s + a.
        observation: state -> what the planner sees, shape (..., n).
        observation_size: n.
        flatten: state -> abstract coordinates, shape (..., len(coordinates)).
        naive: state -> the action of a planner made by hand, which learned plans should beat.
        dynamics_reward: state -> factor in (0, 1] that stands for the physics the kinematics
            leave out (R_dyn of the paper), or None where the paper has none.
        value_observation: state -> what the planner's critic sees, None for the same.
        poses: abstract states (k, len(coordinates)) -> qpos (k, nq).
    """

    timestep: float
    horizon: int
    action_size: int
    coordinates: tuple[str, ...]
    start: Callable[[int], S]
    sample: Callable[[Rng, int], S]
    advance: Callable[[S, Array], S]
    observation: Callable[[S], Array]
    observation_size: int
    flatten: Callable[[S], Array]
    naive: Callable[[S], Array]
    poses: Callable[[np.ndarray], np.ndarray]
    dynamics_reward: Callable[[S], Array] | None = None
    value_observation: Callable[[S], Array] | None = None


@dataclass(frozen=True)
class Tracker(Generic[S]):
    """What the imitation variant replaces in a task, given a reference motion.

    Attributes:
        reward: (previous, action, state) -> tracking reward, shape (...,), at most `max_reward`.
        max_reward: the bound per time step.
        terminal: state -> whether to end the episode early, shape (...,).
        start: (rng, n) -> n starts along the reference motion (reference-state initialisation).
        horizon: time steps until the reference motion ends.
    """

    reward: Callable[[S, Array, S], Array]
    max_reward: float
    terminal: Callable[[S], Array]
    start: Callable[[Rng, int], Start]
    horizon: int


@dataclass(frozen=True)
class Flame:
    """What an engine looks like while it works.

    Attributes:
        body: that carries it.
        actuator: whose control makes it.
        nozzle: where it begins, in the body's frame in metres.
        direction: where it points to, in the body's frame, of length 1.
        length: metres per unit of control; negative where negative controls make it.
    """

    body: str
    actuator: str
    nozzle: tuple[float, float, float]
    direction: tuple[float, float, float]
    length: float


@dataclass(frozen=True)
class Drawing:
    """What pictures of a task show beyond its model.

    Attributes:
        feet: the geoms that are to touch the ground, each named as its foot.
        contacts: seconds (...,) -> whether each foot is to be on the ground, (..., feet), or None
            where nothing says so.
        flames: of engines.
        bounds: lowest and highest corner of the world in metres, where it has an edge. A flat
            world has both at the same coordinate across it.
        worth: positions (n, 3) -> the reward of a robot's being there (n,); drawn over a flat
            world's bounds.
    """

    feet: tuple[str, ...] = ()
    contacts: Callable[[np.ndarray], np.ndarray] | None = None
    flames: tuple[Flame, ...] = ()
    bounds: tuple[np.ndarray, np.ndarray] | None = None
    worth: Callable[[np.ndarray], np.ndarray] | None = None


class Task(MDP[S]):
    """An MDP in full physics, with a sparse reward."""

    substeps: int  # physics steps in one control step
    pushed: str  # the body that pushes act on, at its centre of mass
    push_plane: tuple[
        Vector, Vector
    ]  # world axes: a push has a heading from the first to the second
    imitation_forms: tuple[str, ...]  # tracking rewards on offer, the default first

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """The physics, with goal and obstacles in it."""

    @abstractmethod
    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """The task's start, or `count` starts from its perturbed distribution."""

    @abstractmethod
    def control(self, state: S, action: Array) -> tuple[Array, Array]:
        """Actuator controls (..., nu) for an action, and what to remember (..., m)."""

    @abstractmethod
    def read(self, readings: Readings) -> S:
        """The task's state from what the physics tells."""

    def memory(self, state: S) -> Array:
        """What `control` remembered on the way to a state, shape (..., m); by default nothing."""
        return state.time[..., None][..., :0]

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
    def abstraction(self) -> Abstraction[S]:
        """The planning variant's kinematics."""

    @abstractmethod
    def reference(self, plan: Plan) -> ReferenceMotion:
        """The plan as full poses at the control rate."""

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
        if isinstance(motion, Plan):
            sizes = {"states": len(self.abstraction().coordinates)}
        else:
            model = self.spec().compile()
            sizes = {"qpos": model.nq, "qvel": model.nv}
        for name, size in sizes.items():
            found = getattr(motion, name).shape[1]
            if found != size:
                raise TsbenchError(f"the {motion.kind} has {found} {name} a step, not {size}")

    @abstractmethod
    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        """Whether the physics could follow the plan."""

    @abstractmethod
    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> Tracker[S]:
        """The imitation variant's reward; `form` picks one of several where there are."""

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

    def drawing(self) -> Drawing:
        """What pictures show beyond the model."""
        return Drawing()

    def constants(self) -> dict[str, Any]:
        """The values that define the task; a score made with others cannot be ranked."""
        fields = dataclasses.fields(cast(Any, self))  # every task is a dataclass
        return {field.name: getattr(self, field.name) for field in fields}
