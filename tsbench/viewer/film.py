"""Videos and motion strips of a show, drawn by MuJoCo's own renderer without a window."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from tsbench.core.errors import TsbenchError
from tsbench.core.files import check_new
from tsbench.viewer import scene
from tsbench.viewer.framing import Framing, framing
from tsbench.viewer.scene import Array
from tsbench.viewer.show import GHOST_OPACITY, Actor, Prop, Rgb, Show, track

try:
    import imageio_ffmpeg
except ImportError:  # of the extra `video`
    imageio_ffmpeg = None

Picture = NDArray[np.uint8]  # (height, width, 3)

WIDTH, HEIGHT = 960, 540  # pixels of a video
INSET = 240  # pixels, side of its close-up
SMALL = 0.4  # robot size over half the picture's height; below this a close-up is drawn
FRAMES_PER_SECOND = 30
CELL = 300  # pixels, side of a strip's picture
MAX_SHAPES = 10_000  # in one picture
TRAIL_PIECES = 120  # pieces of a drawn path, at most
PATH_WIDTH = 0.0015  # width of a path over the distance from the camera
FIELD_OF_VIEW = 35.0  # degrees
TEXT = (29, 39, 51)  # red, green, blue of 255


def write_video(show: Show, path: Path) -> None:
    """Writes an MP4 in real time at 30 frames a second; its last frame stays for a second.

    Args:
        show: the show to draw.
        path: a new file.

    Raises:
        TsbenchError: no OpenGL or no encoder works here, or the file exists or cannot be written.
    """
    _refuse(path, ".mp4")
    if imageio_ffmpeg is None:
        raise TsbenchError("videos need an encoder: pip install 'tsbench[video]' (imageio-ffmpeg)")
    temporary = path.with_name(path.name + ".part.mp4")  # ffmpeg chooses the format by the ending
    with Camera(show, WIDTH, HEIGHT) as camera, _removed(temporary, path):
        writer = imageio_ffmpeg.write_frames(
            str(temporary), (WIDTH, HEIGHT), fps=FRAMES_PER_SECOND, quality=7, macro_block_size=4
        )
        with contextlib.closing(writer):
            writer.send(None)
            for time in np.arange(0.0, camera.duration + 1.0, 1.0 / FRAMES_PER_SECOND):
                writer.send(camera.frame(min(float(time), camera.duration)))
        temporary.replace(path)


def write_strip(show: Show, path: Path, count: int = 6) -> None:
    """Writes a PNG with `count` moments from left to right and a row for each actor, the plan
    above the execution.

    Args:
        show: the show to draw.
        path: a new file.
        count: number of moments.

    Raises:
        TsbenchError: no OpenGL works here, or the file exists or cannot be written.
    """
    _refuse(path, ".png")
    rows = sorted(show.actors, key=lambda actor: not actor.ghost)
    gutter, header = 110, 34
    strip = Image.new("RGB", (gutter + count * CELL, header + len(rows) * CELL), "white")
    pen = ImageDraw.Draw(strip)
    with Camera(show, CELL, CELL) as camera:
        for column, time in enumerate(np.linspace(0.0, camera.duration, count)):
            x = gutter + column * CELL
            pen.text((x + CELL / 2, header / 2), f"{time:.2f} s", TEXT, _font(18), anchor="mm")
            for row, actor in enumerate(rows):
                cell = Image.fromarray(camera.portrait(actor, float(time)))
                end = float(camera.tracks[show.actors.index(actor)].times[-1])
                if time > end + 1e-6:
                    note = f"ended after {end:.2f} s"
                    ImageDraw.Draw(cell).text((10, 8), note, TEXT, _font(16))
                strip.paste(cell, (x, header + row * CELL))
        for row, actor in enumerate(rows):
            middle = header + (row + 0.5) * CELL
            pen.text((gutter / 2, middle), actor.name, _bytes(actor.colour), _font(18), anchor="mm")
    temporary = path.with_name(path.name + ".part")
    with _removed(temporary, path):
        strip.save(temporary, "PNG", optimize=True)
        temporary.replace(path)


class Camera:
    """Draws pictures of a show.

    Attributes:
        duration: seconds of the show.
    """

    def __init__(self, show: Show, width: int, height: int) -> None:
        """
        Raises:
            TsbenchError: no OpenGL works here, or a motion does not fit the show's model.
        """
        self.show = show
        self.tracks = [track(show.model, actor) for actor in show.actors]
        self.duration = max(float(motion.times[-1]) for motion in self.tracks)
        start = np.asarray(show.actors[0].qpos, float)[0]
        self.view = framing(show.model, start, self.tracks, show.landmarks)
        self._base = scene.moving_bodies(show.model)[0]
        self._data = mujoco.MjData(show.model)
        show.model.vis.global_.fovy = FIELD_OF_VIEW
        show.model.vis.global_.offwidth = max(width, INSET)
        show.model.vis.global_.offheight = max(height, INSET)
        self._large, self._small = _renderers(show.model, ((width, height), (INSET, INSET)))

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *_: object) -> None:
        self._large.close()
        self._small.close()

    def frame(self, time: float) -> Picture:
        """The whole scene at a time in seconds, (H, W, 3), with a close-up of a small robot."""
        width, height = self._large.width, self._large.height
        low, high = self.view.box
        centre = (low + high) / 2
        distance = _distance(self.view, centre, width / height)
        everybody = self.show.actors
        picture = Image.fromarray(self._take(self._large, everybody, time, centre, distance))
        pen = ImageDraw.Draw(picture)
        pen.text((16, 12), self.show.title, TEXT, _font(18))
        for index, actor in enumerate(everybody):
            pen.text((16, 40 + 24 * index), actor.name, _bytes(actor.colour), _font(16))
        pen.text((16, height - 16), f"{time:.2f} s", TEXT, _font(18), anchor="ls")
        if self.view.size / (distance * math.tan(math.radians(FIELD_OF_VIEW / 2))) < SMALL:
            inset = self._close(self._small, everybody, everybody[0], time)
            # The close-up covers the top where there is ground, the bottom in a flat world, whose
            # goal may be at the top.
            left, top = width - INSET - 12, height - INSET - 12 if self.view.flat else 12
            picture.paste(Image.fromarray(inset), (left, top))
            pen.rectangle((left, top, left + INSET, top + INSET), outline="white", width=2)
        return np.asarray(picture)

    def portrait(self, actor: Actor, time: float) -> Picture:
        """A close-up of one actor alone at a time in seconds, (H, W, 3)."""
        return self._close(self._large, [actor], actor, time)

    def _close(
        self, renderer: mujoco.Renderer, cast: Sequence[Actor], middle: Actor, time: float
    ) -> Picture:
        motion = self.tracks[self.show.actors.index(middle)]
        target = motion.positions[_index(motion.times, time), self._base]
        distance = 1.3 * self.view.size / math.sin(math.radians(FIELD_OF_VIEW / 2))
        return self._take(renderer, cast, time, target, distance)

    def _take(
        self,
        renderer: mujoco.Renderer,
        cast: Sequence[Actor],
        time: float,
        target: Array,
        distance: float,
    ) -> Picture:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:], camera.distance = target, distance
        x, y, z = np.asarray(self.view.direction) / np.linalg.norm(self.view.direction)
        camera.azimuth = math.degrees(math.atan2(-y, -x))
        camera.elevation = -math.degrees(math.asin(z))
        option = mujoco.MjvOption()
        option.geomgroup[scene.VISIBLE_GROUPS :] = 0
        option.sitegroup[scene.VISIBLE_GROUPS :] = 0
        model, data, world = self.show.model, self._data, renderer.scene
        static, moving = mujoco.mjtCatBit.mjCAT_STATIC, mujoco.mjtCatBit.mjCAT_DYNAMIC
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mjv_updateScene(model, data, option, None, camera, static, world)
        for actor in cast:
            motion = self.tracks[self.show.actors.index(actor)]
            index = _index(motion.times, time)
            data.qpos[:] = np.asarray(actor.qpos, float)[
                min(round(motion.times[index] / actor.timestep), len(np.asarray(actor.qpos)) - 1)
            ]
            mujoco.mj_kinematics(model, data)
            first = world.ngeom
            mujoco.mjv_addGeoms(model, data, option, mujoco.MjvPerturb(), moving, world)
            for geom in world.geoms[first : world.ngeom]:
                geom.pos[1] += actor.lane
                if actor.ghost:
                    _tint(geom, actor.colour)
            path = motion.positions[:, self._base]
            _add_path(world, path if actor.ghost else path[: index + 1], actor.colour, distance)
            for prop in self.show.props:
                if prop.actor == actor.name:
                    _add_prop(world, prop, time)
        return np.array(renderer.render())


def _renderers(
    model: mujoco.MjModel, sizes: Sequence[tuple[int, int]]
) -> Iterator[mujoco.Renderer]:
    """Renderers for pictures of the given widths and heights in pixels. They draw no shadows, which
    would take most of the time without a graphics card.

    Raises:
        TsbenchError: no OpenGL works here.
    """
    for width, height in sizes:
        try:
            renderer = mujoco.Renderer(model, height, width, max_geom=MAX_SHAPES)
        except Exception as error:  # each OpenGL library raises its own errors
            chosen = os.environ.get("MUJOCO_GL", "the default")
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise TsbenchError(f"OpenGL ({chosen}) draws no pictures here: {reason}") from error
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        yield renderer


def _index(times: Array, time: float) -> int:
    """The index of the last of the times (K,) that is not after `time`."""
    return max(int(np.searchsorted(times, time + 1e-9, side="right")) - 1, 0)


def _tint(geom: mujoco.MjvGeom, colour: Rgb) -> None:
    geom.matid = -1
    geom.rgba[:] = (*colour, GHOST_OPACITY)
    geom.transparent = 1


def _next(world: mujoco.MjvScene) -> mujoco.MjvGeom:
    """A new geom at the end of the scene.

    Raises:
        TsbenchError: the scene is full.
    """
    if world.ngeom >= world.maxgeom:
        raise TsbenchError(f"a picture holds at most {world.maxgeom} shapes")
    world.ngeom += 1
    return world.geoms[world.ngeom - 1]


def _add_path(world: mujoco.MjvScene, path: Array, colour: Rgb, distance: float) -> None:
    points = path[np.unique(np.linspace(0, len(path) - 1, TRAIL_PIECES).astype(int))]
    for begin, end in itertools.pairwise(points):
        geom = _next(world)
        shape, none = mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3)
        mujoco.mjv_initGeom(
            geom, shape, none, none, np.eye(3).ravel(), np.array([*colour, 1.0], np.float32)
        )
        mujoco.mjv_connector(geom, shape, PATH_WIDTH * distance, begin, end)


def _add_prop(world: mujoco.MjvScene, prop: Prop, time: float) -> None:
    index = _index(prop.times, time)
    if not prop.scale[index].all():
        return
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, prop.quaternion[index])
    position, colour = prop.position[index], np.array(prop.colour, np.float32)
    geom = _next(world)
    size, scale = np.resize(prop.size, 3), prop.scale[index]
    mujoco.mjv_initGeom(geom, prop.geom, size, position, rotation, colour)
    geom.size *= scale
    if prop.geom == mujoco.mjtGeom.mjGEOM_ARROW:
        tip = position + prop.size[1] * scale[2] * rotation.reshape(3, 3)[:, 2]
        mujoco.mjv_connector(geom, prop.geom, prop.size[0], position, tip)


def _distance(view: Framing, target: Array, ratio: float) -> float:
    """The camera's distance in metres from the target at which the whole show fits into a picture
    with `ratio` of width to height."""
    forward = np.asarray(view.direction) / np.linalg.norm(view.direction)
    right = np.cross([0.0, 0.0, 1.0], forward)
    right /= np.linalg.norm(right)
    up = np.cross(forward, right)
    offset, tall = view.centres - target, 0.9 * math.tan(math.radians(FIELD_OF_VIEW / 2))
    needed = np.maximum(
        (np.abs(offset @ right) + view.radii) / (tall * ratio),
        (np.abs(offset @ up) + view.radii) / tall,
    )
    return float(np.max(offset @ forward + needed))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _bytes(colour: Rgb) -> tuple[int, int, int]:
    red, green, blue = (round(255 * value) for value in colour)
    return red, green, blue


def _refuse(path: Path, ending: str) -> None:
    """Checks the path of a new file.

    Raises:
        TsbenchError: the file exists or cannot be made, or its name has another ending.
    """
    if path.suffix.lower() != ending:
        raise TsbenchError(f"{path} must end in {ending}")
    check_new(path)


@contextlib.contextmanager
def _removed(temporary: Path, path: Path) -> Iterator[None]:
    """Removes the temporary file at the end, and names the file in errors.

    Raises:
        TsbenchError: the file cannot be written.
    """
    try:
        yield
    except OSError as error:
        reason = str(error.strerror or error).partition("\n")[0]
        raise TsbenchError(f"cannot write {path}: {reason}") from error
    finally:
        temporary.unlink(missing_ok=True)
