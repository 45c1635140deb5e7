"""Laikago: walk or trot straight to a goal with a given footfall pattern.

World frame: x forward, y left, z up, in metres; the ground is z = 0. Legs in the order FR, FL, RR,
RL; joints of a leg in the order abduction, thigh, calf. Quaternions are (w, x, y, z).
Marks: P the paper fixes it, D decided here, C calibrated (docs/calibration.md).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.interpolate import PchipInterpolator

from tsbench.mdp import (
    Abstraction,
    Array,
    Drawing,
    Readings,
    Rng,
    Start,
    State,
    Task,
    Tracker,
    array_namespace,
)
from tsbench.motion import Audit, AuditItem, Plan, ReferenceMotion
from tsbench.planning.ik import FootPoses
from tsbench.sim.model import compiled, load_spec
from tsbench.sim.tracking import deepmimic_reward
from tsbench.tasks import register

FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
FOOT_RADIUS = 0.0265  # m, of the sphere whose lowest point is the sole
HIPS = np.array(  # m, where a straight leg hangs, in the base frame (models/laikago.xml)
    [[0.21935, -0.1245], [0.21935, 0.1245], [-0.21935, -0.1245], [-0.21935, 0.1245]]
)
STAND_HEIGHT = 0.42  # m, of the base with the nominal pose's soles on the ground

CONTROL_TIMESTEP = 1 / 30  # s (P)
SUBSTEPS = 20  # 600 Hz simulation (P)
NOMINAL = np.tile([0.0, 0.67, -1.33], 4)  # rad (D)
RESIDUAL = 0.75  # rad per unit of action (D)
# Second-order Butterworth low-pass at 4 Hz for signals at 30 Hz (P filter, D order and cut);
# tests compare the coefficients with scipy.signal.butter.
FILTER_B = (0.108447438890226, 0.216894877780452, 0.108447438890226)
FILTER_A = (-0.8772706323073945, 0.31106038786829865)

DISTANCE_DECAY, SLIP_DECAY, HEIGHT_DECAY, MOTION_DECAY = -2.5, -10.0, -20.0, -4.0  # (P)
COM_DECAY = -5.0  # k_com, which the paper leaves out (D)
SWING_HEIGHT = 0.10  # m (P)
FALL_HEIGHT = 0.32  # m, of the centre of mass (P)
GOAL_TOLERANCE = 0.05  # m (D)
SUCCESS_SHARE = 0.2  # of the starting distance that may remain at the end (D)
START_ANGLE, START_SPEED, START_SPIN = 0.05, 0.1, 0.2  # rad, m/s, rad/s (D)

# s (D). The paper names both 0.1 s and 60 steps. At 0.1 s the reward, a product of exponentials
# per step, prefers plans that throw all feet forward at once every few steps and slide
# (docs/calibration.md); at the control rate it prefers the gait.
PLAN_TIMESTEP = 1 / 30
PLAN_REACH = 0.15  # m, how far a planned foot may be ahead of or behind its hip (D)
PLAN_SIGHT = 0.5  # m, beyond which the planner does not see how far the goal is (D)
PLAN_HEIGHT = (0.40, 0.44)  # m, of a planned base: legs neither stretched nor folded (D)
JOINT_SPEED = 12.8  # rad/s, what the motors can do (facts A1)


@dataclass(frozen=True)
class Gait:
    """A contact schedule that depends on the clock alone, with the speeds that go with it.

    Attributes:
        period: seconds of a cycle.
        duty: share of the cycle in which a foot is on the ground.
        phases: share of the cycle by which each foot is ahead of the clock.
        base_speed: m/s at most (P).
        foot_speed: rad/s at most about the hip (P).
        leg_length: metres, of the arc a foot moves on (D: speed * duty / (1 - duty) =
            foot_speed * leg_length, so that both speeds are reached together).
    """

    period: float
    duty: float
    phases: tuple[float, float, float, float]
    base_speed: float
    foot_speed: float
    leg_length: float

    def phase(self, time: Array) -> Array:
        """Each foot's share of the cycle since its touchdown, in [0, 1), shape (..., 4)."""
        xp = array_namespace(time)
        # The nudge keeps an instant that rounding moved below a whole cycle from ending it.
        return (time[..., None] / self.period + xp.asarray(self.phases) + 1e-9) % 1.0

    def contacts(self, time: Array) -> Array:
        """Whether each foot is to be on the ground, shape (..., 4).

        Touchdown and lift-off belong to the stance: the foot is on the ground at both.
        """
        return self.phase(time) <= self.duty + 2e-9


