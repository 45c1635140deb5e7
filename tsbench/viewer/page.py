"""One self-contained HTML page that plays a motion: no server, no network.

The page holds meshcat's viewer, the drawing commands that a meshcat server would have sent, and a
small player (page.html) with captions. Nothing here starts a process or opens a port: a
`Recorder` takes the place of meshcat's connection to its server.
"""

from __future__ import annotations

import base64
import html
import importlib.resources
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshcat
import meshcat.geometry as shapes
import mujoco
import numpy as np
import umsgpack
from meshcat import Visualizer
from numpy.typing import ArrayLike, NDArray

from tsbench.errors import TsbenchError
from tsbench.files import write_whole
from tsbench.viewer import scene
from tsbench.viewer.scene import Array, Colour

# Okabe and Ito's vermilion and blue, which colour-blind readers can tell apart.
EXECUTED_COLOUR = (0.84, 0.37, 0.0)
PLAN_COLOUR = (0.0, 0.45, 0.70)
GHOST_OPACITY = 0.4
INK, PENCIL = (0.11, 0.15, 0.2), (0.68, 0.74, 0.8)  # of labels, of grid lines
SKY = (208, 220, 231)  # red, green, blue of 255; distant ground fades into it

# Of meshcat's own scene: its point lights reach 10 m, too little for a rocket.
UNWANTED = ("/Grid", "/Axes", "/Lights/PointLightNegativeX", "/Lights/PointLightPositiveX")
# Of what the page holds: meshcat itself, then what is bundled with it.
LICENCES = (
    "LICENSE",
    "dist/main.min.js.LICENSE.txt",
    "dist/main.min.js.THIRD_PARTY_LICENSES.json",
)

EXECUTED_NOTE = (
    "what the policy did, with physics: the robot in its own colours, its path in orange"
)
PLAN_NOTE = "what it was to do, planned without physics: translucent blue"

KEYFRAMES_PER_SECOND = 60.0  # more cannot be seen
TRAIL_SIDES = 6  # of the tube that is drawn along a path
TRAIL_POINTS = 600  # at most, per path
TRAIL_RADIUS = 0.004  # of the tube, relative to the robot
# What page.html adds to the radius, relative to the distance from which it is seen. Where both
# paths coincide the executed one covers the plan's.
EXECUTED_WIDTH, PLAN_WIDTH = 0.0015, 0.0011
FRAMED_POINTS = 60  # of each path that the camera makes sure to show
GRID_LINES = 5  # at least, across all that is seen
PLANAR = 1e-6  # m, sideways movement of a planar motion
IDENTIFIER = re.compile(rb"[0-9a-f]{8}-[0-9a-f]{4}-1[0-9a-f]{3}-[0-9a-f]{4}-[0-9a-f]{12}")
STILL = 1e-6  # m or quaternion units: what moves less is not animated


class Recorder:
    """Takes the place of meshcat's `ViewerWindow`: keeps the commands instead of sending them."""

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        self.commands.append(command.lower())

    def packed(self) -> list[str]:
        """The commands as meshcat's page takes them, in base64.

        meshcat's identifiers (time and network address of the machine) become running numbers:
        equal motions give equal pages, which tell nothing of where they were made.
        """
        numbers: dict[bytes, bytes] = {}

        def number(match: re.Match[bytes]) -> bytes:
            return numbers.setdefault(match[0], b"%036d" % len(numbers))

        return [
            base64.b64encode(
                IDENTIFIER.sub(number, umsgpack.packb(command, force_float_precision="single"))
            ).decode()
            for command in self.commands
        ]


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
    """

    name: str
    qpos: ArrayLike
    timestep: float
    colour: tuple[float, float, float]
    note: str
    ghost: bool = False


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
    """Where the bodies of an actor are, at most 60 times a second and always at the end."""
    if not (math.isfinite(actor.timestep) and actor.timestep > 0.0):
        raise TsbenchError(f"the time step of the {actor.name} motion is {actor.timestep}")
    qpos = np.atleast_1d(np.asarray(actor.qpos, float))
    stride = max(1, int(1.0 / (KEYFRAMES_PER_SECOND * actor.timestep) + 1e-9))
    frames = np.arange(len(qpos))
    kept = np.union1d(frames[::stride], frames[-1:])
    times = np.asarray(kept * actor.timestep, np.float64)
    return Track(times, *scene.body_poses(model, qpos[kept], actor.name))


class Playback:
    """meshcat's command that animates nodes, with typed arrays instead of a map per keyframe."""

    def __init__(self, duration: float) -> None:
        self.duration = duration
        self.clips: list[dict[str, Any]] = []

    def move(self, path: str, times: Array, position: Array, quaternion: Array) -> None:
        """Animates one node: position (K, 3) and quaternion (w, x, y, z) (K, 4) at K times."""
        tracks = [
            {
                "name": name,
                "type": kind,
                "times": scene.packed(times),
                "values": scene.packed(values),
            }
            for name, kind, values in (
                (".position", "vector3", position),
                (".quaternion", "quaternion", np.roll(quaternion, -1, axis=-1)),
            )
            if np.ptp(values, axis=0).max() > STILL
        ]
        if tracks:
            clip = {"name": path, "fps": 1, "duration": self.duration, "tracks": tracks}
            self.clips.append({"path": path, "clip": clip})

    def lower(self) -> dict[str, Any]:
        options = {"play": True, "repetitions": 1}
        return {"type": "set_animation", "path": "", "animations": self.clips, "options": options}


