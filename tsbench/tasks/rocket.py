"""Rocket: fly a planar lander with three engines to a goal far away, past obstacles.

World frame: x to the right, z up, in metres; angles counter-clockwise from upright, in radians.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from tsbench.core.arrays import Array, array_namespace, like, norm
from tsbench.core.constants import constant
from tsbench.core.drawing import Drawing, Flame
from tsbench.core.motion import Audit, AuditItem, Plan, ReferenceMotion
from tsbench.core.roadmap import DrivableSpace
from tsbench.core.state import Course, Readings, Rng, Start, State
from tsbench.core.task import Abstraction, Plannable, Tracker
from tsbench.planning.path import Path, segment_distance
from tsbench.sim.model import load_spec
from tsbench.tasks import register


@dataclass(frozen=True)
class Constants:
    """The constants that decide a score, besides the goal, the obstacles and the MJCF."""

    control_timestep: float = constant(1 / 50, "s", "P", "of control and simulation")
    main_thrust: float = constant(50.0, "N", "P", "of the main engine, per unit of action")
    side_thrust: float = constant(10.0, "N", "P", "of a side engine, per unit of action")
    dead_zone: float = constant(0.5, "", "P", "of each engine's action")
    goal_weight: float = constant(0.9, "", "P", "w1")
    goal_decay: float = constant(-0.25, "1/m", "P", "k1")
    obstacle_weight: float = constant(0.075, "", "P", "w2 = w3")
    obstacle_decay: float = constant(-0.5, "1/m", "P", "k2 = k3")
    obstacle_radius: float = constant(0.5, "m", "D", "of an obstacle")
    hull_radius: float = constant(
        0.72, "m", "D", "to the lander's farthest corner: what a plan keeps clear at any angle"
    )
    direction: float = constant(math.radians(30.0), "rad", "C", "of the goal above the horizon")
    margin: float = constant(10.0, "m", "C", "between the start or goal and the world's bounds")
    horizon_ratio: float = constant(
        1.5, "", "C", "horizon over the planner's flight time: arrive, then hover"
    )
    success_distance: float = constant(1.0, "m", "D", "from the goal at most, at the end")
    success_speed: float = constant(1.0, "m/s", "D", "at most, at the end")
    start_spread: tuple[float, float, float] = constant(
        (0.5, 0.5, 0.2), "m, m, rad", "D", "of perturbed starts; of their velocities per second"
    )
    pushes: int = constant(16, "", "D", "instants of the flight at which pushes are tried")
    plan_timestep: float = constant(1 / 20, "s", "P", "between plan states")
    plan_step: float = constant(0.25, "m", "P", "at most, per axis and plan step")


C = Constants()
CLEARANCE = C.obstacle_radius + C.hull_radius  # m, of an upright or tilted rocket from a centre

# The paper prints degrees; spec section 1 says why this is in radians.
PLAN_TURN = 0.05  # rad per plan step (P, unit D)

ROADMAP_SLACK = 1e-6  # m, by which the ways of a roadmap clear obstacles more than they must

# Constants of the imitation reward, on which no score depends.
TRACKING_DECAY = -0.625  # k_imi (P)
TRACKING_PENALTY = 0.25  # of a collision (P)
TRACKING_ARRIVAL = 1.0  # m, decay length of the reward for arriving (C)
TRACKING_ADVANCE = 1.0  # per metre of progress along the reference (C)
# m per step (C). Progress above 10 m/s, twice the plan's speed, earns no more, because faster
# rockets tumble when they brake. The limit for going back, 25 m/s, is faster than any rocket.
TRACKING_LIMITS = (-0.5, 0.2)

FLAMES = (  # from the nozzles in models/rocket.xml; a positive side force leaves on the right
    Flame("rocket", "main", (0.0, 0.0, -0.58), (0.0, 0.0, -1.0), length=0.03),
    Flame("rocket", "side", (0.59, 0.0, 0.365), (1.0, 0.0, 0.0), length=0.05),
    Flame("rocket", "side", (-0.59, 0.0, 0.365), (-1.0, 0.0, 0.0), length=-0.05),
)


@dataclass(frozen=True)
class RocketState(State):
    """One rocket or many.

    Attributes:
        position: world frame in metres, shape (..., 2).
        angle: radians, counter-clockwise from upright, not wrapped, shape (...,).
        velocity: world frame in m/s, shape (..., 2).
        angular_velocity: rad/s, shape (...,).
        clearance: distance of the hull from each obstacle in metres, shape (..., obstacles).
            Zero or less is a collision.
    """

    position: Array
    angle: Array
    velocity: Array
    angular_velocity: Array
    clearance: Array


def wrap(angle: Array) -> Array:
    """The same angle within [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@dataclass(frozen=True)
class Rocket(Plannable[RocketState]):
    """The rocket task; without obstacles it is pure navigation.

    Attributes:
        distance: of the goal from the start in metres.
        obstacles: centres in the world frame in metres.
    """

    name: str
    distance: float
    obstacles: tuple[tuple[float, float], ...]
    horizon: int
    version = 1
    timestep = C.control_timestep
    substeps = 1
    observation_size = 10
    action_size = 2
    max_reward = C.goal_weight
    imitation_forms = ("progress", "paper")
    measure_notes = MappingProxyType(
        {
            "time away from the goal, s": "time more than 1 m from the goal",
            "impulse of the engines, N s": "use of fuel; hovering costs 12.5 a second",
        }
    )
    pushed = "rocket"
    push_plane = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))

    @property
    def mishap(self) -> str:
        away = "leaving the world"
        return f"a collision or {away}" if self.obstacles else away

    @cached_property
    def goal(self) -> np.ndarray:
        """Metres, shape (2,)."""
        return self.distance * np.array([math.cos(C.direction), math.sin(C.direction)])

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower left and upper right corner of the world in metres. The start is the origin."""
        return np.full(2, -C.margin), self.goal + C.margin

    def constants(self) -> dict[str, Any]:
        return {**asdict(self), "max_reward": self.max_reward, **asdict(C)}

    # The MDP

    def observation(self, state: RocketState) -> Array:
        """Position (2), angle (1), velocity (2) and angular velocity (1); goal relative to the
        rocket (2), its distance (1), and the angle between it and the rocket's nose (1)."""
        xp = array_namespace(state.position)
        return xp.concat(
            [
                state.position,
                wrap(state.angle)[..., None],
                state.velocity,
                state.angular_velocity[..., None],
                self.towards_goal(state),
            ],
            axis=-1,
        )

    def towards_goal(self, state: RocketState) -> Array:
        """Goal relative to the rocket (2), distance, heading error; shape (..., 4)."""
        xp = array_namespace(state.position)
        offset = like(state.position, self.goal) - state.position
        distance = norm(offset)
        bearing = xp.atan2(offset[..., 1], offset[..., 0])
        heading_error = wrap(bearing - (state.angle + math.pi / 2))
        return xp.concat([offset, distance[..., None], heading_error[..., None]], axis=-1)

    def goal_distance(self, state: RocketState) -> Array:
        return norm(state.position - like(state.position, self.goal))

    def reward_terms(
        self, previous: RocketState, action: Array, state: RocketState
    ) -> dict[str, Array]:
        """w1 exp(k1 |x - goal|) and, of each obstacle, -w2 exp(k2 |x - obstacle|) (P)."""
        xp = array_namespace(state.position)
        terms = {"near the goal": C.goal_weight * xp.exp(C.goal_decay * self.goal_distance(state))}
        for number, obstacle in enumerate(self.obstacles, 1):
            offset = state.position - like(state.position, obstacle)
            distance = norm(offset)
            terms[f"near obstacle {number}"] = -C.obstacle_weight * xp.exp(
                C.obstacle_decay * distance
            )
        return terms

    def reward(self, previous: RocketState, action: Array, state: RocketState) -> Array:
        """R, the sum of its terms (P)."""
        return sum(self.reward_terms(previous, action, state).values())

    def strayed(self, state: RocketState) -> Array:
        """Out of bounds."""
        xp = array_namespace(state.position)
        low, high = (like(state.position, corner) for corner in self.bounds)
        return xp.any((state.position < low) | (state.position > high), axis=-1)

    def collided(self, state: RocketState) -> Array:
        """The hull touches an obstacle."""
        xp = array_namespace(state.clearance)
        return xp.any(state.clearance <= 0.0, axis=-1)

    def terminal(self, state: RocketState) -> Array:
        """Out of bounds (P)."""
        return self.strayed(state)

    def violated(self, state: RocketState) -> Array:
        """A collision, or out of bounds."""
        return self.collided(state) | self.strayed(state)

    def success(self, state: RocketState, course: Course) -> Array:
        """At the end of the episode within 1 m of the goal and slower than 1 m/s; no collision and
        never out of bounds on the way."""
        speed = norm(state.velocity)
        there = (self.goal_distance(state) < C.success_distance) & (speed < C.success_speed)
        return there & ~course.violated

    # Measures

    def measured(
        self, previous: RocketState, action: Array | None, state: RocketState
    ) -> dict[str, Array]:
        xp = array_namespace(state.position)
        away = xp.astype(self.goal_distance(state) >= C.success_distance, state.position.dtype)
        sums = {"away": self.timestep * away}
        if action is None:
            return sums
        force, _ = self.control(previous, action)
        return {**sums, "impulse": self.timestep * xp.sum(xp.abs(force), axis=-1)}

    def measures(
        self,
        first: RocketState,
        last: RocketState,
        course: Course,
        sums: Mapping[str, Array],
        steps: Array,
    ) -> dict[str, Array]:
        """Time away from the goal, and use of the engines.

        time away from the goal, s: time farther from the goal than a success may be. After an early
            end the rest of the horizon counts as away.
        impulse of the engines, N s: integral of the forces of the main and the side engines.
        """
        missing = self.timestep * (self.horizon - steps)
        found = {"time away from the goal, s": sums["away"] + missing}
        if "impulse" in sums:
            found["impulse of the engines, N s"] = sums["impulse"]
        return found

    # The physics

    def spec(self) -> mujoco.MjSpec:
        spec = load_spec("rocket")
        x, z = self.goal
        spec.worldbody.add_site(
            name="goal", pos=[x, 0.0, z], size=[C.success_distance] * 3, rgba=[0.95, 0.75, 0.1, 0.6]
        )
        for number, (x, z) in enumerate(self.obstacles, 1):
            name = f"obstacle_{number}"
            spec.worldbody.add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                pos=[x, 0.0, z],
                size=[C.obstacle_radius, 0.0, 0.0],
                rgba=[0.75, 0.25, 0.2, 1.0],
                contype=2,
                conaffinity=2,
            )
            spec.add_sensor(
                name=name,
                type=mujoco.mjtSensor.mjSENS_GEOMDIST,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname="hull",
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname=name,
                cutoff=1e3,
            )
        return spec

    def drawing(self) -> Drawing:
        low, high = (np.array([x, 0.0, z]) for x, z in self.bounds)

        def still(position: np.ndarray) -> RocketState:
            zeros = np.zeros(len(position))
            return self.kinematic(zeros, position[:, [0, 2]], zeros)

        def worth(position: np.ndarray) -> np.ndarray:
            state = still(position)
            reward: np.ndarray = self.reward(state, state.time, state)
            return reward

        return Drawing(flames=FLAMES, bounds=(low, high), worth=worth, still=still, robot="rocket")

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """At the origin, at rest, upright (P).

        Perturbed: position and angle, and their velocities, within `start_spread`, uniform.
        """
        qpos, qvel = np.zeros((count, 3)), np.zeros((count, 3))
        if perturbed:
            qpos = rng.uniform(-1.0, 1.0, (count, 3)) * C.start_spread
            qvel = rng.uniform(-1.0, 1.0, (count, 3)) * C.start_spread
        return Start(np.zeros(count), qpos, qvel, np.zeros((count, 0)))

    def control(self, state: RocketState, action: Array) -> tuple[Array, Array]:
        """Engine forces in newtons (main, side); dead below half throttle (P)."""
        xp = array_namespace(action)
        action = xp.clip(action, -1.0, 1.0)
        main, side = action[..., 0], action[..., 1]
        force = xp.stack(
            [
                xp.where(main >= C.dead_zone, C.main_thrust * main, 0.0),
                xp.where(xp.abs(side) >= C.dead_zone, C.side_thrust * side, 0.0),
            ],
            axis=-1,
        )
        return force, force[..., :0]

    def read(self, readings: Readings) -> RocketState:
        xp = array_namespace(readings.qpos)
        distances = [readings.sensors[f"obstacle_{i + 1}"] for i in range(len(self.obstacles))]
        return RocketState(
            time=readings.time,
            position=readings.qpos[..., :2],
            angle=readings.qpos[..., 2],
            velocity=readings.qvel[..., :2],
            angular_velocity=readings.qvel[..., 2],
            clearance=xp.concat([readings.qpos[..., :0], *distances], axis=-1),
        )

    @property
    def push_steps(self) -> tuple[int, ...]:
        """Steps spread evenly over the planner's flight time, so that pushes meet take-off,
        obstacles and arrival. A flight has no cycle whose phases could matter."""
        flight = self.horizon / C.horizon_ratio
        return tuple(int((index + 0.5) * flight / C.pushes) for index in range(C.pushes))

    def ideal(self) -> RocketState:
        """Along each axis at the planner's speed until the goal's coordinate is reached."""
        steps = np.arange(self.horizon + 1)
        travelled = C.plan_step / C.plan_timestep * self.timestep * steps
        position = np.minimum(travelled[:, None], self.goal)
        return self.kinematic(steps * self.timestep, position, 0.0 * travelled)

    def kinematic(self, time: Array, position: Array, angle: Array) -> RocketState:
        """A state at rest at positions (..., 2), its clearance that of a disc around the hull."""
        xp = array_namespace(position)
        clearance = [
            norm(position - like(position, obstacle))[..., None] - CLEARANCE
            for obstacle in self.obstacles
        ]
        return RocketState(
            time=time,
            position=position,
            angle=angle,
            velocity=0.0 * position,
            angular_velocity=0.0 * angle,
            clearance=xp.concat([position[..., :0], *clearance], axis=-1),
        )

    # The variants

    def abstraction(self) -> RocketAbstraction:
        return RocketAbstraction(self)

    def reference(self, plan: Plan) -> ReferenceMotion:
        """The plan, interpolated linearly to the control rate. A plan shorter than a control step
        rests at its end."""
        steps = max(1, int(plan.times[-1] / self.timestep + 1e-9))
        qpos = _along(plan, np.arange(steps + 1) * self.timestep)
        return ReferenceMotion(
            task=self.name,
            task_version=self.version,
            timestep=self.timestep,
            qpos=qpos,
            qvel=np.gradient(qpos, self.timestep, axis=0),
        )

    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        """The clearance is that of the plan's states; between two of them it may be 1.3 cm less."""
        path = plan.states[:, :2]
        final = float(np.linalg.norm(path[-1] - self.goal))
        speed = float(np.abs(np.diff(path, axis=0)).max() / plan.timestep)
        followed = _along(plan, reference.times)[:, :2]
        away = float(np.linalg.norm(reference.qpos[:, :2] - followed, axis=-1).max())
        items = [
            AuditItem("distance of the plan's end from the goal", final, C.success_distance, "m"),
            AuditItem("distance of the reference motion from the plan", away, 1e-6, "m"),
            AuditItem("speed per axis", speed, C.plan_step / C.plan_timestep + 1e-6, "m/s"),
        ]
        for number, obstacle in enumerate(self.obstacles, 1):
            nearest = float(np.linalg.norm(path - np.array(obstacle), axis=-1).min())
            shortfall = max(0.0, CLEARANCE - nearest)
            items.append(
                AuditItem(f"missing clearance from obstacle {number}", shortfall, 0.0, "m")
            )
        return Audit(tuple(items))

    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> RocketTracker:
        """`paper` is the printed reward, `progress` a dense one (`RocketTracker`)."""
        return RocketTracker(self, reference, self.imitation_form(form))


