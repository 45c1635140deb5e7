"""The static parts of a show: the task's model, the border of its world, its reward map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from tsbench.core.drawing import Drawing, Lines
from tsbench.core.errors import TsbenchError
from tsbench.viewer.framing import reach
from tsbench.viewer.recording import Recording
from tsbench.viewer.scene import Array, Colour
from tsbench.viewer.show import INK, SKY

MAP_PIXELS = 240  # along the longer side of a reward map


def stage(recording: Recording, lane: float = 0.0, lines: Sequence[Lines] = ()) -> mujoco.MjModel:
    """The task's model with the world's border, the reward map, and a copy of the goal in a lane.

    Args:
        recording: a recording of the task.
        lane: metres along y from the goal to its copy; 0 for no copy.
        lines: to draw in addition to the task's own.

    Raises:
        TsbenchError: the world has bounds and is not flat across y.
    """
    spec = recording.task.spec()
    goal = spec.site("goal")
    if lane and goal is not None:
        spec.worldbody.add_site(
            type=goal.type, pos=np.add(goal.pos, (0.0, lane, 0.0)), size=goal.size, rgba=goal.rgba
        )
    behind = 2.05 * reach(recording.task.spec().compile(), recording.qpos[0])[0]
    drawing = recording.task.drawing()
    furnish(spec, replace(drawing, lines=(*drawing.lines, *lines)), behind)
    return spec.compile()


def furnish(spec: mujoco.MjSpec, drawing: Drawing, behind: float) -> None:
    """Adds lines, the world's border and the reward map to a model, without contacts.

    Args:
        spec: the task's model.
        drawing: the task's drawing.
        behind: metres by which the map lies behind the motion.

    Raises:
        TsbenchError: the world has bounds and is not flat across y.
    """
    for number, lines in enumerate(drawing.lines):
        _lines(spec, f"lines_{number}", lines)
    if drawing.bounds is None:
        return
    low, high = drawing.bounds
    across = int(np.argmin(high - low))
    if across != 1:
        raise TsbenchError("only worlds that are flat across y can be drawn with their bounds")
    corners = [
        np.array([x, low[1], z])
        for x, z in ((low[0], low[2]), (high[0], low[2]), (high[0], high[2]), (low[0], high[2]))
    ]
    width = 0.0015 * float(np.linalg.norm(high - low))
    for begin, end in zip(corners, corners[1:] + corners[:1], strict=True):
        _line(spec, begin, end, width, (*INK, 1.0))
    if drawing.worth is not None:
        _reward_map(spec, drawing, behind)


def _lines(spec: mujoco.MjSpec, name: str, lines: Lines) -> None:
    """Adds all lines as one mesh, of a three-sided tube for each, which costs a picture little."""
    first, second = lines.segments[:, 0], lines.segments[:, 1]
    along = second - first
    first, second, along = (ends[along.any(axis=-1)] for ends in (first, second, along))
    if not len(along):
        return
    size = float(np.linalg.norm(np.ptp(lines.segments.reshape(-1, 3), axis=0)))
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    least = np.eye(3)[np.argmin(np.abs(along), axis=-1)]
    side = np.cross(along, least)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    other = np.cross(along, side)
    angle = 2.0 * math.pi / 3.0 * np.arange(3)
    around = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * other[:, None]
    ring = lines.width * size / 2.0 * around  # (m, 3, 3)
    vertices = np.concatenate([first[:, None] + ring, second[:, None] + ring], axis=1)
    faces = np.array(
        [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5], [0, 2, 1], [3, 4, 5]]
    )
    spec.add_mesh(
        name=name,
        uservert=vertices.ravel(),
        userface=(6 * np.arange(len(vertices))[:, None, None] + faces).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.add_material(name=name, rgba=[*lines.colour, 1.0], emission=0.4, specular=0.0)
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        contype=0,
        conaffinity=0,
        group=2,
    )


def _line(
    spec: mujoco.MjSpec, begin: Array, end: Array, radius: float, colour: Colour
) -> mujoco.MjsGeom:
    return spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*begin, *end],
        size=[radius, 0.0, 0.0],
        rgba=colour,
        contype=0,
        conaffinity=0,
        group=2,
    )


def _reward_map(spec: mujoco.MjSpec, drawing: Drawing, behind: float) -> None:
    """Adds a picture behind the world: gold where the reward is positive, red where it is negative,
    and else the colour of the sky."""
    assert drawing.bounds is not None
    assert drawing.worth is not None
    low, high = drawing.bounds
    span = high - low
    columns, rows = np.maximum(np.rint(MAP_PIXELS * span[[0, 2]] / span.max()), 2).astype(int)
    x = low[0] + span[0] * (np.arange(columns) + 0.5) / columns
    z = high[2] - span[2] * (np.arange(rows) + 0.5) / rows  # the image's first row is the top
    grid = np.stack(np.broadcast_arrays(x[None], low[1], z[:, None]), axis=-1)
    worth = drawing.worth(grid.reshape(-1, 3)).reshape(rows, columns, 1)
    gain = np.maximum(worth, 0.0) / max(float(worth.max()), 1e-9)
    loss = np.maximum(-worth, 0.0) / max(float(-worth.min()), 1e-9)
    image = np.array(SKY) + gain * ((255, 190, 20) - np.array(SKY))
    image += loss * ((190, 70, 60) - image)
    texture = spec.add_texture(
        name="worth",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=int(columns),
        height=int(rows),
        nchannel=3,
    )
    texture.data = image.round().astype(np.uint8).tobytes()
    material = spec.add_material(name="worth", specular=0.0, emission=0.4)
    textures = material.textures
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "worth"
    material.textures = textures
    spec.worldbody.add_geom(
        name="worth",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[span[0] / 2, span[2] / 2, 1.0],
        pos=[(low[0] + high[0]) / 2, low[1] + behind, (low[2] + high[2]) / 2],
        quat=[math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0],  # x to the right, y up
        material="worth",
        contype=0,
        conaffinity=0,
        group=2,
    )