def _unit(vectors: Array) -> Array:
    """Vectors (K, 3) at length 1; where a path turns back they may be 0, and stay so."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def trail(points: Array, radius: float) -> tuple[shapes.Geometry, NDArray[np.int64]]:
    """A tube along a path.

    Args:
        points: metres, shape (K, 3).
        radius: metres.

    Returns:
        The tube and the indices of the points that it passes through, which leave out those where
        the path has hardly got ahead. A path that stays in one place has one point and no tube.
    """
    travelled = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    spacing = max(0.5 * radius, travelled[-1] / TRAIL_POINTS)
    kept = np.unique(np.floor(travelled / spacing), return_index=True)[1]
    path = points[kept]
    if len(path) < 2:
        return scene.surface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))), kept
    tangent = np.gradient(path, axis=0)
    # The direction in which a path spreads least hardly ever lies along it.
    least = np.linalg.eigh(np.cov(path.T))[1][:, 0]
    side = _unit(np.cross(tangent, least))
    other = _unit(np.cross(tangent, side))
    angle = np.arange(TRAIL_SIDES)[:, None] * 2.0 * np.pi / TRAIL_SIDES
    outward = np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]
    rings = path[:, None] + radius * outward
    here = np.arange(TRAIL_SIDES)
    beside, ahead = np.roll(here, -1), here + TRAIL_SIDES
    band = np.stack([here, beside, ahead, beside, beside + TRAIL_SIDES, ahead], axis=1)
    faces = band + TRAIL_SIDES * np.arange(len(path) - 1)[:, None, None]
    tube = scene.surface(rings.reshape(-1, 3), faces.reshape(-1, 3), outward.reshape(-1, 3))
    return tube, kept


@dataclass(frozen=True)
class Landmark:
    """A goal or an obstacle: a geom or site of that name, in world metres."""

    text: str
    position: tuple[float, float, float]
    radius: float
    colour: Colour


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


@dataclass(frozen=True, eq=False)
class Framing:
    """What the camera is to show, in world metres.

    Attributes:
        size: how far the visible robot reaches around its base, the first body that can move.
        above, below: the same upwards and downwards alone, about.
        centres: of spheres to be seen, along the paths and at the landmarks, shape (S, 3).
        radii: of the spheres, shape (S,).
        direction: towards the camera.
        flat: whether all happens in a vertical plane along x, with no ground to see it on.
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
        """Lowest and highest corner of the box around the spheres."""
        radii = self.radii[:, None]
        return (self.centres - radii).min(axis=0), (self.centres + radii).max(axis=0)

    @property
    def extent(self) -> float:
        """The diagonal of the box."""
        low, high = self.box
        return float(np.linalg.norm(high - low))


