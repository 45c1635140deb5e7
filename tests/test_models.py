"""The compiled models against the published figures.

The two tables below are a second copy of those figures, made from the sources and not from the
MJCF, so that an error in either is found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tsbench.sim.model import compiled, load_spec

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Link:
    """One link of the left front leg, in the link's own frame (m, kg, kg m^2)."""

    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]  # xx yy zz xy xz yz, about the CoM
    origin: tuple[float, float, float]  # of its joint, in the parent's frame


# unitree_ros, robots/laikago_description/xacro: const.xacro, and leg.xacro for the mirror rule.
TRUNK = Link(
    13.733,
    (0.002284, -0.000041, 0.025165),
    (0.073348887, 0.250684593, 0.254469458, 0.00030338, 0.001918218, -0.000075402),
    (0.0, 0.0, 0.0),
)
LEFT_FRONT = {
    "hip": Link(
        1.096,
        (-0.001568, -0.008134, 0.000864),
        (0.000822113, 0.000983196, 0.000864753, -4.982e-6, -3.672e-5, 2.811e-6),
        (0.21935, 0.0875, 0.0),
    ),
    "thigh": Link(
        1.528,
        (-0.000482, 0.02001, -0.031996),
        (0.00991611, 0.009280083, 0.00178256, 1.0388e-5, 2.50428e-4, -8.511e-5),
        (0.0, 0.037, 0.0),
    ),
    "calf": Link(
        0.241,
        (-0.002196, -0.000381, -0.12338),
        (0.006181961, 0.006196546, 3.4774e-5, 2.37e-7, -2.985e-6, 5.138e-6),
        (0.0, 0.0, -0.25),
    ),
    "foot": Link(0.06, (0.0, 0.0, 0.0), (1.6854e-5,) * 3 + (0.0,) * 3, (0.0, 0.0, -0.25)),
}
LEGS = {"FR": (1, -1), "FL": (1, 1), "RR": (-1, -1), "RL": (-1, 1)}  # sign of x, sign of y
JOINTS = ("hip", "thigh", "calf")
AXES = {"hip": (1.0, 0.0, 0.0), "thigh": (0.0, 1.0, 0.0), "calf": (0.0, 1.0, 0.0)}
RANGES_LEFT = {"hip": (-50.0, 60.0), "thigh": (-30.0, 225.0), "calf": (-159.0, -35.0)}  # degrees
TORQUES = {"hip": 18.954, "thigh": 40.0, "calf": 40.0}  # N m
VELOCITY_GAINS = {"hip": 0.3, "thigh": 2.0, "calf": 2.0}  # N m s/rad, motion_imitation
POSITION_GAIN = 220.0  # N m/rad, motion_imitation
TOTAL_MASS = 25.433  # kg, without the 1 g imu
SOLE = 0.0265  # m, the foot's radius
TRUNK_BOX = (0.5616, 0.172, 0.1875)  # m, length, width, height
TRUNK_BOX_HEIGHT = 0.01675  # m, of its centre in the trunk's frame
NOMINAL = (0.0, 0.67, -1.33)  # rad, a leg of the home pose

# The paper (gravity, drag, thrust); LunarLander's outline; tsbench's mass and inertia.
ROCKET_MASS = 5.0
ROCKET_INERTIA = 0.8
ROCKET_GRAVITY = 2.5
ROCKET_DRAG = 2.5
ROCKET_LEVER = 0.365
ROCKET_TIMESTEP = 0.02
LANDER_PIXELS = ((-14, 17), (-17, 0), (-17, -10), (17, -10), (17, 0), (14, 17))
PIXELS_PER_METRE = 30.0


