"""Puck: go through a gap in a wall to a goal behind it, and stop there.

World frame: x through the wall, y along it, in metres. The start is the origin.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import mujoco
import numpy as np

from tsbench.core.arrays import Array, array_namespace, like
from tsbench.core.motion import Audit, AuditItem, Plan, ReferenceMotion
from tsbench.core.state import Course, Readings, Rng, Start, State
from tsbench.core.task import Abstraction, Plannable, Tracker
from tsbench.sim.kinematic import naive_plan
from tsbench.sim.model import load_spec
from tsbench.tasks import register


@dataclass(frozen=True)
class PuckState(State):
    position: Array  # of the puck's centre in metres, shape (..., 2)
    velocity: Array  # in m/s, shape (..., 2)


@dataclass(frozen=True)
class PuckGap(Plannable[PuckState]):
    goal: float = 2.0  # metres from the start, straight ahead
    wall: float = 1.0  # metres from the start to the middle of the wall
    thickness: float = 0.1  # of the wall in metres, as in models/puck.xml
    side: float = 0.5  # metres from the straight line to the middle of the gap
    gap: float = 0.5  # width in metres
    radius: float = 0.1  # of the puck in metres, as in models/puck.xml
    decay: float = 4.0  # of the reward, per metre
    spread: float = 0.1  # of perturbed starts in metres, of their velocities in m/s
    step: float = 0.1  # metres per axis that a plan moves in a step, at most
    near: float = 0.1  # of success: metres from the goal at the end, and m/s
    horizon: int = 100  # control steps
    name = "puck_gap"
    version = 1
    timestep = 0.05
    substeps = 5
    observation_size = 4
    action_size = 2
    max_reward = 1.0
    pushed = "puck"
    push_plane = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    push_steps = (5, 15, 25, 35)
    imitation_forms = ("timed",)

    def constants(self) -> dict[str, Any]:
        return asdict(self)

    def observation(self, state: PuckState) -> Array:
        return array_namespace(state.position).concat([state.position, state.velocity], axis=-1)

    def reward(self, previous: PuckState, action: Array, state: PuckState) -> Array:
        return array_namespace(state.position).exp(-self.decay * self.goal_distance(state))

    def goal_distance(self, state: PuckState) -> Array:
        return length(state.position - like(state.position, (self.goal, 0.0)))

    def success(self, state: PuckState, course: Course) -> Array:
        there = (self.goal_distance(state) < self.near) & (length(state.velocity) < self.near)
        return there & ~course.violated

    def violated(self, state: PuckState) -> Array:
        """Whether the puck touches the wall."""
        xp, x, y = array_namespace(state.position), state.position[..., 0], state.position[..., 1]
        outside = xp.clip(xp.abs(x - self.wall) - self.thickness / 2, 0.0, None)
        inside = xp.clip(self.gap / 2 - xp.abs(y - self.side), 0.0, None)
        return outside**2 + inside**2 < self.radius**2

    def terminal(self, state: PuckState) -> Array:
        return self.violated(state) | (self.goal_distance(state) > 2.0 * self.goal)

    def spec(self) -> mujoco.MjSpec:
        spec = load_spec("puck", __name__)
        spec.site("goal").pos = [self.goal, 0.0, 0.0]
        spec.geom("left").pos = [self.wall, self.side + self.gap / 2 + 1.0, 0.1]
        spec.geom("right").pos = [self.wall, self.side - self.gap / 2 - 1.0, 0.1]
        return spec

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        qpos, qvel = perturbed * self.spread * rng.uniform(-1.0, 1.0, (2, count, 2))
        return Start(np.zeros(count), qpos, qvel, np.zeros((count, 0)))

    def read(self, readings: Readings) -> PuckState:
        return PuckState(readings.time, readings.qpos, readings.qvel)

    def ideal(self) -> PuckState:
        return states(self.reference(naive_plan(self)))

    def abstraction(self) -> Moves:
        return Moves(self)

    def reference(self, plan: Plan) -> ReferenceMotion:
        times = np.arange(round(plan.times[-1] / self.timestep) + 1) * self.timestep
        qpos = np.stack([np.interp(times, plan.times, values) for values in plan.states.T], axis=-1)
        qvel = np.gradient(qpos, self.timestep, axis=0)
        return ReferenceMotion(self.name, self.version, self.timestep, qpos, qvel)

    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        end = self.goal_distance(states(reference))[-1]
        touching = self.violated(states(reference)).sum()
        at_goal = AuditItem("distance of the end from the goal", float(end), self.near, "m")
        return Audit((at_goal, AuditItem("frames at the wall", float(touching), 0.0, "")))

    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> Follow:
        self.imitation_form(form)
        return Follow(self, reference)


class Moves(Abstraction[PuckState]):
    """The planning variant: an action moves the puck by at most `step` per axis."""

    timestep = 0.1
    action_size = observation_size = 2
    coordinates = ("x", "y")

    def __init__(self, task: PuckGap) -> None:
        self.task = task
        self.horizon = int(task.horizon * task.timestep / self.timestep + 1e-9)

    def start(self, count: int) -> PuckState:
        return PuckState(np.zeros(count), *np.zeros((2, count, 2)))

    def sample(self, rng: Rng, count: int) -> PuckState:
        position = rng.uniform((0.0, -1.0), (self.task.goal, 1.0), (count, 2))
        return self.start(count).replace(position=position)

    def advance(self, state: PuckState, action: Array) -> PuckState:
        move = self.task.step * array_namespace(action).clip(action, -1.0, 1.0)
        return state.replace(time=state.time + self.timestep, position=state.position + move)

    def observation(self, state: PuckState) -> Array:
        return state.position

    def flatten(self, state: PuckState) -> Array:
        return state.position

    def naive(self, state: PuckState) -> Array:
        """To the middle of the gap, then to the goal."""
        xp, task = array_namespace(state.position), self.task
        gap, goal = (like(state.position, at) for at in ((task.wall, task.side), (task.goal, 0.0)))
        target = xp.where(state.position[..., :1] < task.wall - 1e-6, gap, goal)
        move = (target - state.position) / task.step
        return move / xp.clip(xp.max(xp.abs(move), axis=-1)[..., None], 1.0, None)

    def poses(self, coordinates: np.ndarray) -> np.ndarray:
        return coordinates


class Follow(Tracker[PuckState]):
    """Rewards for being where the reference motion is at the time."""

    max_reward = 1.0

    def __init__(self, task: PuckGap, reference: ReferenceMotion) -> None:
        self.task, self.reference, self.horizon = task, reference, reference.steps

    def reward(self, previous: PuckState, action: Array, state: PuckState) -> Array:
        there = like(state.position, self.reference.qpos)[self.reference.frame(state.time)]
        return array_namespace(there).exp(-self.task.decay * length(state.position - there))

    def terminal(self, state: PuckState) -> Array:
        return self.task.terminal(state)

    def start(self, rng: Rng, count: int) -> Start:
        """Anywhere along the reference motion, as far beside it as perturbed starts are."""
        motion, frame = self.reference, rng.integers(0, self.horizon, count)
        beside = self.task.start(rng, count, perturbed=True)
        qpos, qvel = motion.qpos[frame] + beside.qpos, motion.qvel[frame] + beside.qvel
        return Start(motion.times[frame], qpos, qvel, beside.memory)


def states(motion: ReferenceMotion) -> PuckState:
    return PuckState(motion.times, motion.qpos, motion.qvel)


def length(vectors: Array) -> Array:
    return array_namespace(vectors).linalg.vector_norm(vectors, axis=-1)


register("puck_gap")(PuckGap)