def framing(
    model: mujoco.MjModel, start: Array, tracks: Sequence[Track], marks: Sequence[Landmark]
) -> Framing:
    """How to look at a motion: so that it goes from left to right.

    A motion within a vertical plane along x is looked at from the side, any other from the right,
    ahead and above.

    Args:
        model: compiled model.
        start: generalised positions at which the robot is measured, shape (nq,).
        tracks: the motions, the most important one first.
        marks: goal and obstacles.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_kinematics(model, data)
    bodies = scene.moving_bodies(model)
    robot = (model.geom_group < scene.VISIBLE_GROUPS) & (model.body_weldid[model.geom_bodyid] != 0)
    around = data.geom_xpos[robot] - data.xpos[bodies[0]]
    reach = np.linalg.norm(around, axis=1) + model.geom_rbound[robot]
    size = float(np.max(reach, initial=0.0)) or float(model.stat.extent)
    above = 0.1 * size + float(np.max(around[:, 2], initial=0.0))
    below = 0.1 * size - float(np.min(around[:, 2], initial=0.0))

    paths = [motion.positions[:, bodies[0]] for motion in tracks]
    shown = [path[np.linspace(0, len(path) - 1, FRAMED_POINTS).astype(int)] for path in paths]
    centres = np.concatenate([*shown, np.reshape([mark.position for mark in marks], (-1, 3))])
    radii = np.full(len(centres), size)
    radii[len(centres) - len(marks) :] = [mark.radius for mark in marks]

    grounded = bool(np.any(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE))
    flat = bool(np.ptp(tracks[0].positions[:, bodies, 1], axis=0).max() < PLANAR)
    x, y = (paths[0][-1] - paths[0][0])[:2]
    distance = math.hypot(x, y)
    x, y = (x / distance, y / distance) if distance > size else (1.0, 0.0)
    direction = (0.3 * x + y, 0.3 * y - x, 0.35)
    if flat:
        direction = (0.0, -1.0, 0.2 if grounded else 0.0)
    return Framing(size, above, below, centres, radii, direction, flat and not grounded)


def metric_grid(view: Framing) -> tuple[shapes.LineSegments, list[dict[str, Any]]]:
    """Lines in round metres behind a flat motion, and the labels along two edges."""
    low, high = view.box
    power = 10.0 ** math.floor(math.log10(view.extent / GRID_LINES))
    step = max(factor * power for factor in (1, 2, 5) if factor * power <= view.extent / GRID_LINES)
    behind = 2.0 * view.size
    first, last = np.floor((low - view.extent) / step), np.ceil((high + view.extent) / step)
    ends, labels = [], []
    for axis, across in ((0, 2), (2, 0)):
        for number in np.arange(first[axis], last[axis] + 1):
            line = np.full((2, 3), behind)
            line[:, axis] = number * step
            line[:, across] = first[across] * step, last[across] * step
            ends.append(line)
            if low[axis] <= number * step <= high[axis]:
                position = np.full(3, behind)
                position[axis], position[across] = number * step, low[across]
                text = f"{number * step:g} m"
                labels.append({"text": text, "position": position.tolist(), "faint": True})
    lines = np.concatenate(ends).astype(np.float32)
    material = shapes.LineBasicMaterial(color=scene.hexadecimal(PENCIL))
    return shapes.LineSegments(shapes.PointsGeometry(lines.T), material), labels


# The page


def _css(colour: Sequence[float]) -> str:
    return f"#{scene.hexadecimal(colour):06x}"


def _legend(actors: Sequence[Actor], marks: Sequence[Landmark]) -> Iterator[str]:
    entries = [(actor.name, actor.colour, actor.note) for actor in actors]
    for kind, note in (("goal", "where to go"), ("obstacle", "what to keep clear of")):
        entries += [(kind, m.colour[:3], note) for m in marks if m.text.startswith(kind)][:1]
    for name, colour, note in entries:
        swatch = f'style="--swatch: {_css(colour)}"'
        yield f"<li {swatch}><b>{html.escape(name)}</b>: {html.escape(note)}</li>"


def _viewer_file(name: str) -> str:
    return Path(meshcat.viewer_assets_path(), name).read_text("utf-8")


def _fill(template: str, contents: dict[str, str]) -> str:
    """The template with `{{name}}` replaced, in one pass: contents are not searched again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: contents[match[1]], template)


def _rows(summary: Sequence[tuple[str, str]]) -> Iterator[str]:
    for label, value in summary:
        yield f"<tr><td>{html.escape(label)}</td><td>{html.escape(value)}</td></tr>"


def _set_stage(root: Visualizer, model: mujoco.MjModel, view: Framing) -> None:
    """Sends what stands still: the place, without meshcat's own grid and lights."""
    for unwanted in UNWANTED:
        root[unwanted].set_property("visible", False)
    for side in ("top_color", "bottom_color"):
        root["/Background"].set_property(side, [value / 255 for value in SKY])
    elements = scene.parts(model, reach=3.0 * view.extent)
    scene.draw(root["place"], model, [part for part in elements if part.body == 0])