def _along(plan: Plan, times: np.ndarray) -> np.ndarray:
    """Position and angle of a plan at times (k,) in seconds, linear between its states, (k, 3)."""
    return np.stack([np.interp(times, plan.times, column) for column in plan.states.T], axis=-1)


class RocketAbstraction(Abstraction[RocketState]):
    """Position and angle. An action changes them by at most 0.25 m per axis and 0.05 rad (P)."""

    timestep = C.plan_timestep
    action_size = 3
    observation_size = 7
    coordinates = ("x", "z", "angle")

    def __init__(self, task: Rocket) -> None:
        self.task = task
        self.horizon = int(task.horizon * task.timestep / C.plan_timestep + 1e-9)

    def start(self, count: int) -> RocketState:
        zeros = np.zeros(count)
        return self.task.kinematic(zeros, np.zeros((count, 2)), zeros)

    def sample(self, rng: Rng, count: int) -> RocketState:
        steps = rng.integers(0, self.horizon, count)
        return self.task.kinematic(
            steps * C.plan_timestep,
            rng.uniform(*self.task.bounds, (count, 2)),
            rng.uniform(-0.5, 0.5, count),
        )

    def advance(self, state: RocketState, action: Array) -> RocketState:
        xp = array_namespace(action)
        action = xp.clip(action, -1.0, 1.0)
        return self.task.kinematic(
            state.time + C.plan_timestep,
            state.position + C.plan_step * action[..., :2],
            state.angle + PLAN_TURN * action[..., 2],
        )

    def observation(self, state: RocketState) -> Array:
        xp = array_namespace(state.position)
        return xp.concat(
            [state.position, wrap(state.angle)[..., None], self.task.towards_goal(state)], axis=-1
        )

    def flatten(self, state: RocketState) -> Array:
        xp = array_namespace(state.position)
        return xp.concat([state.position, state.angle[..., None]], axis=-1)

    def naive(self, state: RocketState) -> Array:
        """Straight at the goal, without avoiding obstacles."""
        xp = array_namespace(state.position)
        offset = (like(state.position, self.task.goal) - state.position) / C.plan_step
        longest = xp.max(xp.abs(offset), axis=-1)[..., None]
        move = offset / xp.clip(longest, 1.0, None)
        return xp.concat([move, 0.0 * longest], axis=-1)

    def poses(self, coordinates: np.ndarray) -> np.ndarray:
        return coordinates

    def roadmap_space(self) -> RocketSpace:
        return RocketSpace(self.task)


