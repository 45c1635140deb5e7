"""Videos and motion strips of a show, drawn by MuJoCo's own renderer without a window."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import os
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from tsbench.core.errors import TsbenchError, os_errors
from tsbench.core.files import check_ending, check_new, write_new
from tsbench.viewer import scene
from tsbench.viewer.framing import Framing, framing
from tsbench.viewer.scene import Array
from tsbench.viewer.show import GHOST_OPACITY, Actor, Prop, Rgb, Show, track

try:
    import imageio_ffmpeg
except ImportError:  # of the extra `video`
    imageio_ffmpeg = None

Picture = NDArray[np.uint8]  # (height, width, 3)
Progress = Callable[[float], None]  # takes the share that is done

SIZE, SMALL_SIZE = (960, 540), (640, 360)  # pixels of a video; the smaller one without a GPU
INSET = 0.42  # side of its close-up over its height
SOFTWARE = re.compile(r"llvmpipe|softpipe|swrast|swiftshader|software", re.IGNORECASE)
QUALITY, SLOW_QUALITY = (4, 28, 16), (0, 14, 8)  # samples, slices, stacks (MuJoCo's visual)
SMALL = 0.4  # robot size over half the picture's height; below this a close-up is drawn
FRAMES_PER_SECOND = 30
CELL = 300  # pixels, side of a strip's picture
MAX_SHAPES = 10_000  # in one picture
TRAIL_PIECES = 120  # pieces of a drawn path, at most
PATH_WIDTH = 3.0  # pixels
FIELD_OF_VIEW = 35.0  # degrees
TEXT, GROUND = (29, 39, 51), (244, 246, 248)  # red, green, blue of 255
EDGE = 12  # pixels between the edge of a picture and what lies over it
SMALLEST = 8  # pixels, of text


def write_video(show: Show, path: Path, progress: Progress | None = None) -> None:
    """Writes an MP4 in real time at 30 frames a second; its last frame stays for a second.

    Without a GPU it is smaller and its edges are not smoothed.

    Args:
        show: the show to draw.
        path: a new file.
        progress: called after each frame with the share that is done, up to 1.

    Raises:
        TsbenchError: no OpenGL or no encoder works here, or the file exists or cannot be written.
    """
    check_ending(path, ".mp4")
    check_new(path)
    if imageio_ffmpeg is None:
        raise TsbenchError("videos need an encoder: pip install 'tsbench[video]' (imageio-ffmpeg)")
    # ffmpeg replaces files and follows links, so it writes into a folder of its own.
    with Camera(show) as camera, os_errors(path), tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / "film.mp4"
        writer = imageio_ffmpeg.write_frames(
            str(drawn), camera.size, fps=FRAMES_PER_SECOND, quality=7, macro_block_size=4
        )
        with contextlib.closing(writer):
            writer.send(None)
            times = np.arange(0.0, camera.duration, 1.0 / FRAMES_PER_SECOND)
            for number, time in enumerate(times):
                writer.send(camera.frame(float(time)))
                if progress is not None:
                    progress((number + 1) / len(times))
            last = camera.frame(camera.duration)
            for _ in range(FRAMES_PER_SECOND):
                writer.send(last)
        write_new(path, drawn.read_bytes())


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
    check_ending(path, ".png")
    check_new(path)
    rows = sorted(show.actors, key=lambda actor: not actor.ghost)
    widest = max(_font(18).getlength(actor.name) for actor in rows)
    gutter, header = max(110, math.ceil(widest) + 2 * EDGE), 34
    strip = Image.new("RGB", (gutter + count * CELL, header + len(rows) * CELL), "white")
    pen = ImageDraw.Draw(strip)
    with Camera(show, (CELL, CELL)) as camera:
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
    content = io.BytesIO()
    strip.save(content, "PNG", optimize=True)
    write_new(path, content.getvalue())


class Camera:
    """Draws pictures of a show.

    Attributes:
        size: width and height of a picture in pixels.
        duration: seconds of the show.
    """

    def __init__(self, show: Show, size: tuple[int, int] | None = None) -> None:
        """
        Args:
            show: the show to draw.
            size: width and height in pixels; None for those of a video.

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
        self._canvas = Canvas(show.model, size)
        self.size = self._canvas.size

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *_: object) -> None:
        self._canvas.close()

    def frame(self, time: float) -> Picture:
        """The whole scene at a time in seconds, (H, W, 3), with a close-up of a small robot."""
        width, height = self.size
        low, high = self.view.box
        centre = (low + high) / 2
        distance = _distance(self.view, centre, width / height)
        everybody = self.show.actors
        whole = mujoco.MjrRect(0, 0, width, height)
        shots = [Shot(everybody, centre, distance, whole)]
        robot = self.view.size / (distance * math.tan(math.radians(FIELD_OF_VIEW / 2)))
        box = self._corner(centre, distance) if robot < SMALL else None
        if box is not None:
            shots.append(self._close(everybody, everybody[0], time, box))
        picture = Image.fromarray(self._take(shots, time))
        pen = ImageDraw.Draw(picture)
        room = width - 3 * EDGE
        if box is not None:
            top = height - box.bottom - box.height
            frame = (box.left, top, box.left + box.width, top + box.height)
            pen.rectangle(frame, outline="white", width=2)
            room -= box.width
        large, small = height // 30, height // 34
        _caption(pen, EDGE, EDGE, self.show.title, TEXT, large, room)
        for index, (actor, motion) in enumerate(zip(everybody, self.tracks, strict=True)):
            ended = actor.ending and time > motion.times[-1] - 1e-6
            text = f"{actor.name}: {actor.ending}" if ended else actor.name
            top = EDGE + 2 * large * (index + 1)
            _caption(pen, EDGE, top, text, _bytes(actor.colour), small, room)
        _caption(pen, EDGE, height - EDGE - 2 * large, f"{time:.2f} s", TEXT, large, room)
        return np.asarray(picture)

    def _corner(self, target: Array, distance: float) -> mujoco.MjrRect | None:
        """A corner on the right, for a close-up that covers neither a path nor a place. None if
        there is no such corner."""
        width, height = self.size
        side = round(INSET * height)
        forward, right, up = _axes(self.view)
        offset = self.view.centres - target
        focal = height / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
        scale = focal / (distance - offset @ forward)  # pixels per metre
        x, y = width / 2 + scale * (offset @ right), height / 2 + scale * (offset @ up)
        reach, left = scale * self.view.radii, width - side - EDGE
        for below in (height - side - EDGE, EDGE):
            beside = (x + reach < left) | (y + reach < below) | (y - reach > below + side)
            if beside.all():
                return mujoco.MjrRect(left, below, side, side)
        return None

    def portrait(self, actor: Actor, time: float) -> Picture:
        """A close-up of one actor alone at a time in seconds, (H, W, 3)."""
        box = mujoco.MjrRect(0, 0, *self.size)
        return self._take([self._close([actor], actor, time, box)], time)

    def _close(
        self, cast: Sequence[Actor], middle: Actor, time: float, box: mujoco.MjrRect
    ) -> Shot:
        motion = self.tracks[self.show.actors.index(middle)]
        target = motion.positions[_index(motion.times, time), self._base]
        distance = 1.3 * self.view.size / math.sin(math.radians(FIELD_OF_VIEW / 2))
        return Shot(cast, target, distance, box)

    def _take(self, shots: Sequence[Shot], time: float) -> Picture:
        """The picture with all shots. Ghosts beside other actors are blended into it as a whole, so
        that no part of one hides another."""
        kinds = {actor.ghost for shot in shots for actor in shot.cast}
        pictures = []
        for ghosts in (False, True) if len(kinds) > 1 else (True,):
            for shot in shots:
                self._draw(shot, time, ghosts=ghosts)
            pictures.append(self._canvas.read())
        blended = (1.0 - GHOST_OPACITY) * pictures[0] + GHOST_OPACITY * pictures[-1]
        return blended.round().astype(np.uint8)

    def _draw(self, shot: Shot, time: float, *, ghosts: bool) -> None:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:], camera.distance = shot.target, shot.distance
        x, y, z = np.asarray(self.view.direction) / np.linalg.norm(self.view.direction)
        camera.azimuth = math.degrees(math.atan2(-y, -x))
        camera.elevation = -math.degrees(math.asin(z))
        option = mujoco.MjvOption()
        option.geomgroup[scene.VISIBLE_GROUPS :] = 0
        option.sitegroup[scene.VISIBLE_GROUPS :] = 0
        model, data, world = self.show.model, self._data, self._canvas.world
        static, moving = mujoco.mjtCatBit.mjCAT_STATIC, mujoco.mjtCatBit.mjCAT_DYNAMIC
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mjv_updateScene(model, data, option, None, camera, static, world)
        for actor in shot.cast:
            motion = self.tracks[self.show.actors.index(actor)]
            index = _index(motion.times, time)
            data.qpos[:] = np.asarray(actor.qpos, float)[
                min(round(motion.times[index] / actor.timestep), len(np.asarray(actor.qpos)) - 1)
            ]
            mujoco.mj_kinematics(model, data)
            first = world.ngeom
            if ghosts or not actor.ghost:
                mujoco.mjv_addGeoms(model, data, option, mujoco.MjvPerturb(), moving, world)
            for geom in world.geoms[first : world.ngeom]:
                geom.pos[1] += actor.lane
                if actor.ghost:
                    _tint(geom, actor.colour)
            path = motion.positions[:, self._base]
            _add_path(world, path if actor.ghost else path[: index + 1], actor.colour)
            for prop in self.show.props:
                if prop.actor == actor.name:
                    _add_prop(world, prop, time)
        self._canvas.draw(shot.box)


