"""Laikago: walk or trot straight to a goal with a given footfall pattern.

World frame: x forward, y left, z up, in metres; the ground is z = 0. Legs in the order FR, FL, RR,
RL; joints of a leg in the order abduction, thigh, calf. Quaternions are (w, x, y, z).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
import scipy  # loads `scipy.interpolate` when it is used

from tsbench.core.arrays import Array, array_namespace, filled, like, norm
from tsbench.core.constants import constant
from tsbench.core.drawing import Drawing
from tsbench.core.motion import Audit, AuditItem, Plan, ReferenceMotion
from tsbench.core.roadmap import Lattice, Move, RoadmapSpace
from tsbench.core.rotations import angle_between, multiply, to_heading, upward
from tsbench.core.state import Course, Readings, Rng, Start, State
from tsbench.core.task import Abstraction, Plannable, Tracker
from tsbench.planning.gait import Gait
from tsbench.planning.ik import FootPoses
from tsbench.sim.model import compiled, load_spec
from tsbench.sim.tracking import deepmimic_reward
from tsbench.tasks import register

FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
# Cycles of the gait before which an arrival has not shown it (D). They decide which episodes are
# solved, and no reward. They are none of `Task.constants`, whose hash the kept entries have, so
# another number needs another version of the tasks.
LEAST_CYCLES = 2


@dataclass(frozen=True)
class Constants:
    """The constants that decide a score, besides the gait, the goal and the MJCF."""

    control_timestep: float = constant(1 / 30, "s", "P", "between actions")
    horizon: int = constant(180, "", "D", "control steps at the standard distance: 6 s")
    substeps: int = constant(20, "", "P", "physics steps in a control step: 600 Hz")
    nominal: tuple[float, ...] = constant((0.0, 0.67, -1.33) * 4, "rad", "D", "pose of action zero")
    residual: float = constant(0.75, "rad", "D", "joint targets off the nominal pose by action 1")
    # Coefficients of scipy.signal.butter(2, 4.0, fs=30.0), which a test compares.
    filter_b: tuple[float, float, float] = constant(
        (0.108447438890226, 0.216894877780452, 0.108447438890226), "", "PD",
        "second-order Butterworth low-pass of actions at 4 Hz, numerator",
    )  # fmt: skip
    filter_a: tuple[float, float] = constant(
        (-0.8772706323073945, 0.31106038786829865), "", "PD", "the same, denominator after 1"
    )
    distance_decay: float = constant(-2.5, "1/m", "P", "of r_dist")
    slip_decay: float = constant(-10.0, "1/m", "P", "of r_ns")
    height_decay: float = constant(-20.0, "1/m", "P", "of r_ee_z")
    motion_decay: float = constant(-4.0, "1/m", "P", "of r_ee_x")
    swing_height: float = constant(0.10, "m", "P", "of a sole in swing")
    foot_radius: float = constant(0.0265, "m", "D", "of the sphere whose lowest point is the sole")
    fall_height: float = constant(0.32, "m", "P", "of the centre of mass; lower is a fall")
    goal_tolerance: float = constant(0.10, "m", "D", "from the goal that count as there")
    sole_height: float = constant(0.01, "m", "D", "below which a sole counts as on the ground")
    success_agreement: float = constant(0.8, "", "D", "footfall agreement of a solved episode")
    start_angle: float = constant(0.05, "rad", "D", "spread of perturbed starts, joints and base")
    start_speed: float = constant(0.1, "m/s", "D", "the same of the base's velocity")
    start_spin: float = constant(0.2, "rad/s", "D", "the same of angular velocities")
    hips: tuple[tuple[float, float], ...] = constant(
        ((0.21935, -0.1245), (0.21935, 0.1245), (-0.21935, -0.1245), (-0.21935, 0.1245)), "m", "D",
        "where a straight leg hangs, in the base frame (models/laikago.xml)",
    )  # fmt: skip
    stand_height: float = constant(
        0.42, "m", "D", "of the base with the nominal pose's soles on the ground"
    )


C = Constants()
NOMINAL, HIPS = np.array(C.nominal), np.array(C.hips)

# Constants of the planning variant, on which no score depends.
COM_DECAY = -5.0  # 1/m, k_com, which the paper leaves out (D)
# s (D). The paper gives both 0.1 s and 60 steps. With steps of 0.1 s the reward prefers plans that
# move all feet forward at once every few steps and slide; at the control rate it prefers the gait
# (docs/calibration.md).
PLAN_TIMESTEP = 1 / 30
PLAN_REACH = 0.15  # m, how far a planned foot may be ahead of or behind its hip (D)
LATTICE_PARTS = 4  # of the base's largest step, at most (D)
LATTICE_NODES = 2_000_000  # in a layer, at most (D)
PLAN_SIGHT = 0.5  # m, beyond which the planner does not see how far the goal is (D)
SLOWING = 0.15  # share of the way to the goal in a step, of a reference that goes on after its plan
PLAN_HEIGHT = (0.40, 0.44)  # m, of a planned base: legs neither stretched nor folded (D)
JOINT_SPEED = 12.8  # rad/s, what the motors can do (facts A1)
GRAVITY = 9.81  # m/s^2, of the model (P)

# Duties, periods and phases are decided here; the speeds are the paper's.
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
class LaikagoCourse(Course):
    """The agreement of an episode's footfall with the schedule.

    Attributes:
        nearest: smallest distance to the goal so far in metres, shape (...,).
        stance: share of the feet in scheduled stance, summed over control steps, each step weighted
            by the metres that it gained, shape (...,).
        stance_kept: the same sum over those of these feet whose soles were on the ground.
        swing: share of the feet in scheduled swing, summed like `stance`.
        swing_kept: the same sum over those of these feet whose soles were above the ground.
    """

    nearest: Array
    stance: Array
    stance_kept: Array
    swing: Array
    swing_kept: Array


@dataclass(frozen=True)
class Laikago(Plannable[LaikagoState]):
    """Attributes:
    gait: the footfall pattern.
    distance: of the goal, straight ahead, from the start in metres.
    """

    name: str
    gait: Gait
    distance: float
    horizon: int
    version = 1
    timestep = C.control_timestep
    substeps = C.substeps
    observation_size = 43
    action_size = 12
    max_reward = 1.0
    imitation_forms = ("deepmimic",)
    tracked = MappingProxyType({"feet": (4, 3), "contacts": (4,), "com": (3,)})
    mishap = "a fall"
    measure_notes = MappingProxyType(
        {
            "footfall agreement": "1 for feet that stand and swing as scheduled, 0.5 for feet that "
            "are dragged; solved needs 0.8 over two cycles or more",
            "time to the goal, s": "of the episodes that arrived",
            "speed over the gait's bound": "1 is as fast as the plan may go",
            "gait": "1 for feet that stand still, swing at 10 cm and move little; the reward "
            "without its distance",
            "cost of transport": "work of the motors over weight and distance",
        }
    )
    pushed = "trunk"
    push_plane = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))

    def constants(self) -> dict[str, Any]:
        return {**asdict(self), "max_reward": self.max_reward, **asdict(C)}

    # The MDP

    def observation(self, state: LaikagoState) -> Array:
        """Joint angles (12) and velocities (12); position (3), orientation (4), velocity (3) and
        angular velocity (3) of the base; clock (3); offset (2) and distance (1) of the goal."""
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
                self.clock(state),
                self.goal_offset(state),
                self.goal_distance(state)[..., None],
            ],
            axis=-1,
        )

    def clock(self, state: LaikagoState) -> Array:
        """Share of the episode, and the gait's cycle as sine and cosine; shape (..., 3)."""
        xp = array_namespace(state.time)
        cycle = 2.0 * math.pi / self.gait.period * state.time
        share = state.time / (self.horizon * self.timestep)
        return xp.stack([share, xp.sin(cycle), xp.cos(cycle)], axis=-1)

    def goal_offset(self, state: LaikagoState) -> Array:
        """From the base to the goal, on the ground plane, in metres, shape (..., 2)."""
        return like(state.base_position, (self.distance, 0.0)) - state.base_position[..., :2]

    def goal_distance(self, state: LaikagoState) -> Array:
        """Of the base, on the ground plane, in metres, shape (...,)."""
        return norm(self.goal_offset(state))

    def reward_terms(
        self, previous: LaikagoState, action: Array | None, state: LaikagoState
    ) -> dict[str, Array]:
        """r_dist, r_ns, r_ee_z and r_ee_x, each of shape (...,). Their product is the reward (P).

        r_dist = exp(-2.5 |x - goal|), on the ground plane.
        r_ns = exp(-10 sum c |e - e_prev|), horizontal, over feet in stance before and after.
        r_ee_z = exp(-20 sum |z - zbar|), z at the sole, zbar 0 in stance and 0.10 m in swing.
        r_ee_x = exp(-4 sum |x - x_prev|), over all feet in the world frame.
        """
        xp = array_namespace(state.feet)
        contacts = self.gait.contacts(state.time)
        stance = contacts & self.gait.contacts(previous.time)
        moved = state.feet - previous.feet
        slip = xp.where(stance, norm(moved[..., :2]), 0.0)
        height_error = state.feet[..., 2] - C.foot_radius - xp.where(contacts, 0.0, C.swing_height)
        return {
            "near the goal": xp.exp(C.distance_decay * self.goal_distance(state)),
            "feet do not slip": xp.exp(C.slip_decay * xp.sum(slip, axis=-1)),
            "feet at their height": xp.exp(C.height_decay * xp.sum(xp.abs(height_error), axis=-1)),
            "feet move little": xp.exp(C.motion_decay * xp.sum(xp.abs(moved[..., 0]), axis=-1)),
        }

    def reward(self, previous: LaikagoState, action: Array, state: LaikagoState) -> Array:
        """The product of its terms (P)."""
        distance, no_slip, height, motion = self.reward_terms(previous, action, state).values()
        return distance * no_slip * height * motion

    def fallen(self, state: LaikagoState) -> Array:
        """The centre of mass is below 0.32 m (P)."""
        return state.com[..., 2] < C.fall_height

    def violated(self, state: LaikagoState) -> Array:
        """A fall."""
        return self.fallen(state)

    def reached(self, state: LaikagoState) -> Array:
        """Within 10 cm of the goal, on the ground plane."""
        return self.goal_distance(state) < C.goal_tolerance

    def terminal(self, state: LaikagoState) -> Array:
        """At the goal, farther from it than at the start, or fallen (P)."""
        strayed = self.goal_distance(state) > self.distance + C.goal_tolerance
        return self.reached(state) | strayed | self.fallen(state)

    def begun(self, state: LaikagoState) -> LaikagoCourse:
        still = 0.0 * state.time
        return LaikagoCourse(
            violated=self.violated(state) & False,
            nearest=self.goal_distance(state),
            stance=still,
            stance_kept=still,
            swing=still,
            swing_kept=still,
        )

    def followed(
        self, course: Course, previous: LaikagoState, state: LaikagoState
    ) -> LaikagoCourse:
        assert isinstance(course, LaikagoCourse)
        xp = array_namespace(state.feet)
        nearest = xp.minimum(course.nearest, self.goal_distance(state))
        gained = course.nearest - nearest
        scheduled = self.gait.contacts(state.time)
        down = state.feet[..., 2] - C.foot_radius < C.sole_height
        # Shares of all feet: multiples of a quarter, so that sums and differences are exact.
        marks = xp.stack([scheduled, down, scheduled & down])
        stand, touch, both = xp.sum(xp.astype(marks, gained.dtype), axis=-1) / len(FEET)
        return LaikagoCourse(
            violated=course.violated | self.violated(state),
            nearest=nearest,
            stance=course.stance + gained * stand,
            stance_kept=course.stance_kept + gained * both,
            swing=course.swing + gained * (1.0 - stand),
            swing_kept=course.swing_kept + gained * (1.0 - (stand + touch - both)),
        )

    def footfall(self, course: Course) -> Array:
        """Footfall agreement in [0, 1], shape (...,).

        The share of stance samples with the sole below 1 cm, and of swing samples with it above,
        over feet and control steps; each step is weighted by how much it lowered the smallest
        distance to the goal so far, so that stepping on the spot does not hide a dash. The
        agreement is the mean of both: 0.5 for feet that are dragged, or never put down. The half
        in which no ground was gained counts as 0.
        """
        assert isinstance(course, LaikagoCourse)
        xp = array_namespace(course.nearest)
        tiny = 1e-9
        stance = xp.where(course.stance > tiny, course.stance_kept, 0.0)
        swing = xp.where(course.swing > tiny, course.swing_kept, 0.0)
        return 0.5 * (
            stance / xp.clip(course.stance, tiny, None) + swing / xp.clip(course.swing, tiny, None)
        )

    def quality(self, course: Course) -> Array:
        """clip(2 x footfall agreement - 1, 0, 1): arriving with the right footfall beats stepping
        in place just outside the goal, and no other gait is paid for arriving."""
        agreement = self.footfall(course)
        return array_namespace(agreement).clip(2.0 * agreement - 1.0, 0.0, 1.0)

    def success(self, state: LaikagoState, course: Course) -> Array:
        """The episode ended at its goal without a fall, the footfall on the way agrees with the
        schedule by at least 0.8, and the way took two cycles of the gait or more.

        A gait is what repeats. A single lunge to the goal may have its feet where half a cycle
        wants them: `monolithic` learned one that covers the walk's 1.25 m in 0.7 s. A goal so near
        that the planner's top speed needs less than two cycles asks for the time that it needs.
        """
        kept = self.footfall(course) >= C.success_agreement
        shortest = (self.distance - C.goal_tolerance) / self.gait.base_speed
        repeated = state.time > min(LEAST_CYCLES * self.gait.period, shortest) - 0.5 * self.timestep
        return self.reached(state) & ~course.violated & kept & repeated

    # Measures

    def measured(
        self, previous: LaikagoState, action: Array | None, state: LaikagoState
    ) -> dict[str, Array]:
        _, no_slip, height, motion = self.reward_terms(previous, action, state).values()
        sums = {"gait": no_slip * height * motion}
        return sums if action is None else {**sums, "work": self.work(previous, action)}

    def work(self, state: LaikagoState, action: Array) -> Array:
        """Joules that the motors turn over in the control step that begins in `state`: the sum of
        |torque x joint speed| over joints, times the control step, shape (...,).

        An approximation: the torques are those of the PD law at the instant of control, cut at the
        motors' limits, with the gains of the unchanged model. Summed at each of the 20 physics
        steps it was a third more for a trot, half more for a walk: the peaks lie in between.
        """
        xp = array_namespace(state.joint_position)
        target, _ = self.control(state, action)
        gain, damping, limit = (like(state.joint_position, one) for one in motors())
        torque = gain * (target - state.joint_position) - damping * state.joint_velocity
        torque = xp.clip(torque, -limit, limit)
        return self.timestep * xp.sum(xp.abs(torque * state.joint_velocity), axis=-1)

    def measures(
        self,
        first: LaikagoState,
        last: LaikagoState,
        course: Course,
        sums: Mapping[str, Array],
        steps: Array,
    ) -> dict[str, Array]:
        """Footfall, time, speed, gait and cost of episodes.

        footfall agreement: `footfall` of the course.
        time to the goal, s: from the start; only for episodes that arrived without a violation.
        speed over the gait's bound: mean speed along the straight line from the first position to
            the last, over the planner's top speed.
        gait: mean of r_ns r_ee_z r_ee_x, which is the reward without its factor of distance.
        cost of transport: `work` over weight times the length of that line; only for lines longer
            than the radius of the goal.
        """
        xp = array_namespace(last.base_position)
        seconds = steps * self.timestep
        gone = norm((last.base_position - first.base_position)[..., :2])
        arrived = self.reached(last) & ~course.violated
        found = {
            "footfall agreement": self.footfall(course),
            "time to the goal, s": xp.where(arrived, seconds, math.nan),
            "speed over the gait's bound": gone / seconds / self.gait.base_speed,
            "gait": sums["gait"] / steps,
        }
        if "work" in sums:
            weight = float(compiled("laikago").body_subtreemass[0]) * GRAVITY
            far = gone > C.goal_tolerance
            cost = sums["work"] / (weight * xp.where(far, gone, 1.0))
            found["cost of transport"] = xp.where(far, cost, math.nan)
        return found

    # The physics

    def spec(self) -> mujoco.MjSpec:
        spec = load_spec("laikago")
        spec.worldbody.add_site(
            name="goal",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=[self.distance, 0.0, 0.002],
            size=[C.goal_tolerance, 0.002, 0.0],
            rgba=[0.95, 0.75, 0.1, 1.0],
        )
        return spec

    def drawing(self) -> Drawing:
        return Drawing(feet=FEET, contacts=self.gait.contacts)

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """Standing at the origin in the nominal pose, at rest (P fixed, D pose).

        Perturbed, all uniform: joints and the base's orientation per axis within `start_angle`,
        the base's velocity within `start_speed`, angular velocities within `start_spin`. The base
        is raised by the most that tilt, hips and knees can lower a sole. A leg's abduction, which
        is left out, may put its sole into the ground, by less than 2 mm. Else the robot drops by
        some millimetres.
        """
        qpos = np.tile(compiled("laikago").key("home").qpos, (count, 1))
        qvel = np.zeros((count, 18))
        if perturbed:
            qpos, qvel = self.perturb(rng, qpos, qvel)
        return Start(np.zeros(count), qpos, qvel, filter_memory(qpos[:, 7:]))

    @staticmethod
    def perturb(
        rng: Rng, qpos: np.ndarray, qvel: np.ndarray, scale: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Poses (n, 19) and velocities (n, 18) with the spread of perturbed starts, scaled."""

        def uniform(bound: float, size: int) -> np.ndarray:
            return rng.uniform(-bound * scale, bound * scale, (len(qpos), size))

        qpos, qvel = qpos.copy(), qvel.copy()
        turn = uniform(C.start_angle, 3)
        joints = uniform(C.start_angle, 12)
        qpos[:, 7:] += joints
        # Small turns about the three axes, as one rotation vector.
        angle = np.linalg.norm(turn, axis=-1, keepdims=True)
        axis = turn / np.maximum(angle, 1e-12)
        rotation = np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], axis=-1)
        qpos[:, 3:7] = multiply(rotation, qpos[:, 3:7])
        # A leg is 0.5 m long and its hip 0.25 m from the base: by these no sole sinks deeper.
        tilt = np.abs(turn[:, :2]) @ np.array([0.13, 0.22])
        bend = np.abs(joints.reshape(-1, 4, 3)[..., 1:]).max(axis=1) @ np.array([0.01, 0.16])
        qpos[:, 2] += tilt + bend
        qvel[:, :3] += uniform(C.start_speed, 3)
        qvel[:, 3:6] += uniform(C.start_spin, 3)
        qvel[:, 6:] += uniform(C.start_spin, 12)
        return qpos, qvel

    def control(self, state: LaikagoState, action: Array) -> tuple[Array, Array]:
        """Joint targets in rad (..., 12): the nominal pose plus the low-passed residual."""
        xp = array_namespace(action)
        residual = C.residual * xp.clip(action, -1.0, 1.0)
        x1, x2, y1, y2 = (state.filter[..., 12 * i : 12 * (i + 1)] for i in range(4))
        filtered = (
            C.filter_b[0] * residual + C.filter_b[1] * x1 + C.filter_b[2] * x2
            - C.filter_a[0] * y1 - C.filter_a[1] * y2
        )  # fmt: skip
        memory = xp.concat([residual, x1, filtered, y1], axis=-1)
        return like(filtered, NOMINAL) + filtered, memory

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
        """The base moves straight to the goal at top speed. Feet rest in stance and move at
        constant speed in swing."""
        steps = np.arange(self.horizon + 1)
        time = steps * self.timestep
        base_x = np.minimum(self.gait.base_speed * time, self.distance)
        base = np.stack([base_x, 0.0 * base_x, C.stand_height + 0.0 * base_x], axis=-1)
        phase = self.gait.phase(time)
        stance = phase / self.gait.duty
        swing = (phase - self.gait.duty) / (1.0 - self.gait.duty)
        half_step = self.gait.base_speed * self.gait.duty * self.gait.period / 2
        ahead = half_step * np.where(phase <= self.gait.duty, 1.0 - 2.0 * stance, 2.0 * swing - 1.0)
        return self.kinematic(time, base, base[:, :1] + HIPS[:, 0] + ahead)

    def kinematic(self, time: Array, base: Array, feet_x: Array) -> LaikagoState:
        """The state of a level base (..., 3) over feet at the schedule's heights, at `feet_x`
        (..., 4) and in y under their hips; at rest."""
        xp = array_namespace(base)
        hips = like(base, HIPS)
        feet = xp.stack(
            [
                feet_x,
                base[..., 1:2] + hips[:, 1],
                C.foot_radius + xp.where(self.gait.contacts(time), 0.0, C.swing_height),
            ],
            axis=-1,
        )
        zeros = filled(base, (*base.shape[:-1], 12))
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

    # The variants

    def abstraction(self) -> LaikagoAbstraction:
        return LaikagoAbstraction(self)

    def reference(self, plan: Plan) -> ReferenceMotion:
        """The plan at the control rate, its feet standing still in stance, swinging in half sines.

        No leg can rise 10 cm at once as the plan's feet do. A stance foot stands at the mean of
        its planned positions; `audit` tells how far the plan moved it. A plan that ends before the
        horizon goes on to the goal and steps in place there: a robot that misses the goal has
        something to follow.
        """
        steps = self.horizon
        times = np.arange(steps + 1) * self.timestep
        plan = self._continued(plan)
        base = scipy.interpolate.PchipInterpolator(plan.times, plan.states[:, :3])(times)
        qpos = poses(base, self._feet(plan, times))
        model = compiled("laikago")
        data = mujoco.MjData(model)
        qvel = np.zeros((len(times), model.nv))
        feet, com = np.zeros((len(times), 4, 3)), np.zeros((len(times), 3))
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
            tracked={"feet": feet, "contacts": self.gait.contacts(times), "com": com},
        )

    def _continued(self, plan: Plan) -> Plan:
        """The plan, gone on with to the horizon: the base slows down towards the goal, and a foot
        that comes down does so under its hip there."""
        states = [plan.states[-1]]
        goal = np.array([self.distance, 0.0, states[0][2]])
        feet = np.concatenate([goal[:2] + HIPS, np.full((4, 1), C.foot_radius)], axis=1)
        stood = np.ones(4, bool)  # since the plan's end
        most = self.gait.base_speed * plan.timestep
        for step in range(
            len(plan.states), round(self.horizon * self.timestep / plan.timestep) + 1
        ):
            left = goal - states[-1][:3]
            move = left * min(1.0, SLOWING, most / max(float(np.linalg.norm(left)), 1e-9))
            stood &= self.gait.contacts(np.array((step - 1) * plan.timestep))
            before = states[-1][3:].reshape(4, 3)
            states.append(
                np.concatenate(
                    [states[-1][:3] + move, np.where(stood[:, None], before, feet).ravel()]
                )
            )
        rewards = np.concatenate([plan.rewards, np.zeros(len(states) - 1)])
        return replace(plan, states=np.stack([*plan.states, *states[1:]]), rewards=rewards)

    def _feet(self, plan: Plan, times: np.ndarray) -> np.ndarray:
        """Foot centres (n, 4, 3) at `times` after those of the plan."""
        planned = plan.states[:, 3:].reshape(-1, 4, 3)[..., :2]
        feet = self.gait.swung(plan.times, planned, times, C.swing_height)
        feet[..., 2] += C.foot_radius
        return feet

    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        model = compiled("laikago")
        joints = reference.qpos[:, 7:]
        low, high = model.jnt_range[1:].T
        outside = float(np.maximum(low - joints, joints - high).max())
        speed = float(np.abs(reference.qvel[:, 6:]).max())
        planned = plan.states[:, 3:].reshape(-1, 4, 3)
        feet, scheduled = reference.tracked["feet"], reference.tracked["contacts"]
        whole = self._continued(plan)
        standing = self._feet(whole, plan.times)
        contacts = self.gait.contacts(plan.times)
        slips = np.linalg.norm((planned - standing)[..., :2], axis=-1).sum(axis=0, where=contacts)
        slip = slips / np.maximum(contacts.sum(axis=0), 1)  # a foot may never stand
        residual = np.linalg.norm(feet - self._feet(whole, reference.times), axis=-1).max()
        lift = (feet[..., 2] - C.foot_radius).max(axis=0)
        weight = scheduled[..., None].astype(float)
        support = (weight * feet[..., :2]).sum(1) / np.maximum(weight.sum(1), 1.0)
        balance = np.linalg.norm(reference.tracked["com"][:, :2] - support, axis=-1)
        final = float(np.hypot(self.distance - plan.states[-1, 0], plan.states[-1, 1]))
        return Audit(
            (
                AuditItem(
                    "distance of the plan's end from the goal",
                    final, C.goal_tolerance, "m",
                ),
                AuditItem("joint angle beyond its limit", max(outside, 0.0), 1e-6, "rad"),
                AuditItem("joint speed", speed, JOINT_SPEED, "rad/s"),
                AuditItem("inverse kinematics error", float(residual), 2e-3, "m"),
                AuditItem("mean slip of a foot in stance", float(slip.max()), 0.02, "m"),
                AuditItem(
                    "missing swing clearance",
                    max(0.0, C.swing_height / 2 - float(lift.min())), 0.0, "m",
                ),
                AuditItem("mean distance of CoM from support", float(balance.mean()), 0.12, "m"),
            )
        )  # fmt: skip

    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> LaikagoTracker:
        self.imitation_form(form)
        return LaikagoTracker(self, reference)


class LaikagoAbstraction(Abstraction[LaikagoState]):
    """Base position and four feet; the base stays level, the feet under their hips in y.

    An action is the base's displacement (3, norm at most speed x time step) and each foot's
    forward displacement (4), whose angle about the hip is limited. Foot heights follow the
    contact schedule (P).
    """

    timestep = PLAN_TIMESTEP
    action_size = 7
    observation_size = 17
    coordinates = (
        *(f"base_{axis}" for axis in "xyz"),
        *(f"{foot}_{axis}" for foot in FEET for axis in "xyz"),
    )

    def __init__(self, task: Laikago) -> None:
        self.task = task
        self.gait = task.gait
        self.horizon = round(task.horizon * task.timestep / PLAN_TIMESTEP)
        self.base_step = self.gait.base_speed * PLAN_TIMESTEP  # m a plan step at most
        self.swing_step = self.gait.leg_length * self.gait.foot_speed * PLAN_TIMESTEP

    def start(self, count: int) -> LaikagoState:
        base = np.tile([0.0, 0.0, C.stand_height], (count, 1))
        return self.task.kinematic(np.zeros(count), base, np.tile(HIPS[:, 0], (count, 1)))

    def sample(self, rng: Rng, count: int) -> LaikagoState:
        time = rng.integers(0, self.horizon, count) * PLAN_TIMESTEP
        base = rng.uniform([0.8, -0.1, PLAN_HEIGHT[0]], [1.0, 0.1, PLAN_HEIGHT[1]], (count, 3))
        base[:, 0] *= self.gait.base_speed * time  # nearly as far as top speed allows by then
        ahead = rng.uniform(-PLAN_REACH / 2, PLAN_REACH / 2, (count, 4))
        return self.task.kinematic(time, base, base[:, :1] + HIPS[:, 0] + ahead)

    def advance(self, state: LaikagoState, action: Array) -> LaikagoState:
        xp = array_namespace(action)
        action = xp.clip(action, -1.0, 1.0)
        push, step = action[..., :3], action[..., 3:]
        push = push / xp.clip(norm(push)[..., None], 1.0, None)
        move, swing = self.base_step * push, self.swing_step
        ahead = self._ahead(state)
        # The action gives a foot's displacement in the world frame: zero leaves the foot in place.
        # A foot in stance is held, because far from the goal the reward does not punish slip. The
        # base goes no further than the legs reach, so a robot that does not step does not travel.
        after = state.time + PLAN_TIMESTEP
        held = self.gait.contacts(state.time) & self.gait.contacts(after)
        step = xp.where(held, 0.0, 2.0 * swing * step)
        least = xp.max(ahead + xp.clip(step, None, 0.0), axis=-1)[..., None] - PLAN_REACH
        most = xp.min(ahead + xp.clip(step, 0.0, None), axis=-1)[..., None] + PLAN_REACH
        forward = xp.clip(move[..., :1], least, most)
        ahead = xp.clip(ahead + xp.clip(step - forward, -swing, swing), -PLAN_REACH, PLAN_REACH)
        base = state.base_position + xp.concat([forward, move[..., 1:]], axis=-1)
        base = xp.concat([base[..., :2], xp.clip(base[..., 2:], *PLAN_HEIGHT)], axis=-1)
        feet_x = base[..., :1] + like(base, HIPS)[:, 0] + ahead
        return self.task.kinematic(state.time + PLAN_TIMESTEP, base, feet_x)

    @staticmethod
    def _ahead(state: LaikagoState) -> Array:
        """Metres by which each foot is ahead of its hip, shape (..., 4)."""
        hips = like(state.feet, HIPS)[:, 0]
        return state.feet[..., 0] - state.base_position[..., :1] - hips

    def naive(self, state: LaikagoState) -> Array:
        """Straight ahead at top speed. Stance feet rest. Swing feet move at the speed that the
        swing's share of the cycle requires, but in one planning step more, so they come to lead
        their hips, by at most `PLAN_REACH`."""
        xp = array_namespace(state.feet)
        gait, after = self.gait, state.time + PLAN_TIMESTEP
        stance = gait.contacts(state.time) & gait.contacts(after)
        speed = gait.base_speed / (1.0 - gait.duty)  # of a swing foot in the world
        step = xp.where(stance, 0.0, speed / (2.0 * gait.leg_length * gait.foot_speed))
        ahead = 1.0 + 0.0 * state.time[..., None]
        step = xp.astype(step, ahead.dtype)
        return xp.concat([ahead, 0.0 * ahead, 0.0 * ahead, step], axis=-1)

    def observation(self, state: LaikagoState) -> Array:
        """Beyond `PLAN_SIGHT` the distance of the goal is hidden. The reward is noticeable only
        near the goal; the hidden distance makes the gait learned there apply everywhere."""
        xp = array_namespace(state.base_position)
        distance = self.task.goal_distance(state)[..., None]
        contacts = [
            xp.astype(self.gait.contacts(state.time + delay), distance.dtype)
            for delay in (0.0, PLAN_TIMESTEP)
        ]
        return xp.concat(
            [
                self.task.goal_offset(state) * (PLAN_SIGHT / xp.clip(distance, PLAN_SIGHT, None)),
                state.base_position[..., 2:],
                self._ahead(state),
                self.task.clock(state)[..., 1:],
                *contacts,
            ],
            axis=-1,
        )

    def value_observation(self, state: LaikagoState) -> Array:
        xp = array_namespace(state.base_position)
        return xp.concat(
            [
                self.observation(state),
                self.task.goal_offset(state),
                self.task.goal_distance(state)[..., None],
                self.task.clock(state)[..., :1],
            ],
            axis=-1,
        )

    def dynamics_reward(self, state: LaikagoState) -> Array:
        """R_dyn = exp(k_com |C - P|), C the base, P the mean of the stance feet (P form)."""
        xp = array_namespace(state.feet)
        weight = xp.astype(self.gait.contacts(state.time), state.feet.dtype)[..., None]
        support = xp.sum(weight * state.feet[..., :2], axis=-2) / xp.sum(weight, axis=-2)
        offset = state.base_position[..., :2] - support
        return xp.exp(COM_DECAY * norm(offset))

    def flatten(self, state: LaikagoState) -> Array:
        xp = array_namespace(state.feet)
        feet = xp.reshape(state.feet, (*state.feet.shape[:-2], 12))
        return xp.concat([state.base_position, feet], axis=-1)

    def poses(self, coordinates: np.ndarray) -> np.ndarray:
        return poses(coordinates[:, :3], coordinates[:, 3:].reshape(-1, 4, 3))

    def roadmap_space(self) -> LaikagoSpace:
        return LaikagoSpace(self)

    def lattice(self) -> LaikagoLattice:
        return LaikagoLattice(self)


class LaikagoSpace(RoadmapSpace[LaikagoState]):
    """Base position (3), and how far each foot is ahead of its hip (4), in metres.

    It knows nothing of the gait (P). A plan that follows a way through it moves the feet as far as
    the planning variant lets it, which holds the feet in stance.
    """

    def __init__(self, abstraction: LaikagoAbstraction) -> None:
        reach, goal = np.full(4, PLAN_REACH), abstraction.task.distance
        beside = C.goal_tolerance / 2
        self.low = np.array([-beside, -beside, PLAN_HEIGHT[0], *-reach])
        self.high = np.array([goal + beside, beside, PLAN_HEIGHT[1], *reach])
        base, foot = abstraction.base_step, abstraction.swing_step
        self.scale = np.array([base] * 3 + [foot] * 4)
        self.start, self.goal = (
            np.array([x, 0.0, C.stand_height, *[0.0] * 4]) for x in (0.0, goal)
        )

    def free(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.ones(len(first), bool)  # the legs reach everywhere in the box

    def steps(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """The base's speed is limited in any direction, each foot's by itself."""
        moved = np.abs(second - first) / self.scale
        base = np.linalg.norm(moved[..., :3], axis=-1)
        steps: np.ndarray = np.maximum(base, moved[..., 3:].max(axis=-1))
        return steps

    def action(self, state: LaikagoState, point: np.ndarray) -> np.ndarray:
        base = (point[:3] - state.base_position) / self.scale[:3]
        feet_x = point[0] + HIPS[:, 0] + point[3:]
        step = (feet_x - state.feet[..., 0]) / (2.0 * self.scale[3:])
        return np.clip(np.concatenate([base, step], axis=-1), -1.0, 1.0)

    def places(self, points: np.ndarray) -> np.ndarray:
        return points[:, :3]


class LaikagoLattice(Lattice):
    """How far feet are ahead of their hips, in parts of the base's largest step.

    Feet of the same phase move alike, so each phase of the gait is one axis. Stance feet are held,
    and the base goes straight ahead at its height.
    """

    def __init__(self, abstraction: LaikagoAbstraction) -> None:
        self.abstraction, self.gait = abstraction, abstraction.gait
        self.layers = round(self.gait.period / PLAN_TIMESTEP)
        phases, self.axis = np.unique(np.array(self.gait.phases), return_inverse=True)
        widest = math.floor((LATTICE_NODES ** (1.0 / len(phases)) - 1.0) / 2.0)
        parts = math.floor(widest * abstraction.base_step / PLAN_REACH)
        self.parts = min(max(parts, 1), LATTICE_PARTS)
        self.unit = abstraction.base_step / self.parts
        self.reach = min(math.floor(PLAN_REACH / self.unit), widest)
        self.shape = (2 * self.reach + 1,) * len(phases)
        self.start = (self.reach,) * len(phases)

    def moves(self, layer: int) -> list[Move]:
        abstraction, time = self.abstraction, np.array([layer * PLAN_TIMESTEP])
        state = abstraction.start(1).replace(time=time)
        held = self._of_axes(self.gait.contacts(time) & self.gait.contacts(time + PLAN_TIMESTEP))
        furthest = math.floor(abstraction.swing_step / self.unit + 1e-9)
        found = []
        for forward in range(self.parts + 1):
            swing = range(-forward, furthest + 1)  # a foot in swing never goes backwards
            for shift in itertools.product(*([-forward] if h else swing for h in held)):
                step = self.unit * (np.array(shift)[self.axis] + forward)
                base = [forward / self.parts, 0.0, 0.0]
                action = np.concatenate([base, step / (2.0 * abstraction.swing_step)])
                following = abstraction.advance(state, action[None])
                reward = float(abstraction.task.reward(state, action, following)[0])
                growth = math.exp(-C.distance_decay * self.unit * forward)
                found.append(Move(shift, action, reward, growth))
        return found

    def worth(self, layer: int) -> np.ndarray:
        time = np.array([layer * PLAN_TIMESTEP])
        # Feet in swing bear nothing, so the worth is the same wherever they are.
        bears = self._of_axes(self.gait.contacts(time))
        shape = [n if b else 1 for n, b in zip(self.shape, bears, strict=True)]
        nodes = np.indices(shape).reshape(len(shape), -1).T
        base = np.tile([0.0, 0.0, C.stand_height], (len(nodes), 1))
        feet_x = self.unit * (nodes - self.reach)[:, self.axis] + HIPS[:, 0]
        state = self.abstraction.task.kinematic(np.repeat(time, len(nodes)), base, feet_x)
        worth = self.abstraction.dynamics_reward(state)
        return np.broadcast_to(worth.reshape(shape), self.shape)

    def _of_axes(self, feet: np.ndarray) -> list[bool]:
        """What holds of the feet of each axis, for feet (1, 4)."""
        return [bool(feet[0, self.axis == axis].any()) for axis in range(len(self.shape))]


class LaikagoTracker(Tracker[LaikagoState]):
    """DeepMimic's reward (P by reference), its reference-state initialisation, and an early ending
    at a fall.

    Pose: twelve joints and the base's orientation. End effectors: relative to the base, in its
    heading frame. Frame k belongs to control step k.
    """

    max_reward = 1.0

    def __init__(self, task: Laikago, reference: ReferenceMotion) -> None:
        self.task = task
        self.reference = reference
        self.horizon = reference.steps
        orientation = reference.qpos[:, 3:7]
        feet = reference.tracked["feet"] - reference.qpos[:, None, :3]
        self._joints, self._orientation = reference.qpos[:, 7:], orientation
        self._velocity = reference.qvel[:, 6:]
        self._feet, self._com = to_heading(feet, orientation), reference.tracked["com"]

    def reward(self, previous: LaikagoState, action: Array, state: LaikagoState) -> Array:
        xp = array_namespace(state.joint_position)
        frame = self.reference.frame(state.time)

        def wanted(frames: np.ndarray) -> Array:
            return like(state.joint_position, frames)[frame]

        turn = angle_between(state.base_orientation, wanted(self._orientation))
        joints = state.joint_position - wanted(self._joints)
        feet = to_heading(state.feet - state.base_position[..., None, :], state.base_orientation)
        return deepmimic_reward(
            pose=xp.concat([joints, turn[..., None]], axis=-1),
            velocity=state.joint_velocity - wanted(self._velocity),
            end_effectors=feet - wanted(self._feet),
            com=state.com - wanted(self._com),
        )

    def terminal(self, state: LaikagoState) -> Array:
        tilted = upward(state.base_orientation) < 0.0
        return self.task.fallen(state) | tilted

    def start(self, rng: Rng, count: int) -> Start:
        reference = self.reference
        frames = rng.integers(0, reference.steps, count)
        qpos, qvel = self.task.perturb(
            rng, reference.qpos[frames], reference.qvel[frames], scale=0.5
        )
        standing = self.task.start(rng, count, perturbed=True)
        first = rng.uniform(size=count) < 0.25  # the starts of evaluation, trained more often
        qpos[first], qvel[first] = standing.qpos[first], standing.qvel[first]
        time = np.where(first, 0.0, frames * reference.timestep)
        return Start(time, qpos, qvel, filter_memory(qpos[:, 7:]))


def poses(base: np.ndarray, feet: np.ndarray) -> np.ndarray:
    """Generalised positions (k, 19) for level bases (k, 3) and foot centres (k, 4, 3)."""
    model = compiled("laikago")
    solver = FootPoses(model, FEET, model.key("home").qpos)
    solutions = [
        solver.solve(np.concatenate([position, [1.0, 0.0, 0.0, 0.0]]), targets)
        for position, targets in zip(base, feet, strict=True)
    ]
    return np.array([pose for pose, _ in solutions])


@cache
def motors() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each joint's motor: N m/rad, N m s/rad, and at most N m, each of shape (12,)."""
    model = compiled("laikago")
    return (
        model.actuator_gainprm[:, 0].copy(),
        -model.actuator_biasprm[:, 2],
        model.actuator_forcerange[:, 1].copy(),
    )


def filter_memory(joints: np.ndarray) -> np.ndarray:
    """The settled filter memory (n, 48) of a robot that stands with joint angles (n, 12)."""
    return np.tile(joints - NOMINAL, 4)


def _laikago(name: str, gait: Gait, distance: float, standard: float) -> Laikago:
    """At the standard distance, 0.8 of what the gait's top speed goes in it, the horizon is 6 s; at
    others it is in proportion."""
    if not C.goal_tolerance < distance < 1e3:
        raise ValueError(f"the distance must lie between {C.goal_tolerance} and 1000 m")
    horizon = round(distance / standard * C.horizon)
    return Laikago(name=name, gait=gait, distance=float(distance), horizon=horizon)


@register("laikago_walk")
def laikago_walk(distance: float = 1.25) -> Laikago:
    return _laikago("laikago_walk", WALK, distance, standard=1.25)


@register("laikago_trot")
def laikago_trot(distance: float = 3.0) -> Laikago:
    return _laikago("laikago_trot", TROT, distance, standard=3.0)
