"""One self-contained HTML page that plays a motion: no server, no network.

The page holds meshcat's viewer, the drawing commands that a meshcat server would send, and a small
player (page.html) with captions. A `Recorder` replaces meshcat's connection to its server, so
making a page starts no process and opens no port.
"""

from __future__ import annotations

import base64
import html
import importlib.resources
import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import meshcat
import meshcat.geometry as shapes
import mujoco
import numpy as np
import umsgpack
from meshcat import Visualizer
from numpy.typing import NDArray

from tsbench.core.errors import TsbenchError
from tsbench.viewer import scene
from tsbench.viewer.framing import Framing, framing
from tsbench.viewer.scene import Array
from tsbench.viewer.show import (
    EXECUTED_COLOUR,
    GHOST_OPACITY,
    INK,
    PENCIL,
    PLAN_COLOUR,
    SKY,
    Actor,
    Band,
    Curve,
    Entry,
    Figures,
    Prop,
    Show,
    Track,
    track,
)

# Parts of meshcat's own scene. Its point lights reach 10 m, too little for a rocket.
UNWANTED = ("/Grid", "/Axes", "/Lights/PointLightNegativeX", "/Lights/PointLightPositiveX")
# The licences of meshcat and of the libraries bundled with it, which the page contains.
LICENCES = (
    "LICENSE",
    "dist/main.min.js.LICENSE.txt",
    "dist/main.min.js.THIRD_PARTY_LICENSES.json",
)

TRAIL_SIDES = 6  # sides of the tube along a path
TRAIL_POINTS = 600  # points of a path, at most
TRAIL_RADIUS = 0.004  # radius of the tube over the size of the robot
# page.html adds this to the radius, times the distance from the camera. The executed path is wider,
# so it covers the plan's where both coincide.
EXECUTED_WIDTH, PLAN_WIDTH = 0.0015, 0.0011
GRID_LINES = 5  # lines across the picture, at least
IDENTIFIER = re.compile(rb"[0-9a-f]{8}-[0-9a-f]{4}-1[0-9a-f]{3}-[0-9a-f]{4}-[0-9a-f]{12}")
UNBROKEN = 32  # characters of a table's row; a cell with its share of them stays on one line
STILL = 1e-6  # m or quaternion units; a node that moves less is not animated
JUMP = 1e-4  # s, the time of a jump from one scale to the next


class Recorder:
    """Replaces meshcat's `ViewerWindow`, and keeps the commands instead of sending them."""

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        self.commands.append(command.lower())

    def packed(self) -> list[str]:
        """The commands in the format of meshcat's page, in base64.

        meshcat's identifiers hold the time and the machine's network address. They are replaced by
        running numbers, so equal motions give equal pages, and a page does not reveal its machine.
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


class Playback:
    """meshcat's command that animates nodes, with typed arrays in place of maps per keyframe."""

    def __init__(self, duration: float) -> None:
        self.duration = duration
        self.clips: list[dict[str, Any]] = []

    def move(
        self,
        path: str,
        times: Array,
        position: Array,
        quaternion: Array,
        scale: Array | None = None,
    ) -> None:
        """Animates one node.

        Args:
            path: the node's path in meshcat's tree.
            times: seconds, shape (K,).
            position: metres, shape (K, 3).
            quaternion: (w, x, y, z), shape (K, 4).
            scale: held from each time to the next, shape (K, 3); None for no scaling.
        """
        channels = [
            (".position", "vector3", times, position),
            (".quaternion", "quaternion", times, np.roll(quaternion, -1, axis=-1)),
        ]
        if scale is not None:
            until = np.repeat(times, 2)[1:]
            until[1::2] -= JUMP
            channels.append((".scale", "vector3", until, np.repeat(scale, 2, axis=0)[:-1]))
        tracks = [
            {
                "name": name,
                "type": kind,
                "times": scene.packed(moments),
                "values": scene.packed(values),
            }
            for name, kind, moments, values in channels
            if np.ptp(values, axis=0).max() > STILL
        ]
        if tracks:
            clip = {"name": path, "fps": 1, "duration": self.duration, "tracks": tracks}
            self.clips.append({"path": path, "clip": clip})

    def lower(self) -> dict[str, Any]:
        options = {"play": True, "repetitions": 1}
        return {"type": "set_animation", "path": "", "animations": self.clips, "options": options}


