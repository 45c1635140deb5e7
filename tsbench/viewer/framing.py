"""Places the camera: its direction, and the space that it shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from tsbench.viewer import scene
from tsbench.viewer.scene import Array
from tsbench.viewer.show import Landmark, Track

FRAMED_POINTS = 60  # points of each path that must be in the picture
PLANAR = 1e-6  # m, sideways movement below which a motion is planar


@dataclass(frozen=True, eq=False)
class Framing:
    """The space that the camera shows; world frame, metres.

    Attributes:
        size: radius of the visible robot around its base, the first body that can move.
        above, below: approximate height of the robot above and depth below its base.
        centres: centres of the spheres to show, along paths and at landmarks, shape (S, 3).
        radii: radii of these spheres, shape (S,).
        direction: vector from the target towards the camera.
        flat: whether the motion stays in a vertical plane along x, and there is no ground.
    """

    size: float
    above: float
    below: float
    centres: Array
    radii: Array
    direction: tuple[float, float, float]
    flat: bool

    @property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest corner of the box around the spheres, each of shape (3,)."""
        radii = self.radii[:, None]
        return (self.centres - radii).min(axis=0), (self.centres + radii).max(axis=0)

    @property
    def extent(self) -> float:
        """The length of the diagonal of the box."""
        low, high = self.box
        return float(np.linalg.norm(high - low))


def framing(
    model: mujoco.MjModel, start: Array, tracks: Sequence[Track], marks: Sequence[Landmark]
) -> Framing:
    """The framing in which a motion goes from left to right.

    The camera sees a motion in a vertical plane along x from the side, and any other motion from
    the right, ahead and above.

    Args:
        model: compiled model.
        start: generalised positions at which the size of the robot is measured, shape (nq,).
        tracks: the motions, the most important one first.
        marks: goal and obstacles.
    """
    bodies = scene.moving_bodies(model)
    size, above, below = reach(model, start)
    paths = [motion.positions[:, bodies[0]] for motion in tracks]
    shown = [path[np.linspace(0, len(path) - 1, FRAMED_POINTS).astype(int)] for path in paths]
    centres = np.concatenate([*shown, np.reshape([mark.position for mark in marks], (-1, 3))])
    radii = np.full(len(centres), size)
    radii[len(centres) - len(marks) :] = [mark.radius for mark in marks]

    plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    grounded = bool(np.any(plane & ((model.geom_contype | model.geom_conaffinity) != 0)))
    flat = bool(np.ptp(tracks[0].positions[:, bodies, 1], axis=0).max() < PLANAR)
    x, y = (paths[0][-1] - paths[0][0])[:2]
    distance = math.hypot(x, y)
    x, y = (x / distance, y / distance) if distance > size else (1.0, 0.0)
    direction = (0.3 * x + y, 0.3 * y - x, 0.35)
    if flat:
        direction = (0.0, -1.0, 0.2 if grounded else 0.0)
    return Framing(size, above, below, centres, radii, direction, flat and not grounded)


def reach(model: mujoco.MjModel, qpos: Array) -> tuple[float, float, float]:
    """Radius of the visible robot around its base, and its height above and depth below, metres."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    base = scene.moving_bodies(model)[0]
    robot = (model.geom_group < scene.VISIBLE_GROUPS) & (model.body_weldid[model.geom_bodyid] != 0)
    around = data.geom_xpos[robot] - data.xpos[base]
    distances = np.linalg.norm(around, axis=1) + model.geom_rbound[robot]
    size = float(np.max(distances, initial=0.0)) or float(model.stat.extent)
    above = 0.1 * size + float(np.max(around[:, 2], initial=0.0))
    below = 0.1 * size - float(np.min(around[:, 2], initial=0.0))
    return size, above, below