def _send_actor(
    root: Visualizer,
    model: mujoco.MjModel,
    actor: Actor,
    motion: Track,
    playback: Playback,
    view: Framing,
) -> dict[str, Any]:
    """Sends a robot, its path and its animation; returns what the player is told of them."""
    robot = [part for part in scene.parts(model) if part.body != 0]
    scene.draw(
        root[actor.name], model, robot, (*actor.colour, GHOST_OPACITY) if actor.ghost else None
    )
    bodies = scene.moving_bodies(model)
    for body in bodies:
        name = scene.node(model, body)
        position, quaternion = motion.positions[:, body], motion.quaternions[:, body]
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, quaternion[0])
        root[actor.name][name].set_transform(scene.frame(position[0], rotation))
        playback.move(f"meshcat/{actor.name}/{name}", motion.times, position, quaternion)
    tube, kept = trail(motion.positions[:, bodies[0]], TRAIL_RADIUS * view.size)
    ink = shapes.MeshBasicMaterial(color=scene.hexadecimal(actor.colour))
    root["path"][actor.name].set_object(tube, ink)
    return {
        "text": actor.name,
        "colour": _css(actor.colour),
        "node": f"meshcat/{actor.name}",
        "base": f"meshcat/{actor.name}/{scene.node(model, bodies[0])}",
        "ghost": actor.ghost,
        "rise": -view.below if actor.ghost else view.above,
        "trail": {
            "node": f"meshcat/path/{actor.name}/<object>",
            "times": np.where(actor.ghost, 0.0, motion.times[kept]).tolist(),
            "width": PLAN_WIDTH if actor.ghost else EXECUTED_WIDTH,
            "indices": 6 * TRAIL_SIDES,  # of triangles, from one time to the next
        },
    }


def render(
    model: mujoco.MjModel,
    actors: Sequence[Actor],
    title: str,
    summary: Sequence[tuple[str, str]],
) -> str:
    """The page's text.

    Args:
        model: with goal and obstacles in it.
        actors: who moves; the camera follows the first.
        title: what was run.
        summary: labels and values of the score.

    Raises:
        TsbenchError: a motion is not one of this model, or nothing in the model can move.
    """
    if not scene.moving_bodies(model):
        raise TsbenchError("nothing in this model can move")
    tracks = [track(model, actor) for actor in actors]
    marks = landmarks(model)
    view = framing(model, np.asarray(actors[0].qpos, float)[0], tracks, marks)
    labels: list[dict[str, Any]] = [
        {"text": m.text, "position": m.position, "rise": m.radius, "colour": _css(INK)}
        for m in marks
    ]

    recorder = Recorder()
    root = Visualizer(window=recorder)
    _set_stage(root, model, view)
    if view.flat:
        lines, distances = metric_grid(view)
        root["grid"].set_object(lines)
        labels += distances
    playback = Playback(max(float(motion.times[-1]) for motion in tracks))
    cast = [
        _send_actor(root, model, actor, motion, playback, view)
        for actor, motion in zip(actors, tracks, strict=True)
    ]
    if playback.clips:
        recorder.send(playback)

    data = {
        "commands": recorder.packed(),
        "duration": playback.duration if playback.clips else 0.0,
        "box": [corner.tolist() for corner in view.box],
        "spheres": np.column_stack([view.centres, view.radii]).round(3).tolist(),
        "size": view.size,
        "direction": view.direction,
        "sky": "rgb({}, {}, {})".format(*SKY),
        "actors": cast,
        "labels": labels,
    }
    return _fill(
        importlib.resources.files("tsbench.viewer").joinpath("page.html").read_text("utf-8"),
        {
            "title": html.escape(title),
            "summary": "".join(_rows(summary)),
            "legend": "".join(_legend(actors, marks)),
            "licences": "".join(map(_viewer_file, LICENCES)),
            "meshcat": _viewer_file("dist/main.min.js"),
            # "<" could end the script element that the data stand in.
            "page": json.dumps(data).replace("<", "\\u003c"),
        },
    )


def write_page(
    path: Path | str,
    model: mujoco.MjModel,
    executed: ArrayLike,
    timestep: float,
    *,
    ghost: ArrayLike | None = None,
    ghost_timestep: float | None = None,
    title: str,
    summary: Sequence[tuple[str, str]] = (),
    overwrite: bool = False,
) -> None:
    """Writes the page of one motion and, beside it, the plan that it was to follow.

    Args:
        path: the HTML file.
        model: compiled model, with goal and obstacles in it.
        executed: generalised positions of the executed motion, shape (T, nq).
        timestep: seconds between them.
        ghost: generalised positions of the plan, shape (T', nq).
        ghost_timestep: seconds between them; `timestep` when None.
        title: what was run.
        summary: labels and values of the score.
        overwrite: whether a file that is there may be replaced.

    Raises:
        TsbenchError: the file exists or cannot be written, or a motion is not one of this model.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise TsbenchError(f"{path} exists already; name another file or remove it")
    actors = [Actor("executed", executed, timestep, EXECUTED_COLOUR, EXECUTED_NOTE)]
    if ghost is not None:
        step = timestep if ghost_timestep is None else ghost_timestep
        actors.append(Actor("plan", ghost, step, PLAN_COLOUR, PLAN_NOTE, ghost=True))
    text = render(model, actors, title, summary)
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise TsbenchError(f"cannot write {path}: {error.strerror or error}") from error