class RocketSpace(DrivableSpace[RocketState]):
    """Positions in metres. The rocket stays upright: neither clearance nor reward depends on its
    angle."""

    near = C.success_distance

    def __init__(self, task: Rocket) -> None:
        self.obstacles = np.array(task.obstacles).reshape(-1, 2)
        self.low, self.high = task.bounds
        self.scale = np.full(2, C.plan_step)
        self.start, self.goal = np.zeros(2), task.goal

    def free(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """The whole way is farther from all obstacles than the audit of plans asks for."""
        clear = np.ones(len(first), bool)
        for obstacle in self.obstacles:
            distance = segment_distance(obstacle, first, second)
            clear &= distance >= CLEARANCE + ROADMAP_SLACK
        return clear

    def action(self, state: RocketState, point: np.ndarray) -> np.ndarray:
        move = (point - state.position) / C.plan_step
        return np.concatenate([move, np.zeros((1, 1))], axis=-1)

    def places(self, points: np.ndarray) -> np.ndarray:
        return np.insert(points, 1, 0.0, axis=-1)

    def points(self, state: RocketState) -> np.ndarray:
        return np.asarray(state.position)

    def sent(self, state: RocketState, points: np.ndarray) -> RocketState:
        return state.replace(position=state.position + (self.goal - points))

    def moved(self, start: Start, points: np.ndarray) -> Start:
        qpos = start.qpos.copy()
        qpos[:, :2] += points - self.start
        return replace(start, qpos=qpos)


class RocketTracker(Tracker[RocketState]):
    """Rewards for following the path of the reference motion, independent of time.

    `paper`: exp(k_imi |x - xbar|) R(s) - 0.25 I_collision, xbar the path's nearest point (P).
    `progress`: the same with the sparse R replaced by 0.1 + 0.5 s / L + 0.4 exp(-(L - s) / 1 m),
    where s of the path's length L lies before xbar, and 1 for each metre by which the step raised
    s, up to 0.2 m (D). docs/calibration.md gives the reason for each part. Going forward gains at
    most what going back has lost, so moving to and fro does not pay.
    """

    def __init__(self, task: Rocket, reference: ReferenceMotion, form: str) -> None:
        self.task = task
        self.form = form
        self.reference = reference
        self.horizon = task.horizon
        best = 1.0 + TRACKING_ADVANCE * TRACKING_LIMITS[1]
        self.max_reward = task.max_reward if form == "paper" else best
        remaining = np.linalg.norm(reference.qpos[:, :2] - task.goal, axis=-1)
        # The reference hovers after its arrival, so the path ends there.
        self._arrival = int(np.argmax(remaining < remaining.min() + 0.05))
        self._path = Path.through(reference.qpos[: max(self._arrival, 1) + 1, :2])

    def reward(self, previous: RocketState, action: Array, state: RocketState) -> Array:
        xp = array_namespace(state.position)
        positions = xp.stack([previous.position, state.position])
        (_, distance), (before, progress) = self._path.project(positions)
        collision = xp.astype(self.task.collided(state), state.position.dtype)
        penalty = TRACKING_PENALTY * collision
        closeness = xp.exp(TRACKING_DECAY * distance)
        if self.form == "paper":
            return closeness * self.task.reward(previous, action, state) - penalty
        length = float(self._path.lengths[-1])
        remaining = (1.0 - progress) * length
        worth = 0.1 + 0.5 * progress + 0.4 * xp.exp(-remaining / TRACKING_ARRIVAL)
        advance = xp.clip((progress - before) * length, *TRACKING_LIMITS)
        return closeness * worth + TRACKING_ADVANCE * advance - penalty

    def terminal(self, state: RocketState) -> Array:
        return self.task.terminal(state)

    def start(self, rng: Rng, count: int) -> Start:
        reference, arrival = self.reference, self._arrival
        # More often near the goal: staying there pays, but an early policy does not get there.
        frames = arrival - ((arrival + 1) * rng.uniform(size=count) ** 2).astype(int)
        qpos = reference.qpos[frames].copy()
        qvel = reference.qvel[frames] * rng.uniform(0.0, 1.0, (count, 1))
        qpos[:, 2] = rng.uniform(-0.5, 0.5, count)
        qvel[:, 2] = 0.0
        from_start = self.task.start(rng, count)
        first = rng.uniform(size=count) < 0.25  # the start of evaluation, trained more often
        qpos[first], qvel[first] = from_start.qpos[first], from_start.qvel[first]
        time = np.where(first, 0.0, frames * reference.timestep)
        return Start(time, qpos, qvel, from_start.memory)


def _rocket(name: str, distance: float, obstacles: tuple[tuple[float, float], ...]) -> Rocket:
    least = 2.0 * C.success_distance
    if not least < distance < 1e4:
        raise ValueError(f"the distance must lie between {least} and 10000 m")
    flight = distance * math.cos(C.direction) / (C.plan_step / C.plan_timestep)
    horizon = round(C.horizon_ratio * flight / C.control_timestep)
    return Rocket(name=name, distance=float(distance), obstacles=obstacles, horizon=horizon)


@register("rocket_navigation")
def rocket_navigation(distance: float = 60.0) -> Rocket:
    return _rocket("rocket_navigation", distance, ())


@register("rocket_obstacles")
def rocket_obstacles(distance: float = 60.0) -> Rocket:
    """Two obstacles a third and two thirds of the way, a metre to either side of the line."""
    line = np.array([math.cos(C.direction), math.sin(C.direction)])
    left = np.array([-line[1], line[0]])
    centres = (distance / 3 * line + left, distance * 2 / 3 * line - left)
    obstacles = tuple((float(x), float(z)) for x, z in centres)
    return _rocket("rocket_obstacles", distance, obstacles)
