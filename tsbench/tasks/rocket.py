"""Rocket: fly a planar lander with three engines to a goal far away, past obstacles.

World frame: x to the right, z up, in metres; angles counter-clockwise from upright, in radians.
Marks: P the paper fixes it, D decided here, C calibrated (docs/calibration.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from tsbench.mdp import (
    Abstraction,
    Array,
    Drawing,
    Flame,
    Readings,
    Rng,
    Start,
    State,
    Task,
    Tracker,
    array_namespace,
)
from tsbench.motion import Audit, AuditItem, Plan, ReferenceMotion
from tsbench.sim.model import load_spec
from tsbench.tasks import register

CONTROL_TIMESTEP = 1 / 50  # s, control and simulation (P)
MAIN_THRUST = 50.0  # N per unit of action (P)
SIDE_THRUST = 10.0  # N per unit of action (P)
DEAD_ZONE = 0.5  # of each engine's action (P)
GOAL_WEIGHT, GOAL_DECAY = 0.9, -0.25  # w1, k1 (P)
OBSTACLE_WEIGHT, OBSTACLE_DECAY = 0.075, -0.5  # w2 = w3, k2 = k3 (P)
OBSTACLE_RADIUS = 0.5  # m (D)
HULL_RADIUS = 0.72  # m, to the lander's farthest corner: what a plan keeps clear at any angle (D)

FLAMES = (  # from the nozzles in models/rocket.xml; a positive side force leaves on the right
    Flame("rocket", "main", (0.0, 0.0, -0.58), (0.0, 0.0, -1.0), length=0.03),
    Flame("rocket", "side", (0.59, 0.0, 0.365), (1.0, 0.0, 0.0), length=0.05),
    Flame("rocket", "side", (-0.59, 0.0, 0.365), (-1.0, 0.0, 0.0), length=-0.05),
)

PLAN_TIMESTEP = 1 / 20  # s (P)
PLAN_STEP = 0.25  # m per axis and plan step (P)
PLAN_TURN = 0.05  # rad per plan step (P prints degrees; D: see spec section 1)

# Of the imitation reward; no score depends on them.
TRACKING_DECAY = -0.625  # k_imi (P)
TRACKING_PENALTY = 0.25  # of a collision (P)
TRACKING_ARRIVAL = 1.0  # m, over which arriving is felt (C)
TRACKING_ADVANCE = 1.0  # per metre that a step brings along the reference (C)
# m a step (C): going faster than 10 m/s, twice the plan's speed, earns no more: such rockets
# tumble when they brake. Going back costs what it costs: no rocket does 25 m/s.
TRACKING_LIMITS = (-0.5, 0.2)

DIRECTION = math.radians(30.0)  # of the goal above the horizon (C)
MARGIN = 10.0  # m between the start or goal and the world's bounds (C)
HORIZON_RATIO = 1.5  # horizon over the planner's flight time: arrive, then hover (C)
SUCCESS_DISTANCE, SUCCESS_SPEED = 1.0, 1.0  # m, m/s (D)
START_SPREAD = (0.5, 0.5, 0.2)  # m, m, rad, and of the velocities the same per second (D)
PUSHES = 16  # instants of the flight at which pushes are tried (D)


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
class Rocket(Task[RocketState]):
    """Navigation when there are no obstacles.

    Attributes:
        distance: of the goal from the start in metres.
        obstacles: centres in the world frame in metres.
    """

    name: str
    distance: float
    obstacles: tuple[tuple[float, float], ...]
    horizon: int
    version: int = 1
    timestep: float = CONTROL_TIMESTEP
    substeps: int = 1
    observation_size: int = 10
    action_size: int = 2
    max_reward: float = GOAL_WEIGHT
    imitation_forms: tuple[str, ...] = ("progress", "paper")
    pushed = "rocket"
    push_plane = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))

    @property
    def goal(self) -> np.ndarray:
        return self.distance * np.array([math.cos(DIRECTION), math.sin(DIRECTION)])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower left and upper right corner of the world in metres. The start is the origin."""
        return np.full(2, -MARGIN), self.goal + MARGIN

    # The MDP

    def observation(self, state: RocketState) -> Array:
        xp = array_namespace(state.position)
        return xp.concat(
            [
                state.position,
                wrap(state.angle)[..., None],
                state.velocity,
                state.angular_velocity[..., None],
                self._towards_goal(state),
            ],
            axis=-1,
        )

    def _towards_goal(self, state: RocketState) -> Array:
        """Goal relative to the rocket (2), distance, heading error; shape (..., 4)."""
        xp = array_namespace(state.position)
        offset = xp.asarray(self.goal) - state.position
        distance = xp.linalg.vector_norm(offset, axis=-1)
        bearing = xp.atan2(offset[..., 1], offset[..., 0])
        heading_error = wrap(bearing - (state.angle + math.pi / 2))
        return xp.concat([offset, distance[..., None], heading_error[..., None]], axis=-1)

    def goal_distance(self, state: RocketState) -> Array:
        xp = array_namespace(state.position)
        return xp.linalg.vector_norm(state.position - xp.asarray(self.goal), axis=-1)

    def reward_terms(
        self, previous: RocketState, action: Array, state: RocketState
    ) -> dict[str, Array]:
        """w1 exp(k1 |x - goal|) and, of each obstacle, -w2 exp(k2 |x - obstacle|) (P)."""
        xp = array_namespace(state.position)
        terms = {"near the goal": GOAL_WEIGHT * xp.exp(GOAL_DECAY * self.goal_distance(state))}
        for number, obstacle in enumerate(self.obstacles, 1):
            offset = state.position - xp.asarray(obstacle)
            distance = xp.linalg.vector_norm(offset, axis=-1)
            terms[f"near obstacle {number}"] = -OBSTACLE_WEIGHT * xp.exp(OBSTACLE_DECAY * distance)
        return terms

    def reward(self, previous: RocketState, action: Array, state: RocketState) -> Array:
        """R, the sum of its terms (P)."""
        return sum(self.reward_terms(previous, action, state).values())

    def terminal(self, state: RocketState) -> Array:
        """Out of bounds (P)."""
        xp = array_namespace(state.position)
        low, high = (xp.asarray(corner) for corner in self.bounds)
        return xp.any((state.position < low) | (state.position > high), axis=-1)

    def violated(self, state: RocketState) -> Array:
        """A collision."""
        xp = array_namespace(state.clearance)
        return xp.any(state.clearance <= 0.0, axis=-1)

    def success(self, state: RocketState) -> Array:
        """At the end of the episode within 1 m of the goal and slower than 1 m/s."""
        xp = array_namespace(state.position)
        speed = xp.linalg.vector_norm(state.velocity, axis=-1)
        return (self.goal_distance(state) < SUCCESS_DISTANCE) & (speed < SUCCESS_SPEED)

    # The physics

    def spec(self) -> mujoco.MjSpec:
        spec = load_spec("rocket")
        x, z = self.goal
        spec.worldbody.add_site(
            name="goal", pos=[x, 0.0, z], size=[SUCCESS_DISTANCE] * 3, rgba=[0.95, 0.75, 0.1, 0.6]
        )
        for number, (x, z) in enumerate(self.obstacles, 1):
            name = f"obstacle_{number}"
            spec.worldbody.add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                pos=[x, 0.0, z],
                size=[OBSTACLE_RADIUS, 0.0, 0.0],
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

        def worth(position: np.ndarray) -> np.ndarray:
            still = np.zeros(len(position))
            state = self._kinematic(still, position[:, [0, 2]], still)
            reward: np.ndarray = self.reward(state, still, state)
            return reward

        return Drawing(flames=FLAMES, bounds=(low, high), worth=worth)

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """At the origin, at rest, upright (P).

        Perturbed: position and angle, and their velocities, within `START_SPREAD`, uniform.
        """
        qpos, qvel = np.zeros((count, 3)), np.zeros((count, 3))
        if perturbed:
            qpos = rng.uniform(-1.0, 1.0, (count, 3)) * START_SPREAD
            qvel = rng.uniform(-1.0, 1.0, (count, 3)) * START_SPREAD
        return Start(np.zeros(count), qpos, qvel, np.zeros((count, 0)))

    def control(self, state: RocketState, action: Array) -> tuple[Array, Array]:
        """Engine forces in newtons (main, side); dead below half throttle (P)."""
        xp = array_namespace(action)
        action = xp.clip(action, -1.0, 1.0)
        main, side = action[..., 0], action[..., 1]
        force = xp.stack(
            [
                xp.where(main >= DEAD_ZONE, MAIN_THRUST * main, 0.0),
                xp.where(xp.abs(side) >= DEAD_ZONE, SIDE_THRUST * side, 0.0),
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
        """Spread evenly over the planner's flight: there is no cycle whose phases could matter,
        but there are a take-off, obstacles and an arrival."""
        flight = self.horizon / HORIZON_RATIO
        return tuple(int((index + 0.5) * flight / PUSHES) for index in range(PUSHES))

    def ideal(self) -> RocketState:
        """At the planner's speed along each axis until there."""
        steps = np.arange(self.horizon + 1)
        travelled = PLAN_STEP / PLAN_TIMESTEP * self.timestep * steps
        position = np.minimum(travelled[:, None], self.goal)
        return self._kinematic(steps * self.timestep, position, 0.0 * travelled)

    def _kinematic(self, time: Array, position: Array, angle: Array) -> RocketState:
        """A state without velocities, its clearance that of a disc around the hull."""
        xp = array_namespace(position)
        clearance = [
            xp.linalg.vector_norm(position - xp.asarray(obstacle), axis=-1)[..., None]
            - (OBSTACLE_RADIUS + HULL_RADIUS)
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

    # The planning variant

    def abstraction(self) -> Abstraction[RocketState]:
        horizon = int(self.horizon * self.timestep / PLAN_TIMESTEP)

        def start(count: int) -> RocketState:
            zeros = np.zeros(count)
            return self._kinematic(zeros, np.zeros((count, 2)), zeros)

        def sample(rng: Rng, count: int) -> RocketState:
            steps = rng.integers(0, horizon, count)
            return self._kinematic(
                steps * PLAN_TIMESTEP,
                rng.uniform(*self.bounds, (count, 2)),
                rng.uniform(-0.5, 0.5, count),
            )

        def advance(state: RocketState, action: Array) -> RocketState:
            xp = array_namespace(action)
            action = xp.clip(action, -1.0, 1.0)
            return self._kinematic(
                state.time + PLAN_TIMESTEP,
                state.position + PLAN_STEP * action[..., :2],
                state.angle + PLAN_TURN * action[..., 2],
            )

        def flatten(state: RocketState) -> Array:
            xp = array_namespace(state.position)
            return xp.concat([state.position, state.angle[..., None]], axis=-1)

        def naive(state: RocketState) -> Array:
            """Straight at the goal, past nothing."""
            xp = array_namespace(state.position)
            offset = (xp.asarray(self.goal) - state.position) / PLAN_STEP
            longest = xp.max(xp.abs(offset), axis=-1)[..., None]
            move = offset / xp.clip(longest, 1.0, None)
            return xp.concat([move, 0.0 * longest], axis=-1)

        def observation(state: RocketState) -> Array:
            xp = array_namespace(state.position)
            return xp.concat(
                [state.position, wrap(state.angle)[..., None], self._towards_goal(state)], axis=-1
            )

        return Abstraction(
            timestep=PLAN_TIMESTEP,
            horizon=horizon,
            action_size=3,
            coordinates=("x", "z", "angle"),
            start=start,
            sample=sample,
            advance=advance,
            observation=observation,
            observation_size=7,
            flatten=flatten,
            naive=naive,
            poses=lambda states: states,
        )

    def reference(self, plan: Plan) -> ReferenceMotion:
        """The plan, interpolated linearly to the control rate."""
        steps = int(plan.times[-1] / self.timestep + 1e-9)
        times = np.arange(steps + 1) * self.timestep
        qpos = np.stack([np.interp(times, plan.times, column) for column in plan.states.T], axis=-1)
        position = np.stack([qpos[:, 0], 0.0 * qpos[:, 0], qpos[:, 1]], axis=-1)
        return ReferenceMotion(
            task=self.name,
            task_version=self.version,
            timestep=self.timestep,
            qpos=qpos,
            qvel=np.gradient(qpos, self.timestep, axis=0),
            feet=np.zeros((len(qpos), 0, 3)),
            contacts=np.zeros((len(qpos), 0), dtype=bool),
            com=position,
        )

    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        path = plan.states[:, :2]
        final = float(np.linalg.norm(path[-1] - self.goal))
        speed = float(np.abs(np.diff(path, axis=0)).max() / plan.timestep)
        items = [
            AuditItem("distance of the plan's end from the goal", final, SUCCESS_DISTANCE, "m"),
            AuditItem("speed per axis", speed, PLAN_STEP / PLAN_TIMESTEP + 1e-6, "m/s"),
        ]
        for number, obstacle in enumerate(self.obstacles, 1):
            nearest = float(np.linalg.norm(path - np.array(obstacle), axis=-1).min())
            shortfall = max(0.0, OBSTACLE_RADIUS + HULL_RADIUS - nearest)
            items.append(
                AuditItem(f"missing clearance from obstacle {number}", shortfall, 0.0, "m")
            )
        return Audit(tuple(items))

    # The imitation variant

    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> Tracker[RocketState]:
        """Rewards for following the reference's path, whatever the time.

        `paper`: exp(k_imi |x - xbar|) R(s) - 0.25 I_collision, xbar the path's nearest point (P).
        `progress` (default): the same with the sparse R replaced by
        0.1 + 0.5 s / L + 0.4 exp(-(L - s) / 1 m), where s of the path's length L lies before
        xbar, and 1 for each metre by which the step raised s, up to 0.2 m (D). The printed form is
        itself sparse when the goal is far. Without the exponential the last metres are worth about
        1 % each, less than what leaving a steady hover costs, and without the pay for advancing
        the same holds on the way: policies stop some metres short, or are slow. Felt over 4 m,
        arriving is not worth the last metre. With pay for any speed they come in too fast to stop
        (docs/calibration.md). Going forth gains at most what
        going back has lost: to and fro does not pay.
        """
        form = self.imitation_form(form)
        remaining = np.linalg.norm(reference.qpos[:, :2] - self.goal, axis=-1)
        arrival = int(np.argmax(remaining < remaining.min() + 0.05))  # the rest is hovering
        path = Path.through(reference.qpos[: max(arrival, 1) + 1, :2])

        def reward(previous: RocketState, action: Array, state: RocketState) -> Array:
            xp = array_namespace(state.position)
            positions = xp.stack([previous.position, state.position])
            (_, distance), (before, progress) = path.project(positions)
            collision = xp.astype(self.violated(state), state.position.dtype)
            penalty = TRACKING_PENALTY * collision
            closeness = xp.exp(TRACKING_DECAY * distance)
            if form == "paper":
                return closeness * self.reward(previous, action, state) - penalty
            length = path.lengths[-1]
            remaining = (1.0 - progress) * length
            worth = 0.1 + 0.5 * progress + 0.4 * xp.exp(-remaining / TRACKING_ARRIVAL)
            advance = xp.clip((progress - before) * length, *TRACKING_LIMITS)
            return closeness * worth + TRACKING_ADVANCE * advance - penalty

        def start(rng: Rng, count: int) -> Start:
            # More often near the goal, where to stay pays and an early policy does not get.
            frames = arrival - ((arrival + 1) * rng.uniform(size=count) ** 2).astype(int)
            qpos = reference.qpos[frames].copy()
            qvel = reference.qvel[frames] * rng.uniform(0.0, 1.0, (count, 1))
            qpos[:, 2] = rng.uniform(-0.5, 0.5, count)
            qvel[:, 2] = 0.0
            from_start = self.start(rng, count)
            first = rng.uniform(size=count) < 0.25  # evaluation starts here: practise it more
            qpos[first], qvel[first] = from_start.qpos[first], from_start.qvel[first]
            time = np.where(first, 0.0, frames * reference.timestep)
            return Start(time, qpos, qvel, from_start.memory)

        best = TRACKING_ADVANCE * TRACKING_LIMITS[1]
        return Tracker(
            reward=reward,
            max_reward=GOAL_WEIGHT if form == "paper" else 1.0 + best,
            terminal=self.terminal,
            start=start,
            horizon=self.horizon,
        )


@dataclass(frozen=True)
class Path:
    """A polyline with many short segments of similar length.

    Attributes:
        vertices: metres, shape (n, 2).
        lengths: metres from the first vertex to each, shape (n,).
    """

    vertices: np.ndarray
    lengths: np.ndarray

    @classmethod
    def through(cls, points: np.ndarray) -> Path:
        moved = np.linalg.norm(np.diff(points, axis=0), axis=-1)
        keep = np.concatenate([[True], moved > 1e-9])
        return cls(points[keep], np.concatenate([[0.0], np.cumsum(moved[moved > 1e-9])]))

    def project(self, position: Array) -> tuple[Array, Array]:
        """Distance to the nearest point in metres and the share of the path before it.

        Only the two segments at the nearest vertex are looked at: with short, similar segments
        another one cannot be nearer by more than a fraction of a segment.
        """
        xp = array_namespace(position)
        vertices, lengths = xp.asarray(self.vertices), xp.asarray(self.lengths)
        if len(self.vertices) == 1:
            distance = xp.linalg.vector_norm(position - vertices[0], axis=-1)
            return distance, 0.0 * distance
        # |p - v|^2 less |p|^2, which does not change the order. Summed by hand: a matrix product
        # would round differently for one position than for many.
        squared = (
            xp.sum(vertices * vertices, axis=-1)
            - 2.0 * position[..., None, 0] * vertices[:, 0]
            - 2.0 * position[..., None, 1] * vertices[:, 1]
        )
        nearest = xp.argmin(squared, axis=-1)[..., None] + xp.asarray([-1, 0])
        index = xp.clip(nearest, 0, len(self.vertices) - 2)  # of two segments, shape (..., 2)
        a, b = vertices[index], vertices[index + 1]
        along = b - a
        length = lengths[index + 1] - lengths[index]
        position = position[..., None, :]
        share = xp.sum((position - a) * along, axis=-1) / (length * length)
        share = xp.clip(share, 0.0, 1.0)
        distance = xp.linalg.vector_norm(position - (a + share[..., None] * along), axis=-1)
        travelled = (lengths[index] + share * length) / lengths[-1]
        first = distance[..., 0] <= distance[..., 1]
        return (
            xp.where(first, distance[..., 0], distance[..., 1]),
            xp.where(first, travelled[..., 0], travelled[..., 1]),
        )


def _rocket(name: str, distance: float, obstacles: tuple[tuple[float, float], ...]) -> Rocket:
    if not 2.0 * SUCCESS_DISTANCE < distance < 1e4:
        raise ValueError(f"the distance must lie between {2.0 * SUCCESS_DISTANCE} and 10000 m")
    flight = distance * math.cos(DIRECTION) / (PLAN_STEP / PLAN_TIMESTEP)
    horizon = round(HORIZON_RATIO * flight / CONTROL_TIMESTEP)
    return Rocket(name=name, distance=float(distance), obstacles=obstacles, horizon=horizon)


@register("rocket_navigation")
def rocket_navigation(distance: float = 60.0) -> Rocket:
    return _rocket("rocket_navigation", distance, ())


@register("rocket_obstacles")
def rocket_obstacles(distance: float = 60.0) -> Rocket:
    """Two obstacles a third and two thirds of the way, a metre to either side of the line."""
    line = np.array([math.cos(DIRECTION), math.sin(DIRECTION)])
    left = np.array([-line[1], line[0]])
    centres = (distance / 3 * line + left, distance * 2 / 3 * line - left)
    obstacles = tuple((float(x), float(z)) for x, z in centres)
    return _rocket("rocket_obstacles", distance, obstacles)
