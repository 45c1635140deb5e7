"""Inverse kinematics of the legs against closed-form geometry."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from tsbench.planning.ik import FootPoses
from tsbench.sim.model import compiled

FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
HIPS = np.array([[0.21935, -0.0875], [0.21935, 0.0875], [-0.21935, -0.0875], [-0.21935, 0.0875]])
LATERAL = np.array([-0.037, 0.037, -0.037, 0.037])  # of the thigh beside the hip's axis
LENGTH = 0.25  # of thigh and calf
BASE = np.array([0.3, -0.2, 0.45, 1.0, 0.0, 0.0, 0.0])
MODEL = compiled("laikago")
HOME = MODEL.key("home").qpos
LOW, HIGH = MODEL.jnt_range[1:].T


def solver() -> FootPoses:
    return FootPoses(MODEL, FEET, HOME)


def legs(joints: np.ndarray) -> np.ndarray:
    """Foot centres (4, 3) in the base frame for joint angles (12), by hand."""
    hip, thigh, calf = joints.reshape(4, 3).T
    forward = -LENGTH * (np.sin(thigh) + np.sin(thigh + calf))
    down = -LENGTH * (np.cos(thigh) + np.cos(thigh + calf))
    return np.stack(
        [
            HIPS[:, 0] + forward,
            HIPS[:, 1] + LATERAL * np.cos(hip) - down * np.sin(hip),
            LATERAL * np.sin(hip) + down * np.cos(hip),
        ],
        axis=-1,
    )


def angles(feet: np.ndarray) -> np.ndarray:
    """Joint angles (12) that put the feet (4, 3), in the base frame, there; knees backward."""
    x = feet[:, 0] - HIPS[:, 0]
    y, z = feet[:, 1] - HIPS[:, 1], feet[:, 2]
    down = -np.sqrt(y**2 + z**2 - LATERAL**2)  # in the leg's own plane
    hip = np.arctan2(z, y) - np.arctan2(down, LATERAL)
    reach = np.sqrt(x**2 + down**2)
    calf = -2.0 * np.arccos(reach / (2.0 * LENGTH))
    thigh = np.arctan2(-x, -down) - calf / 2.0
    return np.stack([(hip + np.pi) % (2 * np.pi) - np.pi, thigh, calf], axis=-1).ravel()


def random_joints(rng: np.random.Generator) -> np.ndarray:
    """Joint angles (12) that a walking robot can have."""
    low, high = np.tile([-0.4, 0.0, -2.3], 4), np.tile([0.4, 1.4, -0.75], 4)
    return rng.uniform(low, high)


def placed(joints: np.ndarray) -> np.ndarray:
    """Foot centres (4, 3) in the world frame by the compiled model."""
    data = mujoco.MjData(MODEL)
    data.qpos[:] = [*BASE, *joints]
    mujoco.mj_kinematics(MODEL, data)
    return np.array([data.site(foot).xpos for foot in FEET])


def test_the_closed_form_is_the_models() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        joints = random_joints(rng)
        np.testing.assert_allclose(legs(joints) + BASE[:3], placed(joints), atol=1e-12)
        np.testing.assert_allclose(angles(legs(joints)), joints, atol=1e-9)


def test_reachable_targets_are_met() -> None:
    """Targets one after another; each solution starts from the last."""
    poses = solver()
    rng = np.random.default_rng(1)
    for _ in range(60):
        targets = legs(random_joints(rng)) + BASE[:3]
        qpos, residual = poses.solve(BASE, targets)
        assert residual < 1e-4
        np.testing.assert_allclose(placed(qpos[7:]), targets, atol=1e-4)
        np.testing.assert_array_equal(qpos[:7], BASE)
        np.testing.assert_allclose(qpos[7:], angles(targets - BASE[:3]), atol=2e-3)
        assert np.all((qpos[7:] >= LOW) & (qpos[7:] <= HIGH))


@pytest.mark.parametrize("height", [0.32, 0.40, 0.42, 0.43, 0.45])
def test_standing_under_the_hips(height: float) -> None:
    """The table of facts.md D: thigh = acos(h / 2 L), calf = -2 thigh, h less the foot's radius."""
    base = np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0])
    feet = np.column_stack([HIPS[:, 0], HIPS[:, 1] + LATERAL, np.full(4, 0.0265)])
    qpos, residual = solver().solve(base, feet)
    thigh = math.acos((height - 0.0265) / 0.5)
    assert residual < 1e-4
    np.testing.assert_allclose(qpos[7:], np.tile([0.0, thigh, -2 * thigh], 4), atol=1e-3)


def test_a_base_that_is_turned() -> None:
    """The base orientation is kept, and targets are in the world frame."""
    turn = 0.2
    base = np.array([1.0, 2.0, 0.42, math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)])
    joints = np.tile([0.1, 0.7, -1.4], 4)
    rotation = np.array(
        [
            [math.cos(turn), -math.sin(turn), 0.0],
            [math.sin(turn), math.cos(turn), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    qpos, residual = solver().solve(base, legs(joints) @ rotation.T + base[:3])
    assert residual < 1e-4
    np.testing.assert_allclose(qpos[:7], base)
    np.testing.assert_allclose(qpos[7:], joints, atol=2e-3)


@pytest.mark.parametrize(
    ("offset", "least"),
    [
        ((0.0, 0.0, -0.2), 0.1),  # straight legs are 0.5 m long, of which limits leave 0.477
        ((1.0, 0.0, 0.0), 0.5),
        ((0.0, 0.9, 0.3), 0.3),
        ((-30.0, 20.0, 10.0), 30.0),
        ((0.0, 0.0, 0.42), 0.01),  # into the hip
    ],
)
def test_out_of_reach(offset: tuple[float, float, float], least: float) -> None:
    """No exception: limits hold, the base is fixed, and the residual is the largest foot error."""
    poses = solver()
    standing = placed(HOME[7:])
    for _ in range(3):
        qpos, residual = poses.solve(BASE, standing + np.array(offset))
        missed = np.linalg.norm(placed(qpos[7:]) - standing - np.array(offset), axis=-1)
        assert residual == pytest.approx(missed.max(), abs=1e-9)
        assert residual > least
        assert np.all((qpos[7:] >= LOW - 1e-6) & (qpos[7:] <= HIGH + 1e-6))
        np.testing.assert_array_equal(qpos[:7], BASE)
        assert np.all(np.isfinite(qpos))


def test_neighbouring_targets_give_neighbouring_poses() -> None:
    poses = solver()
    centre = placed(HOME[7:])
    previous = None
    for step in range(60):
        circle = 0.05 * np.array([math.cos(step / 5), 0.0, math.sin(step / 5)])
        qpos, residual = poses.solve(BASE, centre + circle)
        assert residual < 1e-4
        if previous is not None:
            assert np.abs(qpos - previous).max() < 0.15  # 1 cm further
        previous = qpos


def test_a_miss_does_not_spoil_what_follows() -> None:
    poses = solver()
    standing = placed(HOME[7:])
    for offset in ((0.0, 0.0, -0.2), (0.6, 0.0, 0.0), (-0.6, 0.3, 0.2)):
        poses.solve(BASE, standing + np.array(offset))
        qpos, residual = poses.solve(BASE, standing)
        assert residual < 1e-4
        np.testing.assert_allclose(qpos[7:], HOME[7:], atol=2e-3)