def _unit(vectors: Array) -> Array:
    """Vectors (K, 3) scaled to length 1. Zero vectors, as where a path turns back, stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def trail(points: Array, radius: float) -> tuple[shapes.Geometry, NDArray[np.int64]]:
    """A tube along a path.

    Args:
        points: metres, shape (K, 3).
        radius: metres.

    Returns:
        The tube and the indices of the points that it passes through. Points too close to the one
        before are left out. A path that stays in one place has one point and no tube.
    """
    travelled = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    spacing = max(0.5 * radius, travelled[-1] / TRAIL_POINTS)
    kept = np.unique(np.floor(travelled / spacing), return_index=True)[1]
    path = points[kept]
    if len(path) < 2:
        return scene.surface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3))), kept
    tangent = np.gradient(path, axis=0)
    # The direction of least spread is rarely parallel to the path, so the cross product is defined.
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


def metric_grid(view: Framing) -> tuple[shapes.LineSegments, list[dict[str, Any]]]:
    """Lines at round numbers of metres behind a flat motion, and labels along two edges."""
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


def css(colour: Sequence[float]) -> str:
    """A colour in the notation of style sheets, #rrggbb."""
    return f"#{scene.hexadecimal(colour):06x}"


def _entries(show: Show) -> Iterator[Entry]:
    yield from (Entry(actor.name, actor.colour, actor.note) for actor in show.actors)
    for kind, note in (("goal", "the position to reach"), ("obstacle", "to be avoided")):
        marks = [mark for mark in show.landmarks if mark.text.startswith(kind)]
        yield from (Entry(kind, mark.colour[:3], note) for mark in marks[:1])
    yield from show.legend


def _legend(show: Show) -> Iterator[str]:
    for entry in _entries(show):
        swatch = f'style="--swatch: {css(entry.colour)}"'
        yield f"<li {swatch}><b>{html.escape(entry.name)}</b>: {html.escape(entry.note)}</li>"


def _viewer_file(name: str) -> str:
    return Path(meshcat.viewer_assets_path(), name).read_text("utf-8")


def fill(template: str, contents: dict[str, str]) -> str:
    """A template of this package with each `{{name}}` replaced, in one pass: names within the
    contents are not replaced."""
    text = importlib.resources.files("tsbench.viewer").joinpath(template).read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: contents[match[1]], text)


def embedded(data: Any) -> str:
    """JSON for a script element, with "<" escaped, which could end the element."""
    return json.dumps(data).replace("<", "\\u003c")


def _table(table: Figures) -> str:
    def line(kind: str, cells: Sequence[str]) -> str:
        most = UNBROKEN // len(cells)
        whole = (cell.replace(" ", "\u00a0") if len(cell) <= most else cell for cell in cells)
        inside = "".join(f"<{kind}>{html.escape(cell)}</{kind}>" for cell in whole)
        return f"<tr>{inside}</tr>"

    return f"<table>{line('th', table.heads)}{''.join(line('td', r) for r in table.rows)}</table>"


def _headings(show: Show) -> Iterator[str]:
    for value, words in show.headings:
        yield f'<option value="{html.escape(value)}">{html.escape(words)}</option>'