WALK = Gait(0.8, 0.75, (0.25, 0.75, 0.5, 0.0), base_speed=0.264, foot_speed=1.65, leg_length=0.48)
TROT = Gait(16 / 30, 0.5, (0.0, 0.5, 0.5, 0.0), base_speed=0.63, foot_speed=1.26, leg_length=0.50)


@dataclass(frozen=True)
class LaikagoState(State):
    """One robot or many.

    Attributes:
        joint_position: rad, shape (..., 12).
        joint_velocity: rad/s, shape (..., 12).
        base_position: world frame in metres, shape (..., 3).
        base_orientation: world frame, unit quaternion, shape (..., 4).
        base_velocity: world frame in m/s, shape (..., 3).
        base_angular_velocity: base frame in rad/s, shape (..., 3).
        feet: foot centres in the world frame in metres, shape (..., 4, 3).
        com: whole-body centre of mass in the world frame in metres, shape (..., 3).
        filter: the last two residuals before and after the low-pass in rad, shape (..., 48).
    """

    joint_position: Array
    joint_velocity: Array
    base_position: Array
    base_orientation: Array
    base_velocity: Array
    base_angular_velocity: Array
    feet: Array
    com: Array
    filter: Array


@dataclass(frozen=True)
class Laikago(Task[LaikagoState]):
    """Attributes:
    gait: the footfall pattern.
    distance: of the goal, straight ahead, from the start in metres.
    """

    name: str
    gait: Gait
    distance: float
    horizon: int
    version: int = 1
    timestep: float = CONTROL_TIMESTEP
    substeps: int = SUBSTEPS
    observation_size: int = 43
    action_size: int = 12
    max_reward: float = 1.0
    imitation_forms: tuple[str, ...] = ("deepmimic",)
    pushed = "trunk"
    push_plane = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))

    # The MDP

    def observation(self, state: LaikagoState) -> Array:
        xp = array_namespace(state.joint_position)
        return xp.concat(
            [
                state.joint_position,
                state.joint_velocity,
                state.base_position,
                # q and -q are one rotation
                xp.where(state.base_orientation[..., :1] < 0.0, -1.0, 1.0) * state.base_orientation,
                state.base_velocity,
                state.base_angular_velocity,
                self._clock(state),
                self._goal_offset(state),
                self.goal_distance(state)[..., None],
            ],
            axis=-1,
        )

    def _clock(self, state: LaikagoState) -> Array:
        """Share of the episode, and the gait's cycle as sine and cosine; shape (..., 3)."""
        xp = array_namespace(state.time)
        cycle = 2.0 * math.pi / self.gait.period * state.time
        share = state.time / (self.horizon * self.timestep)
        return xp.stack([share, xp.sin(cycle), xp.cos(cycle)], axis=-1)

    def _goal_offset(self, state: LaikagoState) -> Array:
        xp = array_namespace(state.base_position)
        return xp.asarray([self.distance, 0.0]) - state.base_position[..., :2]

    def goal_distance(self, state: LaikagoState) -> Array:
        """Of the base, on the ground plane, in metres, shape (...,)."""
        xp = array_namespace(state.base_position)
        return xp.linalg.vector_norm(self._goal_offset(state), axis=-1)

    def reward_terms(
        self, previous: LaikagoState, action: Array, state: LaikagoState
    ) -> dict[str, Array]:
        """r_dist, r_ns, r_ee_z, r_ee_x, whose product is the reward, each shape (...,) (P).

        r_dist = exp(-2.5 |x - goal|), on the ground plane.
        r_ns = exp(-10 sum c |e - e_prev|), horizontal, over the feet that were and are to stand.
        r_ee_z = exp(-20 sum |z - zbar|), z at the sole, zbar 0 in stance and 0.10 m in swing.
        r_ee_x = exp(-4 sum |x - x_prev|), over all feet in the world frame.
        """
        xp = array_namespace(state.feet)
        contacts = self.gait.contacts(state.time)
        stance = contacts & self.gait.contacts(previous.time)
        moved = state.feet - previous.feet
        slip = xp.where(stance, xp.linalg.vector_norm(moved[..., :2], axis=-1), 0.0)
        height_error = state.feet[..., 2] - FOOT_RADIUS - xp.where(contacts, 0.0, SWING_HEIGHT)
        return {
            "near the goal": xp.exp(DISTANCE_DECAY * self.goal_distance(state)),
            "feet do not slip": xp.exp(SLIP_DECAY * xp.sum(slip, axis=-1)),
            "feet at their height": xp.exp(HEIGHT_DECAY * xp.sum(xp.abs(height_error), axis=-1)),
            "feet move little": xp.exp(MOTION_DECAY * xp.sum(xp.abs(moved[..., 0]), axis=-1)),
        }

    def reward(self, previous: LaikagoState, action: Array, state: LaikagoState) -> Array:
        distance, no_slip, height, motion = self.reward_terms(previous, action, state).values()
        return distance * no_slip * height * motion

    def fallen(self, state: LaikagoState) -> Array:
        """The centre of mass is below 0.32 m (P)."""
        return state.com[..., 2] < FALL_HEIGHT

    def violated(self, state: LaikagoState) -> Array:
        return self.fallen(state)

    def reached(self, state: LaikagoState) -> Array:
        return self.goal_distance(state) < GOAL_TOLERANCE

    def terminal(self, state: LaikagoState) -> Array:
        """At the goal, farther from it than at the start, or fallen (P)."""
        strayed = self.goal_distance(state) > self.distance + GOAL_TOLERANCE
        return self.reached(state) | strayed | self.fallen(state)

    def success(self, state: LaikagoState) -> Array:
        """Not fallen, and at most 20 % of the starting distance from the goal, at the end."""
        near = self.goal_distance(state) <= SUCCESS_SHARE * self.distance
        return near & ~self.fallen(state)

    # The physics

    def spec(self) -> mujoco.MjSpec:
        spec = load_spec("laikago")
        spec.worldbody.add_site(
            name="goal",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=[self.distance, 0.0, 0.002],
            size=[GOAL_TOLERANCE, 0.002, 0.0],
            rgba=[0.95, 0.75, 0.1, 1.0],
        )
        return spec

    def drawing(self) -> Drawing:
        return Drawing(feet=FEET, contacts=self.gait.contacts)

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """Standing at the origin in the nominal pose, at rest (P fixed, D pose).

        Perturbed, all uniform: joints and the base's orientation per axis within `START_ANGLE`,
        the base's velocity within `START_SPEED`, angular velocities within `START_SPIN`. The base
        is raised by what tilt and bend can lower a sole at most: it may drop by some millimetres.
        """
        qpos = np.tile(compiled("laikago").key("home").qpos, (count, 1))
        qvel = np.zeros((count, 18))
        if perturbed:
            qpos, qvel = self._perturb(rng, qpos, qvel)
        return Start(np.zeros(count), qpos, qvel, filter_memory(qpos[:, 7:]))

    @staticmethod
    def _perturb(
        rng: Rng, qpos: np.ndarray, qvel: np.ndarray, scale: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        def uniform(bound: float, size: int) -> np.ndarray:
            return rng.uniform(-bound * scale, bound * scale, (len(qpos), size))

        qpos, qvel = qpos.copy(), qvel.copy()
        turn = uniform(START_ANGLE, 3)
        joints = uniform(START_ANGLE, 12)
        qpos[:, 7:] += joints
        # Small turns about the three axes, as one rotation vector.
        angle = np.linalg.norm(turn, axis=-1, keepdims=True)
        axis = turn / np.maximum(angle, 1e-12)
        rotation = np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], axis=-1)
        qpos[:, 3:7] = multiply(rotation, qpos[:, 3:7])
        # A leg is 0.5 m long and its hip 0.25 m from the base: no sole sinks deeper than this.
        tilt = np.abs(turn[:, :2]) @ np.array([0.13, 0.22])
        bend = np.abs(joints.reshape(-1, 4, 3)[..., 1:]).max(axis=1) @ np.array([0.01, 0.16])
        qpos[:, 2] += tilt + bend
        qvel[:, :3] += uniform(START_SPEED, 3)
        qvel[:, 3:6] += uniform(START_SPIN, 3)
        qvel[:, 6:] += uniform(START_SPIN, 12)
        return qpos, qvel

    def control(self, state: LaikagoState, action: Array) -> tuple[Array, Array]:
        """Joint targets in rad (..., 12): the nominal pose plus the low-passed residual."""
        xp = array_namespace(action)
        residual = RESIDUAL * xp.clip(action, -1.0, 1.0)
        x1, x2, y1, y2 = (state.filter[..., 12 * i : 12 * (i + 1)] for i in range(4))
        filtered = (
            FILTER_B[0] * residual + FILTER_B[1] * x1 + FILTER_B[2] * x2
            - FILTER_A[0] * y1 - FILTER_A[1] * y2
        )  # fmt: skip
        memory = xp.concat([residual, x1, filtered, y1], axis=-1)
        return xp.asarray(NOMINAL) + filtered, memory

    def read(self, readings: Readings) -> LaikagoState:
        xp = array_namespace(readings.qpos)
        qpos, qvel = readings.qpos, readings.qvel
        return LaikagoState(
            time=readings.time,
            joint_position=qpos[..., 7:],
            joint_velocity=qvel[..., 6:],
            base_position=qpos[..., :3],
            base_orientation=qpos[..., 3:7],
            base_velocity=qvel[..., :3],
            base_angular_velocity=qvel[..., 3:6],
            feet=xp.stack([readings.sensors[f"{foot}_position"] for foot in FEET], axis=-2),
            com=readings.sensors["com"],
            filter=readings.memory,
        )

    def memory(self, state: LaikagoState) -> Array:
        return state.filter

    @property
    def push_steps(self) -> tuple[int, ...]:
        """Every control step of the gait cycle that begins in the middle of the episode: the gait
        is steady by then, and half of the episode is left to fall in."""
        first = self.horizon // 2
        cycle = round(self.gait.period / self.timestep)
        return tuple(range(first, min(first + cycle, self.horizon)))

    def ideal(self) -> LaikagoState:
        """At top speed straight to the goal; feet at rest in stance, at even speed in swing."""
        steps = np.arange(self.horizon + 1)
        time = steps * self.timestep
        base_x = np.minimum(self.gait.base_speed * time, self.distance)
        base = np.stack([base_x, 0.0 * base_x, STAND_HEIGHT + 0.0 * base_x], axis=-1)
        phase = self.gait.phase(time)
        stance = phase / self.gait.duty
        swing = (phase - self.gait.duty) / (1.0 - self.gait.duty)
        half_step = self.gait.base_speed * self.gait.duty * self.gait.period / 2
        ahead = half_step * np.where(phase <= self.gait.duty, 1.0 - 2.0 * stance, 2.0 * swing - 1.0)
        return self._kinematic(time, base, base[:, :1] + HIPS[:, 0] + ahead)

    def _kinematic(self, time: Array, base: Array, feet_x: Array) -> LaikagoState:
        """A level base over feet at the schedule's heights, in y under their hips."""
        xp = array_namespace(base)
        hips = xp.asarray(HIPS)
        feet = xp.stack(
            [
                feet_x,
                base[..., 1:2] + hips[:, 1],
                FOOT_RADIUS + xp.where(self.gait.contacts(time), 0.0, SWING_HEIGHT),
            ],
            axis=-1,
        )
        zeros = xp.zeros((*base.shape[:-1], 12))
        upright = xp.concat([1.0 + 0.0 * base[..., :1], 0.0 * base], axis=-1)
        return LaikagoState(
            time=time,
            joint_position=zeros,
            joint_velocity=zeros,
            base_position=base,
            base_orientation=upright,
            base_velocity=0.0 * base,
            base_angular_velocity=0.0 * base,
            feet=feet,
            com=base,  # the true one is less than 1 cm away (facts D)
            filter=xp.concat([zeros] * 4, axis=-1),
        )

    # The planning variant

    def abstraction(self) -> Abstraction[LaikagoState]:
        """Base position and four feet; the base stays level, the feet under their hips in y.

        An action is the base's displacement (3, norm at most speed x time step) and each foot's
        forward displacement (4), whose angle about the hip is limited. Foot heights follow the
        contact schedule (P).
        """
        gait = self.gait
        horizon = round(self.horizon * self.timestep / PLAN_TIMESTEP)

        def start(count: int) -> LaikagoState:
            base = np.tile([0.0, 0.0, STAND_HEIGHT], (count, 1))
            return self._kinematic(np.zeros(count), base, np.tile(HIPS[:, 0], (count, 1)))

        def sample(rng: Rng, count: int) -> LaikagoState:
            time = rng.integers(0, horizon, count) * PLAN_TIMESTEP
            base = rng.uniform([0.8, -0.1, PLAN_HEIGHT[0]], [1.0, 0.1, PLAN_HEIGHT[1]], (count, 3))
            base[:, 0] *= gait.base_speed * time  # nearly as far as it could be by then
            ahead = rng.uniform(-PLAN_REACH / 2, PLAN_REACH / 2, (count, 4))
            return self._kinematic(time, base, base[:, :1] + HIPS[:, 0] + ahead)

        def advance(state: LaikagoState, action: Array) -> LaikagoState:
            xp = array_namespace(action)
            action = xp.clip(action, -1.0, 1.0)
            push, step = action[..., :3], action[..., 3:]
            push = push / xp.clip(xp.linalg.vector_norm(push, axis=-1)[..., None], 1.0, None)
            move = gait.base_speed * PLAN_TIMESTEP * push
            swing = gait.leg_length * gait.foot_speed * PLAN_TIMESTEP
            ahead = feet_ahead(state)
            # A foot's displacement is the world's, so that an idle foot stands still. The base
            # goes no further than the legs reach: who will not step does not travel.
            step = 2.0 * swing * step
            least = xp.max(ahead + xp.clip(step, None, 0.0), axis=-1)[..., None] - PLAN_REACH
            most = xp.min(ahead + xp.clip(step, 0.0, None), axis=-1)[..., None] + PLAN_REACH
            forward = xp.clip(move[..., :1], least, most)
            ahead = xp.clip(ahead + xp.clip(step - forward, -swing, swing), -PLAN_REACH, PLAN_REACH)
            base = state.base_position + xp.concat([forward, move[..., 1:]], axis=-1)
            base = xp.concat([base[..., :2], xp.clip(base[..., 2:], *PLAN_HEIGHT)], axis=-1)
            feet_x = base[..., :1] + xp.asarray(HIPS[:, 0]) + ahead
            return self._kinematic(state.time + PLAN_TIMESTEP, base, feet_x)

        def feet_ahead(state: LaikagoState) -> Array:
            """Metres by which each foot is ahead of its hip, shape (..., 4)."""
            xp = array_namespace(state.feet)
            return state.feet[..., 0] - state.base_position[..., :1] - xp.asarray(HIPS[:, 0])

        def naive(state: LaikagoState) -> Array:
            """Straight ahead at top speed; stance feet stay, swing feet swing as fast as that."""
            xp = array_namespace(state.feet)
            after = state.time + PLAN_TIMESTEP
            stance = gait.contacts(state.time) & gait.contacts(after)
            speed = gait.base_speed / (1.0 - gait.duty)  # of a swing foot in the world
            step = xp.where(stance, 0.0, speed / (2.0 * gait.leg_length * gait.foot_speed))
            ahead = 1.0 + 0.0 * state.time[..., None]
            return xp.concat([ahead, 0.0 * ahead, 0.0 * ahead, step], axis=-1)

        def observation(state: LaikagoState) -> Array:
            """Far from the goal its distance is hidden: the gait that pays near it, where alone
            the reward can be felt, is then the gait everywhere."""
            xp = array_namespace(state.base_position)
            distance = self.goal_distance(state)[..., None]
            contacts = [
                xp.astype(gait.contacts(state.time + delay), distance.dtype)
                for delay in (0.0, PLAN_TIMESTEP)
            ]
            return xp.concat(
                [
                    self._goal_offset(state) * (PLAN_SIGHT / xp.clip(distance, PLAN_SIGHT, None)),
                    state.base_position[..., 2:],
                    feet_ahead(state),
                    self._clock(state)[..., 1:],
                    *contacts,
                ],
                axis=-1,
            )

        def value_observation(state: LaikagoState) -> Array:
            xp = array_namespace(state.base_position)
            return xp.concat(
                [
                    observation(state),
                    self._goal_offset(state),
                    self.goal_distance(state)[..., None],
                    self._clock(state)[..., :1],
                ],
                axis=-1,
            )

        def dynamics_reward(state: LaikagoState) -> Array:
            """R_dyn = exp(k_com |C - P|), C the base, P the mean of the stance feet (P form)."""
            xp = array_namespace(state.feet)
            weight = xp.astype(gait.contacts(state.time), state.feet.dtype)[..., None]
            support = xp.sum(weight * state.feet[..., :2], axis=-2) / xp.sum(weight, axis=-2)
            offset = state.base_position[..., :2] - support
            return xp.exp(COM_DECAY * xp.linalg.vector_norm(offset, axis=-1))

        def flatten(state: LaikagoState) -> Array:
            xp = array_namespace(state.feet)
            feet = xp.reshape(state.feet, (*state.feet.shape[:-2], 12))
            return xp.concat([state.base_position, feet], axis=-1)

        def poses(states: np.ndarray) -> np.ndarray:
            return self._poses(states[:, :3], states[:, 3:].reshape(-1, 4, 3))[0]

        return Abstraction(
            timestep=PLAN_TIMESTEP,
            horizon=horizon,
            action_size=7,
            coordinates=(
                *(f"base_{axis}" for axis in "xyz"),
                *(f"{foot}_{axis}" for foot in FEET for axis in "xyz"),
            ),
            start=start,
            sample=sample,
            advance=advance,
            observation=observation,
            observation_size=17,
            value_observation=value_observation,
            flatten=flatten,
            naive=naive,
            poses=poses,
            dynamics_reward=dynamics_reward,
        )

    @staticmethod
    def _poses(base: np.ndarray, feet: np.ndarray) -> tuple[np.ndarray, float]:
        """Generalised positions (k, 19) for level bases (k, 3) and foot centres (k, 4, 3), and
        the largest distance in metres that inverse kinematics left between foot and target."""
        model = compiled("laikago")
        solver = FootPoses(model, FEET, model.key("home").qpos)
        solutions = [
            solver.solve(np.concatenate([position, [1.0, 0.0, 0.0, 0.0]]), targets)
            for position, targets in zip(base, feet, strict=True)
        ]
        return np.array([q for q, _ in solutions]), max(residual for _, residual in solutions)

    def reference(self, plan: Plan) -> ReferenceMotion:
        """The plan at the control rate, its feet standing still in stance, swinging in half sines.

        No leg can rise 10 cm at once as the plan's feet do. A stance foot stands at the mean of
        its planned positions; `audit` tells how far the plan moved it.
        """
        steps = int(plan.times[-1] / self.timestep + 1e-9)
        times = np.arange(steps + 1) * self.timestep
        base = PchipInterpolator(plan.times, plan.states[:, :3])(times)
        planned = plan.states[:, 3:].reshape(-1, 4, 3)
        feet = self._feet_motion(plan.times, planned, times)
        qpos, _ = self._poses(base, feet)
        model = compiled("laikago")
        data = mujoco.MjData(model)
        qvel = np.zeros((len(times), model.nv))
        com = np.zeros((len(times), 3))
        for k in range(len(times)):
            before, after = max(k - 1, 0), min(k + 1, steps)
            duration = (after - before) * self.timestep
            mujoco.mj_differentiatePos(model, qvel[k], duration, qpos[before], qpos[after])
            data.qpos[:] = qpos[k]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            com[k] = data.subtree_com[0]
            feet[k] = [data.site(foot).xpos for foot in FEET]
        return ReferenceMotion(
            task=self.name,
            task_version=self.version,
            timestep=self.timestep,
            qpos=qpos,
            qvel=qvel,
            feet=feet,
            contacts=self.gait.contacts(times),
            com=com,
        )

    def _feet_motion(
        self, plan_times: np.ndarray, planned: np.ndarray, times: np.ndarray
    ) -> np.ndarray:
        """All foot centres (n, 4, 3) at `times` from their planned positions (T + 1, 4, 3)."""
        legs = [self._foot_motion(leg, plan_times, planned[:, leg], times) for leg in range(4)]
        return np.stack(legs, axis=1)

    def _foot_motion(
        self, leg: int, plan_times: np.ndarray, planned: np.ndarray, times: np.ndarray
    ) -> np.ndarray:
        """One foot's centre (n, 3) at `times` from its planned positions (T + 1, 3)."""
        gait, slack = self.gait, 1e-6
        # Stances [touchdown, lift-off] that overlap the plan.
        first = -gait.phases[leg] * gait.period
        cycles = np.arange(math.ceil((plan_times[-1] - first) / gait.period) + 1)
        stances = []
        for touchdown in first + cycles * gait.period:
            lift_off = touchdown + gait.duty * gait.period
            inside = (plan_times >= touchdown - slack) & (plan_times <= lift_off + slack)
            if inside.any():
                stances.append((touchdown, lift_off, planned[inside, :2].mean(axis=0)))
        # A swing that the plan cuts off begins or ends where the plan does.
        stances.insert(
            0, (-math.inf, stances[0][0] - (1 - gait.duty) * gait.period, planned[0, :2])
        )
        stances.append((stances[-1][1] + (1 - gait.duty) * gait.period, math.inf, planned[-1, :2]))
        motion = np.zeros((len(times), 3))
        motion[:, :2] = planned[0, :2]
        motion[:, 2] = FOOT_RADIUS
        for (_, lift_off, start), (touchdown, next_lift_off, end) in itertools.pairwise(stances):
            share = np.clip((times - lift_off) / (touchdown - lift_off), 0.0, 1.0)
            swing = (times > lift_off) & (times < touchdown)
            eased = share * share * (3.0 - 2.0 * share)
            motion[swing, :2] = (start + eased[:, None] * (end - start))[swing]
            motion[swing, 2] += SWING_HEIGHT * np.sin(math.pi * share[swing])
            stance = (times >= touchdown) & (times <= next_lift_off)
            motion[stance, :2] = end
        return motion

    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        model = compiled("laikago")
        joints = reference.qpos[:, 7:]
        low, high = model.jnt_range[1:].T
        outside = float(np.maximum(low - joints, joints - high).max())
        speed = float(np.abs(reference.qvel[:, 6:]).max())
        planned = plan.states[:, 3:].reshape(-1, 4, 3)
        wanted = self._feet_motion(plan.times, planned, reference_times(reference))
        standing = self._feet_motion(plan.times, planned, plan.times)
        contacts = self.gait.contacts(plan.times)
        slip = np.linalg.norm((planned - standing)[..., :2], axis=-1).mean(axis=0, where=contacts)
        residual = float(np.linalg.norm(reference.feet - wanted, axis=-1).max())
        lift = (reference.feet[..., 2] - FOOT_RADIUS).max(axis=0)
        weight = reference.contacts[..., None].astype(float)
        support = (weight * reference.feet[..., :2]).sum(1) / np.maximum(weight.sum(1), 1.0)
        balance = np.linalg.norm(reference.com[:, :2] - support, axis=-1)
        final = float(np.hypot(self.distance - plan.states[-1, 0], plan.states[-1, 1]))
        return Audit(
            (
                AuditItem(
                    "distance of the plan's end from the goal",
                    final, SUCCESS_SHARE * self.distance, "m",
                ),
                AuditItem("joint angle beyond its limit", max(outside, 0.0), 1e-6, "rad"),
                AuditItem("joint speed", speed, JOINT_SPEED, "rad/s"),
                AuditItem("inverse kinematics error", residual, 2e-3, "m"),
                AuditItem("mean slip of a foot in stance", float(slip.max()), 0.02, "m"),
                AuditItem(
                    "missing swing clearance",
                    max(0.0, SWING_HEIGHT / 2 - float(lift.min())), 0.0, "m",
                ),
                AuditItem("mean distance of CoM from support", float(balance.mean()), 0.12, "m"),
            )
        )  # fmt: skip

    # The imitation variant

    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> Tracker[LaikagoState]:
        """DeepMimic's reward (P by reference), its reference-state initialisation, and an early
        ending at a fall. Pose: twelve joints and the base's orientation. End effectors: relative
        to the base, in its heading frame. Frame k belongs to control step k."""
        self.imitation_form(form)
        reference_heading = to_heading(
            reference.feet - reference.qpos[:, None, :3], reference.qpos[:, 3:7]
        )

        def reward(previous: LaikagoState, action: Array, state: LaikagoState) -> Array:
            xp = array_namespace(state.joint_position)
            frame = reference.frame(state.time)
            joints = state.joint_position - reference.qpos[frame, 7:]
            turn = angle_between(state.base_orientation, reference.qpos[frame, 3:7])
            feet = to_heading(
                state.feet - state.base_position[..., None, :], state.base_orientation
            )
            return deepmimic_reward(
                pose=xp.concat([joints, turn[..., None]], axis=-1),
                velocity=state.joint_velocity - reference.qvel[frame, 6:],
                end_effectors=feet - reference_heading[frame],
                com=state.com - reference.com[frame],
            )

        def terminal(state: LaikagoState) -> Array:
            tilted = upward(state.base_orientation) < 0.0
            return self.fallen(state) | tilted

        def start(rng: Rng, count: int) -> Start:
            frames = rng.integers(0, reference.steps, count)
            qpos, qvel = self._perturb(
                rng, reference.qpos[frames], reference.qvel[frames], scale=0.5
            )
            standing = self.start(rng, count, perturbed=True)
            first = rng.uniform(size=count) < 0.25  # evaluation starts here: practise it more
            qpos[first], qvel[first] = standing.qpos[first], standing.qvel[first]
            time = np.where(first, 0.0, frames * reference.timestep)
            return Start(time, qpos, qvel, filter_memory(qpos[:, 7:]))

        return Tracker(
            reward=reward,
            max_reward=1.0,
            terminal=terminal,
            start=start,
            horizon=reference.steps,
        )


