"""The content of a show, independent of the renderer that draws it, a page or a video.

Positions are in the world frame in metres, times in seconds. `compose` makes shows from recordings.
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

# Colours of Okabe and Ito's palette, which colour-blind readers can tell apart.
EXECUTED_COLOUR: Rgb = (0.84, 0.37, 0.0)
PLAN_COLOUR: Rgb = (0.0, 0.45, 0.70)
OTHER_COLOUR: Rgb = (0.0, 0.62, 0.45)  # of the second of two policies
PUSH_COLOUR: Rgb = (0.72, 0.15, 0.52)
ROADMAP_COLOUR: Rgb = (0.40, 0.47, 0.55)
WAY_COLOUR: Rgb = (0.34, 0.71, 0.91)
FLAME_COLOUR: Colour = (1.0, 0.62, 0.1, 0.9)
INK: Rgb = (0.11, 0.15, 0.2)
PENCIL: Rgb = (0.68, 0.74, 0.8)
PAPER: Rgb = (1.0, 1.0, 1.0)
SKY = (208, 220, 231)  # red, green, blue of 255; distant ground fades to this colour
GHOST_OPACITY = 0.4


KEYFRAMES_PER_SECOND = 60.0  # screens rarely show more


@dataclass(frozen=True, eq=False)
class Actor:
    """A robot that moves through the scene.

    Attributes:
        name: the actor's label, and its node in meshcat's tree.
        qpos: generalised positions, shape (T, nq).
        timestep: seconds between two positions.
        colour: colour of the label and the path; red, green, blue in [0, 1].
        note: the actor's text in the legend.
        ghost: whether the robot is translucent in `colour`, with its whole path shown from the
            beginning. Other robots have the model's colours, and their paths grow with time.
        lane: metres by which the robot is moved along y, so that two robots do not overlap.
        ending: how its motion ends, in words; its label says so from then on.
    """

    name: str
    qpos: ArrayLike
    timestep: float
    colour: Rgb
    note: str
    ghost: bool = False
    lane: float = 0.0
    ending: str = ""


@dataclass(frozen=True, eq=False)
class Prop:
    """A mark, an arrow or a flame, visible for some of the time.

    Attributes:
        actor: name of the actor that the prop belongs to.
        name: the prop's node in meshcat's tree.
        geom: a geom type that has sizes, or an arrow from the position along z.
        size: metres, as in MJCF; radius and length of an arrow.
        colour: the colour, with opacity.
        times: seconds, shape (K,).
        position: metres, shape (K, 3).
        quaternion: (w, x, y, z), shape (K, 4).
        scale: factors on the size along the prop's axes from each time to the next, 0 while the
            prop is invisible, shape (K, 3).
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
    """A goal or an obstacle, a geom or site of that name; world frame, metres."""

    text: str
    position: tuple[float, float, float]
    radius: float
    colour: Colour


@dataclass(frozen=True)
class Entry:
    """A line of the legend: a swatch of the colour, the name and the note."""

    name: str
    colour: Rgb
    note: str


@dataclass(frozen=True, eq=False)
class Band:
    """A row of the timeline with intervals of time, planned above executed.

    Attributes:
        text: the row's label.
        planned, executed: the intervals, [begin, end] in seconds.
    """

    text: str
    planned: list[list[float]]
    executed: list[list[float]]


@dataclass(frozen=True, eq=False)
class Curve:
    """A row of the timeline with values over time.

    Attributes:
        text: the row's label, with its unit.
        lines: colour, seconds (K,) and values (K,) of each line, the most important line last.
    """

    text: str
    lines: tuple[tuple[Rgb, Array, Array], ...]


@dataclass(frozen=True)
class Figures:
    """A table: what its columns hold, and rows of a label and the values."""

    heads: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class Show:
    """Everything that a page or a video shows.

    Attributes:
        model: the model of the robot and of all static parts.
        actors: the moving robots; the camera follows the first.
        title: names the run, plan or task.
        verdict: the outcome in a sentence.
        tables: figures of the episodes and of the scores.
        props: marks, arrows and flames of the actors.
        legend: the legend's lines for the props; those for actors and landmarks are added.
        timeline: the rows below the picture.
        robot: what moves, in a word that follows "the".
        headings: the directions in which it can be pushed, as `parse_push` reads them, in words.
        landmarks: goal and obstacles of the model.
    """

    model: mujoco.MjModel
    actors: Sequence[Actor]
    title: str
    verdict: str = ""
    tables: Sequence[Figures] = ()
    props: Sequence[Prop] = ()
    legend: Sequence[Entry] = ()
    timeline: Sequence[Band | Curve] = ()
    robot: str = "robot"
    headings: Sequence[tuple[str, str]] = ()
    landmarks: Sequence[Landmark] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "landmarks", landmarks(self.model))


@dataclass(frozen=True, eq=False)
class Track:
    """An actor's motion at the keyframes that are drawn; world frame.

    Attributes:
        times: seconds, shape (K,).
        positions: positions of all bodies in metres, shape (K, nbody, 3).
        quaternions: orientations of all bodies (w, x, y, z), shape (K, nbody, 4).
    """

    times: Array
    positions: Array
    quaternions: Array


def track(model: mujoco.MjModel, actor: Actor) -> Track:
    """The track of an actor, with at most 60 keyframes a second and always one at the end.

    Raises:
        TsbenchError: the motion does not fit the model, or its time step is not positive.
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
    """The geoms and sites of a model with the names `goal`, `obstacle_1`, `obstacle_2`, ..."""
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