def _set_stage(root: Visualizer, model: mujoco.MjModel, view: Framing) -> None:
    """Sends the static parts of the scene, and hides meshcat's own grid and lights."""
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
    """Sends a robot, its path and its animation; returns the robot's data for the player."""
    own = actor.name.replace("/", ":")  # "/" separates the parts of meshcat's paths
    robot = [part for part in scene.parts(model) if part.body != 0]
    scene.draw(root[own], model, robot, (*actor.colour, GHOST_OPACITY) if actor.ghost else None)
    bodies = scene.moving_bodies(model)
    for body in bodies:
        name = scene.node(model, body)
        position, quaternion = motion.positions[:, body], motion.quaternions[:, body]
        root[own][name].set_transform(scene.placed(position[0], quaternion[0]))
        playback.move(f"meshcat/{own}/{name}", motion.times, position, quaternion)
    tube, kept = trail(motion.positions[:, bodies[0]], TRAIL_RADIUS * view.size)
    ink = shapes.MeshBasicMaterial(color=scene.hexadecimal(actor.colour))
    root["path"][own].set_object(tube, ink)
    return {
        "text": actor.name,
        "colour": css(actor.colour),
        "node": f"meshcat/{own}",
        "base": f"meshcat/{own}/{scene.node(model, bodies[0])}",
        "ghost": actor.ghost,
        "end": actor.ending and {"time": float(motion.times[-1]), "text": actor.ending},
        "rise": -view.below if actor.ghost else view.above,
        "trail": {
            "node": f"meshcat/path/{own}/<object>",
            "times": np.where(actor.ghost, 0.0, motion.times[kept]).tolist(),
            "width": PLAN_WIDTH if actor.ghost else EXECUTED_WIDTH,
            "indices": 6 * TRAIL_SIDES,  # vertex indices between two times
        },
    }


def _send_prop(root: Visualizer, prop: Prop, playback: Playback) -> None:
    """Sends a prop and its animation. A prop that is never visible is left out."""
    if not prop.scale.any():
        return
    still = np.ptp(prop.scale, axis=0).max() <= STILL
    place = root["props"][prop.name]
    scene.draw_shape(place["shape"], prop.geom, prop.size, prop.colour)
    # Only the animation sets a changing scale: a matrix scaled by zero has no orientation.
    first = prop.scale[0] if still else np.ones(3)
    place.set_transform(scene.placed(prop.position[0], prop.quaternion[0]) @ np.diag([*first, 1]))
    path = f"meshcat/props/{prop.name}"
    playback.move(path, prop.times, prop.position, prop.quaternion, prop.scale)


def _timeline(rows: Sequence[Band | Curve]) -> Iterator[dict[str, Any]]:
    """The rows of the timeline as data for the player, with numbers to four digits."""
    for row in rows:
        if isinstance(row, Band):
            yield {"text": row.text, "planned": row.planned, "executed": row.executed}
        else:
            lines = [
                {
                    "colour": css(colour),
                    "times": [round(float(t), 3) for t in times],
                    "values": [float(f"{value:.4g}") for value in values],
                }
                for colour, times, values in row.lines
            ]
            yield {"text": row.text, "lines": lines}


def render(show: Show, *, served: bool = False) -> str:
    """The HTML text of the page.

    Args:
        show: the show to draw.
        served: whether a server can play the episode again with a push.

    Raises:
        TsbenchError: a motion does not fit the show's model, or no body of the model can move.
    """
    model, actors = show.model, show.actors
    if not scene.moving_bodies(model):
        raise TsbenchError("nothing in this model can move")
    tracks = [track(model, actor) for actor in actors]
    view = framing(model, np.asarray(actors[0].qpos, float)[0], tracks, show.landmarks)
    labels: list[dict[str, Any]] = [
        {"text": m.text, "position": m.position, "rise": m.radius, "colour": css(INK)}
        for m in show.landmarks
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
    for prop in show.props:
        _send_prop(root, prop, playback)
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
        "timeline": list(_timeline(show.timeline)),
        "colours": {"planned": css(PLAN_COLOUR), "executed": css(EXECUTED_COLOUR)},
        "served": served,
    }
    return fill(
        "page.html",
        {
            "title": html.escape(show.title),
            "verdict": html.escape(show.verdict),
            "tables": "".join(map(_table, show.tables)),
            "alternative": html.escape(f"{show.title} in 3-D. {show.verdict}"),
            "headings": "".join(_headings(show)),
            "robot": html.escape(show.robot),
            "legend": "".join(_legend(show)),
            "licences": "".join(map(_viewer_file, LICENCES)),
            "meshcat": _viewer_file("dist/main.min.js"),
            "page": embedded(data),
        },
    )