def published(leg: str, name: str) -> Link:
    """The figures of one link of any leg, by the mirror rule of leg.xacro.

    Right legs: y of the CoM, ixy and iyz of hip and thigh change sign, and so do all lateral
    joint origins. Rear legs: x of the hip's CoM, ixy and ixz of the hip change sign, and so does
    the hip's longitudinal joint origin. Calf and foot are the same on all legs.
    """
    link = LEFT_FRONT[name]
    front, left = LEGS[leg]
    x = front if name == "hip" else 1
    y = left if name in ("hip", "thigh") else 1
    xx, yy, zz, xy, xz, yz = link.inertia
    return Link(
        link.mass,
        (x * link.com[0], y * link.com[1], link.com[2]),
        (xx, yy, zz, x * y * xy, x * xz, y * yz),
        (x * link.origin[0], y * link.origin[1], link.origin[2]),
    )


def full_inertia(model: Any, body: int) -> Array:
    """The inertia (3, 3) about the body's CoM along the body's axes, from the principal form."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    matrix = rotation.reshape(3, 3)
    inertia: Array = matrix @ np.diag(model.body_inertia[body]) @ matrix.T
    return inertia


def symmetric(six: tuple[float, float, float, float, float, float]) -> Array:
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def home() -> tuple[Any, Any]:
    """The Laikago and a state of its own, in the home pose."""
    model = compiled("laikago")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return model, data


def foot_in_trunk(leg: str, angles: Array) -> Array:
    """Closed-form position (3,) of a foot's centre in the trunk's frame, angles (3,) in rad."""
    abduction, thigh, calf = angles
    front, left = LEGS[leg]
    forward = -0.25 * (np.sin(thigh) + np.sin(thigh + calf))
    down = 0.25 * (np.cos(thigh) + np.cos(thigh + calf))
    lateral = 0.037 * left
    return np.array(
        [
            0.21935 * front + forward,
            0.0875 * left + lateral * np.cos(abduction) + down * np.sin(abduction),
            lateral * np.sin(abduction) - down * np.cos(abduction),
        ]
    )


def check_link(model: Any, body: int, link: Link) -> None:
    assert model.body_mass[body] == link.mass
    np.testing.assert_array_equal(model.body_ipos[body], link.com)
    inertia = symmetric(link.inertia)
    # The principal form costs a few digits; the smallest published figure is 2.4e-7.
    np.testing.assert_allclose(full_inertia(model, body), inertia, rtol=0, atol=1e-11)


def test_laikago_trunk() -> None:
    model = compiled("laikago")
    check_link(model, model.body("trunk").id, TRUNK)
    assert model.jnt("root").type[0] == mujoco.mjtJoint.mjJNT_FREE


@pytest.mark.parametrize("name", LEFT_FRONT)
@pytest.mark.parametrize("leg", LEGS)
def test_laikago_link(leg: str, name: str) -> None:
    model = compiled("laikago")
    body = model.body(f"{leg}_{name}")
    link = published(leg, name)
    check_link(model, body.id, link)
    np.testing.assert_array_equal(body.pos, link.origin)
    np.testing.assert_array_equal(body.quat, (1.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("name", JOINTS)
@pytest.mark.parametrize("leg", LEGS)
def test_laikago_joint_and_motor(leg: str, name: str) -> None:
    model = compiled("laikago")
    joint = model.jnt(f"{leg}_{name}_joint")
    low, high = np.radians(RANGES_LEFT[name])
    if name == "hip" and LEGS[leg][1] < 0:
        low, high = -high, -low
    np.testing.assert_array_equal(joint.axis, AXES[name])
    np.testing.assert_array_equal(joint.pos, np.zeros(3))
    np.testing.assert_allclose(joint.range, (low, high), rtol=0, atol=1e-6)
    assert model.jnt_limited[joint.id]
    assert joint.armature[0] == 0.01
    assert joint.damping[0] == 0.0
    assert joint.frictionloss[0] == 0.0

    motor = model.actuator(f"{leg}_{name}")
    assert motor.trnid[0] == joint.id
    assert motor.gear[0] == 1.0
    np.testing.assert_array_equal(motor.forcerange, (-TORQUES[name], TORQUES[name]))
    assert motor.gainprm[0] == POSITION_GAIN
    np.testing.assert_array_equal(motor.biasprm[:3], (0.0, -POSITION_GAIN, -VELOCITY_GAINS[name]))


def test_laikago_is_complete() -> None:
    """The model has exactly the expected links, joints, motors and sensors, in this order."""
    model = compiled("laikago")
    joints = [f"{leg}_{name}_joint" for leg in LEGS for name in JOINTS]
    assert [model.jnt(i).name for i in range(model.njnt)] == ["root", *joints]
    motors = [model.actuator(i).name for i in range(model.nu)]
    assert [f"{name}_joint" for name in motors] == joints
    sensors = [model.sensor(i).name for i in range(model.nsensor)]
    assert sensors == [*(f"{leg}_foot_position" for leg in LEGS), "com"]
    assert model.nbody == 2 + 4 * 4
    assert mujoco.mj_getTotalmass(model) == pytest.approx(TOTAL_MASS, abs=1e-12)


def test_laikago_world() -> None:
    model = compiled("laikago")
    assert model.opt.timestep == 1 / 600
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    np.testing.assert_array_equal(model.opt.gravity, (0.0, 0.0, -9.81))
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART


def test_laikago_touches_the_ground_only_with_feet_knees_and_trunk() -> None:
    model = compiled("laikago")
    touching = {
        model.geom(i).name: model.geom(i)
        for i in range(model.ngeom)
        if model.geom_contype[i] or model.geom_conaffinity[i]
    }
    feet = {f"{leg}_foot" for leg in LEGS}
    assert set(touching) == {"floor", "trunk", *feet, *(f"{leg}_knee" for leg in LEGS)}
    for name, geom in touching.items():
        # Types meet affinities: the floor meets the robot, the robot does not meet itself.
        assert (geom.contype[0], geom.conaffinity[0]) == ((1, 0) if name == "floor" else (0, 1))
        assert geom.friction[0] == 1.0
        assert geom.condim[0] == 3
        np.testing.assert_array_equal(geom.solref, (0.01, 1.0))
    for leg in LEGS:
        assert touching[f"{leg}_knee"].size[0] == 0.022
        np.testing.assert_array_equal(touching[f"{leg}_knee"].pos, np.zeros(3))
    for name in feet:
        assert touching[name].type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
        assert touching[name].size[0] == SOLE
        np.testing.assert_array_equal(touching[name].pos, np.zeros(3))
    np.testing.assert_array_equal(2.0 * touching["trunk"].size, TRUNK_BOX)
    np.testing.assert_array_equal(touching["trunk"].pos, (0.0, 0.0, TRUNK_BOX_HEIGHT))


ANGLES = st.tuples(*(st.floats(*np.radians(RANGES_LEFT[name])) for name in JOINTS))
QUATERNIONS = st.tuples(*(st.floats(-1.0, 1.0),) * 4).filter(lambda q: float(np.dot(q, q)) > 0.1)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*(ANGLES,) * 4), QUATERNIONS, st.tuples(*(st.floats(-5.0, 5.0),) * 3))
def test_laikago_forward_kinematics(
    legs: tuple[tuple[float, float, float], ...],
    quaternion: tuple[float, ...],
    position: tuple[float, ...],
) -> None:
    model = compiled("laikago")
    data = mujoco.MjData(model)
    data.qpos[:3] = position
    data.qpos[3:7] = np.array(quaternion) / np.linalg.norm(quaternion)
    data.qpos[7:] = np.ravel(legs)
    mujoco.mj_forward(model, data)
    rotation = data.body("trunk").xmat.reshape(3, 3)
    for leg, angles in zip(LEGS, legs, strict=True):
        expected = np.array(position) + rotation @ foot_in_trunk(leg, np.array(angles))
        for found in (data.sensor(f"{leg}_foot_position").data, data.geom(f"{leg}_foot").xpos):
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(ANGLES, ANGLES)
def test_laikago_legs_mirror_each_other(
    front: tuple[float, float, float], rear: tuple[float, float, float]
) -> None:
    """Left legs at some angles and right legs at the mirrored angles have mirrored masses.

    The calves are left out: the CoM of the published calf is 0.4 mm to the right on every leg.
    """
    model = compiled("laikago")
    data = mujoco.MjData(model)
    mirror = np.diag((1.0, -1.0, 1.0))
    for pair, angles in (("F", front), ("R", rear)):
        for side, sign in (("L", 1.0), ("R", -1.0)):
            for name, angle in zip(JOINTS, angles, strict=True):
                factor = sign if name == "hip" else 1.0
                data.joint(f"{pair}{side}_{name}_joint").qpos = factor * angle
    mujoco.mj_forward(model, data)
    for pair in "FR":
        for name in ("hip", "thigh", "foot"):
            left, right = (data.body(f"{pair}{side}_{name}") for side in "LR")
            np.testing.assert_allclose(right.xipos, mirror @ left.xipos, rtol=0, atol=1e-12)
            turned = []
            for body in (left, right):
                rotation = body.xmat.reshape(3, 3)
                turned.append(rotation @ full_inertia(model, body.id) @ rotation.T)
            np.testing.assert_allclose(turned[1], mirror @ turned[0] @ mirror, rtol=0, atol=1e-11)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=36, max_size=36))
def test_laikago_motor_law(numbers: list[float]) -> None:
    """Torque = kp (target - angle) - kv velocity, within the limits."""
    model = compiled("laikago")
    data = mujoco.MjData(model)
    target, angle, velocity = np.reshape(numbers, (3, 12))
    data.qpos[2] = 5.0
    data.qpos[7:], data.qvel[6:], data.ctrl[:] = angle, velocity, target
    mujoco.mj_forward(model, data)
    limit = np.array([TORQUES[name] for name in JOINTS] * 4)
    damping = np.array([VELOCITY_GAINS[name] for name in JOINTS] * 4)
    torque = np.clip(POSITION_GAIN * (target - angle) - damping * velocity, -limit, limit)
    np.testing.assert_allclose(data.qfrc_actuator[6:], torque, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(data.qfrc_actuator[:6], np.zeros(6))


def test_laikago_home_pose() -> None:
    model, data = home()
    np.testing.assert_array_equal(data.qpos[7:], NOMINAL * 4)
    np.testing.assert_array_equal(data.ctrl, NOMINAL * 4)
    np.testing.assert_array_equal(data.qpos[[0, 1, 3, 4, 5, 6]], (0, 0, 1, 0, 0, 0))
    for leg in LEGS:
        assert data.sensor(f"{leg}_foot_position").data[2] == pytest.approx(SOLE, abs=1e-9)
    bodies = np.array([data.body(f"{leg}_{name}").xipos for leg in LEGS for name in LEFT_FRONT])
    masses = np.array([link.mass for link in LEFT_FRONT.values()] * len(LEGS))
    trunk = data.qpos[:3] + np.array(TRUNK.com)
    com = (TRUNK.mass * trunk + masses @ bodies) / TOTAL_MASS
    np.testing.assert_allclose(data.sensor("com").data, com, rtol=0, atol=1e-9)
    assert mujoco.mj_getTotalmass(model) == pytest.approx(TRUNK.mass + masses.sum(), abs=1e-12)


def test_laikago_stands() -> None:
    """After 4 s with the home pose as target it is settled and level, and its feet bear it all."""
    model, data = home()
    start = data.sensor("com").data.copy()
    mujoco.mj_step(model, data, 4 * 600)
    mujoco.mj_forward(model, data)
    assert np.abs(data.qvel).max() < 0.01
    assert data.body("trunk").xmat[8] > np.cos(0.02)
    np.testing.assert_allclose(data.sensor("com").data, start, rtol=0, atol=0.02)

    feet = {model.geom(f"{leg}_foot").id for leg in LEGS}
    assert {int(geom) for geom in data.contact.geom.ravel()} == {model.geom("floor").id, *feet}
    # On level ground the root's vertical generalised force is the sum of the contact forces.
    assert data.qfrc_constraint[2] == pytest.approx(TOTAL_MASS * 9.81, rel=2e-3)
    for leg in LEGS:
        sole = data.sensor(f"{leg}_foot_position").data[2] - SOLE
        assert -0.001 < sole < 0.0
        assert 8.0 < data.actuator(f"{leg}_calf").force[0] < 12.0


def test_laikago_collapses_onto_its_trunk_without_motors() -> None:
    _, data = home()
    model = load_spec("laikago").compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    mujoco.mj_step(model, data, 3 * 600)
    assert data.sensor("com").data[2] < 0.2
    assert model.geom("trunk").id in data.contact.geom


def test_laikago_kneels() -> None:
    """With thighs straight down and calves folded up, the knees are lowest and touch the ground."""
    model, data = home()
    data.qpos[2] = 0.25 + 0.02
    data.qpos[7:] = (0.0, 0.0, -2.7) * 4
    mujoco.mj_forward(model, data)
    names = {model.geom(int(geom)).name for geom in data.contact.geom.ravel()}
    assert names == {"floor", *(f"{leg}_knee" for leg in LEGS)}


def test_laikago_repeats_bit_for_bit_from_its_state_alone() -> None:
    """A state copied into fresh data gives exactly the same further motion as the original."""
    model, first = home()
    first.ctrl[::3] += 0.3
    mujoco.mj_step(model, first, 200)
    second = mujoco.MjData(model)
    second.qpos[:], second.qvel[:], second.ctrl[:] = first.qpos, first.qvel, first.ctrl
    for data in (first, second):
        mujoco.mj_step(model, data, 200)
    np.testing.assert_array_equal(first.qpos, second.qpos)
    np.testing.assert_array_equal(first.qvel, second.qvel)


def rocket() -> tuple[Any, Any]:
    model = compiled("rocket")
    return model, mujoco.MjData(model)


def test_rocket_figures() -> None:
    model, _ = rocket()
    body = model.body("rocket")
    assert mujoco.mj_getTotalmass(model) == ROCKET_MASS
    np.testing.assert_array_equal(body.ipos, np.zeros(3))
    assert full_inertia(model, body.id)[1, 1] == pytest.approx(ROCKET_INERTIA, abs=1e-12)
    assert model.opt.timestep == ROCKET_TIMESTEP
    np.testing.assert_array_equal(model.opt.gravity, (0.0, 0.0, -ROCKET_GRAVITY))
    np.testing.assert_array_equal(model.dof_damping, (ROCKET_DRAG, ROCKET_DRAG, 0.0))
    assert [model.jnt(i).name for i in range(model.njnt)] == ["x", "z", "angle"]
    assert [model.actuator(i).name for i in range(model.nu)] == ["main", "side"]
    np.testing.assert_array_equal(model.actuator_ctrlrange, ((0.0, 50.0), (-10.0, 10.0)))
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART


def test_rocket_outline_is_the_landers_about_its_centroid() -> None:
    model, data = rocket()
    mujoco.mj_forward(model, data)
    pixels = np.array(LANDER_PIXELS, float)
    x, z = pixels.T
    x_next, z_next = np.roll(pixels, -1, axis=0).T
    cross = x * z_next - x_next * z
    centroid = ((z + z_next) * cross).sum() / (3.0 * cross.sum())
    expected = (pixels - (0.0, centroid)) / PIXELS_PER_METRE

    geom = model.geom("hull")
    mesh = model.mesh("hull")
    first, count = int(mesh.vertadr[0]), int(mesh.vertnum[0])
    rotation = data.geom("hull").xmat.reshape(3, 3)
    vertices = data.geom("hull").xpos + model.mesh_vert[first : first + count] @ rotation.T
    for near in (True, False):
        found = vertices[(vertices[:, 1] < 0.0) == near][:, [0, 2]]
        assert found.shape == expected.shape
        distance = np.linalg.norm(found[:, None] - expected[None], axis=-1)
        assert distance.min(axis=0).max() < 5e-4
    assert geom.contype[0] == geom.conaffinity[0] == 2
    assert not model.geom_contype[1:].any()
    assert not model.geom_conaffinity[1:].any()


@pytest.mark.parametrize(("thrust", "speed"), [(0.0, -5.0), (25.0, 5.0), (50.0, 15.0), (12.5, 0.0)])
def test_rocket_terminal_speed(thrust: float, speed: float) -> None:
    """(thrust - m g) / drag; the start is forgotten as exp(-t drag / m), by 2e-9 in 40 s."""
    model, data = rocket()
    data.ctrl[0] = thrust
    mujoco.mj_step(model, data, 2000)
    np.testing.assert_allclose(data.qvel, (0.0, speed, 0.0), rtol=0, atol=1e-7)
    assert speed == (thrust - ROCKET_MASS * ROCKET_GRAVITY) / ROCKET_DRAG


def test_rocket_drag_works_sideways_too() -> None:
    """By backward Euler on the drag alone, every step divides the speed by 1 + h drag / m."""
    model, data = rocket()
    data.qvel[0] = 3.0
    mujoco.mj_step(model, data, 50)
    expected = 3.0 / (1.0 + ROCKET_TIMESTEP * ROCKET_DRAG / ROCKET_MASS) ** 50
    assert data.qvel[0] == pytest.approx(expected, rel=1e-12)


def test_rocket_spins_freely() -> None:
    model, data = rocket()
    data.qvel[2] = 1.5
    mujoco.mj_step(model, data, 1000)
    assert data.qvel[2] == pytest.approx(1.5, rel=1e-12)
    assert data.qpos[2] == pytest.approx(1.5 * 1000 * ROCKET_TIMESTEP, rel=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.floats(-np.pi, np.pi), st.floats(0.0, 50.0), st.floats(-10.0, 10.0))
def test_rocket_accelerations(angle: float, main: float, side: float) -> None:
    """At rest, the main engine pushes along the body's z axis, the side engine along minus its x
    axis from 0.365 m up."""
    model, data = rocket()
    data.qpos[2], data.ctrl[:] = angle, (main, side)
    mujoco.mj_forward(model, data)
    up = np.array((-np.sin(angle), np.cos(angle)))
    right = np.array((np.cos(angle), np.sin(angle)))
    linear = (main * up - side * right) / ROCKET_MASS - (0.0, ROCKET_GRAVITY)
    spin = side * ROCKET_LEVER / ROCKET_INERTIA
    np.testing.assert_allclose(data.qacc, (*linear, spin), rtol=0, atol=1e-10)


def test_rocket_full_side_engine_turns_it_counter_clockwise() -> None:
    """The rocket turns at 10 * 0.365 / 0.8 rad/s^2; its nose, at first up, moves to the left."""
    model, data = rocket()
    data.ctrl[1] = 10.0
    mujoco.mj_forward(model, data)
    assert data.qacc[2] == pytest.approx(4.5625, rel=1e-12)
    mujoco.mj_step(model, data, 20)
    mujoco.mj_forward(model, data)
    assert data.qpos[2] > 0.0
    assert data.site("side").xpos[0] < data.body("rocket").xpos[0]


@pytest.mark.parametrize(("gap", "touches"), [(-0.01, True), (0.01, False)])
def test_rocket_meets_obstacles_and_nothing_else(gap: float, touches: bool) -> None:
    """A ball of radius 0.5 m lies `gap` to the right of the hull, and a ghost inside the hull."""
    spec = load_spec("rocket")
    ball = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [0.5, 0.0, 0.0]}
    place = [17 / PIXELS_PER_METRE + 0.5 + gap, 0.0, -0.2]
    spec.worldbody.add_geom(name="obstacle_1", pos=place, contype=2, conaffinity=2, **ball)
    spec.worldbody.add_geom(name="ghost", pos=[0.0, 0.0, 0.0], contype=1, conaffinity=1, **ball)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert (data.ncon > 0) is touches
    if touches:
        pair = {model.geom(int(geom)).name for geom in data.contact.geom[0]}
        assert pair == {"hull", "obstacle_1"}