@dataclass(frozen=True, eq=False)
class Shot:
    """A view of some actors in a part of a picture.

    Attributes:
        cast: the actors.
        target: the point in the middle; world frame, metres, shape (3,).
        distance: metres from the target to the camera.
        box: the part of the picture in pixels, from its lower left corner.
    """

    cast: Sequence[Actor]
    target: Array
    distance: float
    box: mujoco.MjrRect


class Canvas:
    """MuJoCo's renderer without a window. It draws no shadows, which would take most of the time
    without a GPU.

    Attributes:
        size: width and height in pixels.
        world: the shapes to draw.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int] | None) -> None:
        """
        Args:
            model: compiled model, whose visual settings are changed.
            size: width and height in pixels; None for those of a video, which is smaller and
                plainer without a GPU.

        Raises:
            TsbenchError: no OpenGL works here.
        """
        try:
            self._context = mujoco.GLContext(*SIZE)
            self._context.make_current()
            # Each OpenGL library loads its functions when its context is first made.
            opengl = import_module("OpenGL.GL")
            renderer = opengl.glGetString(opengl.GL_RENDERER).decode()
            slow = size is None and SOFTWARE.search(renderer)
            self.size = size or (SMALL_SIZE if slow else SIZE)
            look, quality = model.vis.global_, model.vis.quality
            look.fovy, (look.offwidth, look.offheight) = FIELD_OF_VIEW, self.size
            quality.offsamples, quality.numslices, quality.numstacks = (
                SLOW_QUALITY if slow else QUALITY
            )
            self._drawn = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # each OpenGL library raises its own errors
            chosen = os.environ.get("MUJOCO_GL", "the default")
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise TsbenchError(f"OpenGL ({chosen}) draws no pictures here: {reason}") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawn)
        self.world = mujoco.MjvScene(model, MAX_SHAPES)
        self.world.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0

    def draw(self, box: mujoco.MjrRect) -> None:
        """Draws the world into a part of the picture."""
        mujoco.mjr_render(box, self.world, self._drawn)

    def read(self) -> Picture:
        """The picture, shape (H, W, 3)."""
        width, height = self.size
        pixels = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, mujoco.MjrRect(0, 0, width, height), self._drawn)
        return pixels[::-1]

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._drawn.free()
        self._context.free()


def _index(times: Array, time: float) -> int:
    """The index of the last of the times (K,) that is not after `time`."""
    return max(int(np.searchsorted(times, time + 1e-9, side="right")) - 1, 0)


def _tint(geom: mujoco.MjvGeom, colour: Rgb) -> None:
    geom.matid = -1
    geom.rgba[:] = (*colour, 1.0)


def _next(world: mujoco.MjvScene) -> mujoco.MjvGeom:
    """A new geom at the end of the scene.

    Raises:
        TsbenchError: the scene is full.
    """
    if world.ngeom >= world.maxgeom:
        raise TsbenchError(f"a picture holds at most {world.maxgeom} shapes")
    world.ngeom += 1
    return world.geoms[world.ngeom - 1]


def _add_path(world: mujoco.MjvScene, path: Array, colour: Rgb) -> None:
    points = path[np.unique(np.linspace(0, len(path) - 1, TRAIL_PIECES).astype(int))]
    for begin, end in itertools.pairwise(points):
        geom = _next(world)
        shape, none = mujoco.mjtGeom.mjGEOM_LINE, np.zeros(3)
        mujoco.mjv_initGeom(
            geom, shape, none, none, np.eye(3).ravel(), np.array([*colour, 1.0], np.float32)
        )
        mujoco.mjv_connector(geom, shape, PATH_WIDTH, begin, end)


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
    forward, right, up = _axes(view)
    offset, tall = view.centres - target, 0.9 * math.tan(math.radians(FIELD_OF_VIEW / 2))
    needed = np.maximum(
        (np.abs(offset @ right) + view.radii) / (tall * ratio),
        (np.abs(offset @ up) + view.radii) / tall,
    )
    return float(np.max(offset @ forward + needed))


def _axes(view: Framing) -> tuple[Array, Array, Array]:
    """Unit vectors towards the camera, to the right and up in the picture, each of shape (3,)."""
    forward = np.asarray(view.direction) / np.linalg.norm(view.direction)
    right = np.cross([0.0, 0.0, 1.0], forward)
    right /= np.linalg.norm(right)
    return forward, right, np.cross(forward, right)


def _caption(
    pen: ImageDraw.ImageDraw,
    left: int,
    top: int,
    text: str,
    colour: tuple[int, int, int],
    size: int,
    room: int,
) -> None:
    """Writes a line on a light ground, smaller if it would be wider than `room`; in pixels."""
    while size > SMALLEST and pen.textlength(text, _font(size)) > room:
        size -= 1
    x0, y0, x1, y1 = pen.textbbox((left, top), text, _font(size))
    pen.rounded_rectangle((x0 - 5, y0 - 3, x1 + 5, y1 + 3), 4, fill=GROUND)
    pen.text((left, top), text, colour, _font(size))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _bytes(colour: Rgb) -> tuple[int, int, int]:
    red, green, blue = (round(255 * value) for value in colour)
    return red, green, blue
