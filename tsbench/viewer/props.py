"""Props that explain a motion: marks on the ground, arrows and flames."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from tsbench.core.drawing import Flame
from tsbench.viewer import scene
from tsbench.viewer.framing import reach
from tsbench.viewer.recording import Recording
from tsbench.viewer.scene import Array
from tsbench.viewer.show import (
    EXECUTED_COLOUR,
    FLAME_COLOUR,
    INK,
    PAPER,
    PLAN_COLOUR,
    PUSH_COLOUR,
    Prop,
    Rgb,
)

FOOT_MARK = 0.045  # m, radius of the disc under a foot
PUSH_LENGTH = 0.008  # m per newton, length of a push's arrow within 0.6 to 2 robot sizes
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def _turned(direction: Array) -> Array:
    """The quaternion that turns the z axis into a direction (3,)."""
    quaternion = np.zeros(4)
    mujoco.mju_quatZ2Vec(quaternion, np.asarray(direction, float))
    return quaternion


def _disc(
    actor: str,
    what: str,
    radius: float,
    level: int,
    colour: Rgb,
    recording: Recording,
    places: Array,
    on: NDArray[np.bool_],
) -> Prop:
    """A disc on the ground below the places (K, 3), visible while `on` (K,) is true. A disc of a
    higher level covers one of a lower level."""
    height = 0.001 * level
    position = places.copy()
    position[:, 2] = height
    return Prop(
        actor,
        f"{actor} {what}",
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        (radius, height),
        (*colour, 1.0),
        recording.times,
        np.nan_to_num(position),
        np.tile(UPRIGHT, (len(position), 1)),
        np.repeat(on.astype(float)[:, None], 3, axis=1),
    )  # fmt: skip


def planned_marks(actor: str, recording: Recording) -> list[Prop]:
    """A disc below each foot while it is scheduled to stand, wider than a contact mark."""
    scheduled = recording.scheduled
    if scheduled is None:
        return []
    return [
        _disc(
            actor, f"{foot} to stand", 1.5 * FOOT_MARK, 1, PLAN_COLOUR,
            recording, recording.support.feet[:, index], scheduled[:, index],
        )
        for index, foot in enumerate(recording.task.drawing().feet)
    ]  # fmt: skip


def contact_marks(actor: str, recording: Recording) -> list[Prop]:
    """A disc below each foot while it presses on the ground."""
    support = recording.support
    return [
        _disc(
            actor, f"{foot} stands", FOOT_MARK, 2, EXECUTED_COLOUR,
            recording, support.feet[:, index], support.contacts[:, index],
        )
        for index, foot in enumerate(recording.task.drawing().feet)
    ]  # fmt: skip


def balance_marks(actor: str, recording: Recording) -> list[Prop]:
    """The centre of mass in black and the centre of pressure in white, on the ground."""
    support = recording.support
    always = np.ones(len(recording.times), bool)
    pressed = np.isfinite(support.pressure[:, 0])
    marks = (
        ("pressure rim", 0.032, 4, INK, support.pressure, pressed),
        ("pressure", 0.024, 5, PAPER, support.pressure, pressed),
        ("mass", 0.016, 6, INK, support.com, always),
    )
    return [
        _disc(actor, what, radius, level, colour, recording, places, on)
        for what, radius, level, colour, places, on in marks
    ]


def push_arrows(actor: str, recording: Recording, lane: float = 0.0) -> list[Prop]:
    """An arrow for every pushed body, visible during the push, with its tip near the body's centre
    of mass, where the force acts. `lane` shifts the arrows along y, in metres."""
    model = recording.task.spec().compile()
    size = reach(model, recording.qpos[0])[0]
    pushed = np.flatnonzero(recording.forces[..., :3].any(axis=(0, 2)))
    data = mujoco.MjData(model)
    found = []
    for body in pushed:
        force = np.concatenate([recording.forces[:, body, :3], np.zeros((1, 3))])
        newtons = np.linalg.norm(force, axis=1)
        strongest = float(newtons.max())
        length = float(np.clip(PUSH_LENGTH * strongest, 0.6 * size, 2.0 * size))
        tip = np.zeros((len(force), 3))
        for frame, qpos in enumerate(recording.qpos):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            tip[frame] = data.xipos[body]
        direction = force / np.maximum(newtons, 1e-12)[:, None]
        share = newtons / strongest
        found.append(
            Prop(
                actor,
                f"{actor} push on {scene.node(model, int(body))}",
                mujoco.mjtGeom.mjGEOM_ARROW,
                (0.04 * size, length),
                (*PUSH_COLOUR, 1.0),
                recording.times,
                tip - (share * length + 0.25 * size)[:, None] * direction + (0.0, lane, 0.0),
                np.array(
                    [_turned(d) if s else UPRIGHT for d, s in zip(direction, share, strict=True)]
                ),
                np.where(share[:, None] > 0.0, np.stack([share > 0.0, share > 0.0, share], 1), 0.0),
            )
        )
    return found


def flames(actor: str, recording: Recording) -> list[Prop]:
    """The flames of the engines; the length of each follows its throttle."""
    jets = recording.task.drawing().flames
    return [_flame(actor, f"{actor} flame {i}", jet, recording) for i, jet in enumerate(jets)]


def _flame(actor: str, name: str, jet: Flame, recording: Recording) -> Prop:
    model = recording.task.spec().compile()
    body, actuator = model.body(jet.body).id, model.actuator(jet.actuator).id
    positions, quaternions = scene.body_poses(model, recording.qpos)
    used = np.append(recording.controls[:, actuator], 0.0)
    length = np.maximum(jet.length * used, 0.0)
    longest = abs(jet.length) * float(np.abs(model.actuator_ctrlrange[actuator]).max())
    rotation = np.zeros((len(used), 3, 3))
    for row, quaternion in zip(rotation, quaternions[:, body], strict=True):
        mujoco.mju_quat2Mat(row.reshape(9), quaternion)
    direction = rotation @ np.array(jet.direction)
    nozzle = positions[:, body] + rotation @ np.array(jet.nozzle)
    share = (length / longest)[:, None]
    return Prop(
        actor,
        name,
        mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        (0.12 * longest, 0.12 * longest, longest / 2),
        FLAME_COLOUR,
        recording.times,
        nozzle + 0.45 * length[:, None] * direction,
        np.array([_turned(way) for way in direction]),
        np.where(share > 0.0, np.concatenate([np.ones_like(share)] * 2 + [share], axis=1), 0.0),
    )
