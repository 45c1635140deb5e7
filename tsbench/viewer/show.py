"""What is to be seen of a motion, whoever draws it: a page in a browser or a video.

World frame, metres, seconds. `compose` makes shows from recordings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from tsbench.core.errors import TsbenchError
from tsbench.viewer import scene
from tsbench.viewer.scene import Array, Colour

Rgb = tuple[float, float, float]

# From Okabe and Ito's palette, which colour-blind readers can tell apart.
EXECUTED_COLOUR: Rgb = (0.84, 0.37, 0.0)
PLAN_COLOUR: Rgb = (0.0, 0.45, 0.70)
OTHER_COLOUR: Rgb = (0.0, 0.62, 0.45)  # of the second of two policies
PUSH_COLOUR: Rgb = (0.72, 0.15, 0.52)
FLAME_COLOUR: Colour = (1.0, 0.62, 0.1, 0.9)
INK: Rgb = (0.11, 0.15, 0.2)
PENCIL: Rgb = (0.68, 0.74, 0.8)
PAPER: Rgb = (1.0, 1.0, 1.0)
SKY = (208, 220, 231)  # red, green, blue of 255; distant ground fades into it
GHOST_OPACITY = 0.4


KEYFRAMES_PER_SECOND = 60.0  # more cannot be seen


@dataclass(frozen=True, eq=False)
class Actor:
    """A robot that moves through the scene.

    Attributes:
        name: its label and its node in meshcat's tree.
        qpos: generalised positions, shape (T, nq).
        timestep: seconds between them.
        colour: of its label and its path, red, green, blue in [0, 1].
        note: what the legend says of it.
        ghost: translucent in its colour rather than solid in the model's colours; its path is
            there from the beginning rather than drawn as it goes.
        lane: metres by which it is moved aside, so that two do not run into each other.
    """

    name: str
    qpos: ArrayLike
    timestep: float
    colour: Rgb
    note: str
    ghost: bool = False
    lane: float = 0.0


@dataclass(frozen=True, eq=False)
class Prop:
    """A mark, an arrow or a flame that comes and goes.

    Attributes:
        actor: the name of the actor that it belongs to.
        name: its node in meshcat's tree.
        geom: its shape, one of those that have sizes, or an arrow: from its position along z.
        size: as in MJCF in metres, of an arrow its radius and length.
        colour: with opacity.
        times: seconds, shape (K,).
        position: metres, shape (K, 3).
        quaternion: (w, x, y, z), shape (K, 4).
        scale: of its sizes along its axes from each time to the next, 0 where it is not to be
            seen, shape (K, 3).
    """

    actor: str
    name: str
    geom: mujoco.mjtGeom
    size: tuple[float, ...]
    colour: Colour
    times: Array
    position: Array
    quaternion: Array
    scale: Array


@dataclass(frozen=True)
class Landmark:
    """A goal or an obstacle: a geom or site of that name, in world metres."""

    text: str
    position: tuple[float, float, float]
    radius: float
    colour: Colour


@dataclass(frozen=True)
class Entry:
    """A line of the legend: `name`: `note`, beside a swatch of the colour."""

    name: str
    colour: Rgb
    note: str


@dataclass(frozen=True, eq=False)
class Band:
    """A row of the timeline that shows when something held: planned above executed.

    Attributes:
        text: what it shows.
        planned, executed: [begin, end] in seconds, in pairs.
    """

    text: str
    planned: list[list[float]]
    executed: list[list[float]]


@dataclass(frozen=True, eq=False)
class Curve:
    """A row of the timeline with numbers over time.

    Attributes:
        text: what it shows, with its unit.
        lines: colour, seconds (K,), values (K,), the most important one last.
    """

    text: str
    lines: tuple[tuple[Rgb, Array, Array], ...]


@dataclass(frozen=True, eq=False)
class Show:
    """Everything that a page or a video shows.

    Attributes:
        model: of the robot, with all that stands still.
        actors: who moves; the camera follows the first.
        title: what was run.
        verdict: what became of it, in a sentence.
        summary: labels and values of the score.
        props: what explains the actors.
        legend: of the props; actors and landmarks explain themselves.
        timeline: the rows below the picture.
    """

    model: mujoco.MjModel
    actors: Sequence[Actor]
    title: str
    verdict: str = ""
    summary: Sequence[tuple[str, str]] = ()
    props: Sequence[Prop] = ()
    legend: Sequence[Entry] = ()
    timeline: Sequence[Band | Curve] = ()
    landmarks: Sequence[Landmark] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "landmarks", landmarks(self.model))


@dataclass(frozen=True, eq=False)
class Track:
    """An actor's motion, thinned to what can be seen.

    Attributes:
        times: seconds, shape (K,).
        positions: of all bodies in the world in metres, shape (K, nbody, 3).
        quaternions: (w, x, y, z), shape (K, nbody, 4).
    """

    times: Array
    positions: Array
    quaternions: Array


def track(model: mujoco.MjModel, actor: Actor) -> Track:
    """Where the bodies of an actor are, at most 60 times a second and always at the end.

    Raises:
        TsbenchError: the motion is not one of this model.
    """
    if not (math.isfinite(actor.timestep) and actor.timestep > 0.0):
        raise TsbenchError(f"the time step of the {actor.name} motion is {actor.timestep}")
    qpos = np.atleast_1d(np.asarray(actor.qpos, float))
    stride = max(1, int(1.0 / (KEYFRAMES_PER_SECOND * actor.timestep) + 1e-9))
    frames = np.arange(len(qpos))
    kept = np.union1d(frames[::stride], frames[-1:])
    times = np.asarray(kept * actor.timestep, np.float64)
    positions, quaternions = scene.body_poses(model, qpos[kept], actor.name)
    return Track(times, positions + np.array([0.0, actor.lane, 0.0]), quaternions)


def landmarks(model: mujoco.MjModel) -> list[Landmark]:
    """What tasks add to a model under the names `goal` and `obstacle_1`, `obstacle_2`, ..."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for part in scene.parts(model):
        kind, name = part.name.split(" ", 1)
        if re.fullmatch(r"goal|obstacle_\d+", name):
            x, y, z = getattr(data, kind)(name).xpos.tolist()
            size = float(np.max(getattr(model, kind)(name).size))
            found.append(Landmark(name.replace("_", " "), (x, y, z), size, part.rgba))
    return found