def reference_times(reference: ReferenceMotion) -> np.ndarray:
    return np.arange(reference.steps + 1) * reference.timestep


def filter_memory(joints: np.ndarray) -> np.ndarray:
    """The filter's history of a robot that has long stood with these joint angles (n, 12)."""
    return np.tile(joints - NOMINAL, 4)


def multiply(p: Array, q: Array) -> Array:
    """Product of quaternions, shape (..., 4)."""
    xp = array_namespace(p)
    pw, px, py, pz = (p[..., i] for i in range(4))
    qw, qx, qy, qz = (q[..., i] for i in range(4))
    return xp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def angle_between(p: Array, q: Array) -> Array:
    """Rotation angle from one unit quaternion to another in rad, in [0, pi], shape (...,)."""
    xp = array_namespace(p)
    return 2.0 * xp.acos(xp.clip(xp.abs(xp.sum(p * q, axis=-1)), 0.0, 1.0))


def upward(orientation: Array) -> Array:
    """z component of the base's own z axis: 1 upright, negative past a tilt of 90 degrees."""
    x, y = orientation[..., 1], orientation[..., 2]
    return 1.0 - 2.0 * (x * x + y * y)


def to_heading(vectors: Array, orientation: Array) -> Array:
    """World-frame vectors (..., n, 3) in the frame turned by the base's yaw about z."""
    xp = array_namespace(vectors)
    w, x, y, z = (orientation[..., i] for i in range(4))
    yaw = xp.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))[..., None]
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    return xp.stack(
        [
            cos * vectors[..., 0] + sin * vectors[..., 1],
            -sin * vectors[..., 0] + cos * vectors[..., 1],
            vectors[..., 2],
        ],
        axis=-1,
    )


def _laikago(name: str, gait: Gait, distance: float) -> Laikago:
    """The horizon is what the gait's top speed needs for the distance."""
    if not gait.base_speed * PLAN_TIMESTEP <= distance < 1e3:
        raise ValueError("the distance must lie between one plan step and 1000 m")
    horizon = round(distance / gait.base_speed / CONTROL_TIMESTEP)
    return Laikago(name=name, gait=gait, distance=float(distance), horizon=horizon)


@register("laikago_walk")
def laikago_walk(distance: float = 1.584) -> Laikago:
    return _laikago("laikago_walk", WALK, distance)


@register("laikago_trot")
def laikago_trot(distance: float = 3.78) -> Laikago:
    return _laikago("laikago_trot", TROT, distance)
