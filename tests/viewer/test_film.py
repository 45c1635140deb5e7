"""Videos and motion strips, made by the command line with the OpenGL library that works here."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tsbench import cli
from tsbench.core.errors import TsbenchError
from tsbench.viewer import film
from tsbench.viewer.show import (
    EXECUTED_COLOUR,
    GHOST_OPACITY,
    PLAN_COLOUR,
    PUSH_COLOUR,
    Actor,
    Show,
)


def near(picture: NDArray[np.int64], colour: tuple[float, float, float]) -> int:
    """The number of pixels with about this hue: the colour's brightest channels are theirs."""
    target = np.array(colour) / max(colour)
    bright = picture.max(axis=-1, keepdims=True)
    close = np.abs(picture / np.maximum(bright, 1) - target).max(axis=-1) < 0.25
    return int((close & (bright[..., 0] > 60)).sum())


def view(*words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tsbench", "view", *words], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_a_strip_shows_the_plan_above_the_execution_and_a_push_while_it_lasts(
    make_run: Callable[..., Path], tmp_path: Path
) -> None:
    path = tmp_path / "strip.png"
    view(str(make_run("laikago_trot")), "--push", "60N@1.15s:-y", "--strip", str(path))
    strip = np.asarray(Image.open(path).convert("RGB"), np.int64)
    side = film.CELL
    assert strip.shape == (34 + 2 * side, 110 + 6 * side, 3)
    planned, executed = (
        [strip[top : top + side, 110 + side * i : 110 + side * (i + 1)] for i in range(6)]
        for top in (34, 34 + side)
    )
    for above, below in zip(planned, executed, strict=True):
        assert near(above, PLAN_COLOUR) > 5 * near(below, PLAN_COLOUR)
        assert (below.max(axis=-1) < 60).sum() > 500  # Laikago is black
    arrows = [near(cell, PUSH_COLOUR) for cell in executed]
    assert np.argmax(arrows) == 1  # at 1.2 s
    assert arrows[1] > 100
    assert max(arrows[:1] + arrows[2:]) < 10
    changes = [np.abs(a - b).mean() for a, b in itertools.pairwise(planned)]
    assert min(changes) > 1.0


def test_a_video_is_as_long_as_the_show(make_run: Callable[..., Path], tmp_path: Path) -> None:
    """A rocket that never fires falls out of its world within 3 s."""
    run, path = make_run("rocket_navigation", -1.0), tmp_path / "fall.mp4"
    (run / "reference.npz").unlink()
    view(str(run), "--video", str(path))
    _, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert 3.0 < seconds < 5.0
    assert [file.name for file in tmp_path.iterdir() if file.is_file()] == ["fall.mp4"]


BALL = """<mujoco><worldbody><geom type="plane" size="9 9 1" rgba="1 1 1 1"/>
  <body name="ball"><freejoint/><geom size=".4" rgba="0 0 0 1"/>{more}</body></worldbody>
</mujoco>"""


def pictures_of(more: str = "") -> list[NDArray[np.float64]]:
    """A black ball behind a ghost of itself, the same without the ghost, and the ghost alone, which
    hides what is behind it."""
    model = mujoco.MjModel.from_xml_string(BALL.format(more=more))
    executed, ghost = np.zeros((2, 7)), np.zeros((2, 7))
    executed[:, 2:4], ghost[:, 2:4] = (0.4, 1.0), (0.4, 1.0)
    executed[1, 0] = 0.1
    ghost[:, 1] = -0.9  # towards the camera
    actors = [
        Actor("executed", executed, 0.1, EXECUTED_COLOUR, ""),
        Actor("plan", ghost, 0.1, PLAN_COLOUR, "", ghost=True),
    ]
    found = []
    with film.Camera(Show(model, actors, ""), (200, 200)) as camera:
        for cast in (actors, actors[:1], actors[1:]):
            shot = film.Shot(cast, np.array([0.0, 0.0, 0.4]), 6.0, mujoco.MjrRect(0, 0, 200, 200))
            found.append(camera._take([shot], 0.0).astype(float))
    return found


def test_a_ghost_can_be_seen_through() -> None:
    """The contrast between the ball and the ground behind a ghost is 1 - GHOST_OPACITY of what it
    is without the ghost, at every point but the ghost's smoothed edge."""
    seen, alone, opaque = pictures_of()
    ghost = np.abs(seen - alone).max(axis=-1) > 8
    ball = alone.max(axis=-1) < 30
    assert (ghost & ball).sum() > 50
    assert (ghost & ~ball).sum() > 50
    through = seen - GHOST_OPACITY * opaque
    error = np.abs(through - (1.0 - GHOST_OPACITY) * alone).max(axis=-1)
    assert np.quantile(error[ghost], 0.95) < 2.0  # of 255


def test_the_parts_of_a_ghost_do_not_add_up() -> None:
    one, *_ = pictures_of()
    many, *_ = pictures_of('<geom size=".39" rgba="1 0 0 1"/><geom size=".38"/><geom size=".1"/>')
    assert np.abs(one - many).mean() < 1.0


@pytest.mark.parametrize(
    ("heights", "place"),
    [((0.0, 20.0), "below"), ((0.0, -20.0), "above"), ((0.0, 0.0, 22.0, -22.0), "nowhere")],
)
def test_the_close_up_of_a_film_leaves_the_path_free(
    heights: tuple[float, ...], place: str
) -> None:
    """A flat flight to the upper right, to the lower right, and one that passes both corners."""
    ball = "<mujoco><worldbody><body><freejoint/><geom size='.4'/></body></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(ball)
    progress = np.linspace(0.0, 1.0, 60)
    qpos = np.zeros((60, 7))
    qpos[:, 0], qpos[:, 3] = 80.0 * np.minimum(1.0, 1.5 * progress), 1.0
    qpos[:, 2] = np.interp(progress, np.linspace(0.0, 1.0, len(heights)), heights)
    shown = Show(model, [Actor("executed", qpos, 0.1, EXECUTED_COLOUR, "")], "")
    with film.Camera(shown, (480, 270)) as camera:
        picture = camera.frame(0.0)
    white = np.all(picture == 255, axis=-1).sum(axis=1)
    rows = np.flatnonzero(white > 100)  # its frame
    assert len(rows) == (0 if place == "nowhere" else 4)
    if place != "nowhere":
        assert rows.mean() > 135 if place == "below" else rows.mean() < 135


def test_the_end_of_a_film_is_drawn_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(BALL.format(more=""))
    qpos = np.zeros((11, 7))
    qpos[:, 2:4] = 0.4, 1.0
    actors = [Actor("executed", qpos, 0.05, EXECUTED_COLOUR, "", ending="solved at 0.50 s")]
    drawn, shares = list[float](), list[float]()
    frame = film.Camera.frame

    def noted(self: film.Camera, time: float) -> film.Picture:
        drawn.append(time)
        return frame(self, time)

    monkeypatch.setattr(film.Camera, "frame", noted)
    film.write_video(Show(model, actors, ""), tmp_path / "film.mp4", shares.append)
    assert drawn == pytest.approx([*np.arange(15) / 30, 0.5])
    assert shares == pytest.approx(np.arange(1, 16) / 15)
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "film.mp4"))
    assert next(reader)["source_size"] in (film.SIZE, film.SMALL_SIZE)
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))
    assert frames == 15 + film.FRAMES_PER_SECOND


@pytest.mark.parametrize(
    ("renderer", "size", "quality"),
    [
        (b"llvmpipe (LLVM 19.1.7, 256 bits)", film.SMALL_SIZE, film.SLOW_QUALITY),
        (b"softpipe", film.SMALL_SIZE, film.SLOW_QUALITY),
        (b"NVIDIA H100/PCIe/SSE2", film.SIZE, film.QUALITY),
    ],
)
def test_a_film_is_small_where_no_gpu_draws_it(
    renderer: bytes,
    size: tuple[int, int],
    quality: tuple[int, int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """So that it takes seconds: less than half the pixels, none of them drawn four times."""
    with film.Camera(Show(*ball_at_rest())):
        pass  # OpenGL is loaded
    monkeypatch.setattr("OpenGL.GL.glGetString", lambda name: renderer)
    shown = Show(*ball_at_rest())
    with film.Camera(shown) as camera:
        assert camera.size == size
        assert camera.frame(0.0).shape == (size[1], size[0], 3)
    look = shown.model.vis.quality
    assert (look.offsamples, look.numslices, look.numstacks) == quality


def ball_at_rest(steps: int = 4, timestep: float = 0.5) -> tuple[mujoco.MjModel, list[Actor], str]:
    qpos = np.tile([0.0, 0.0, 0.4, 1.0, 0.0, 0.0, 0.0], (steps, 1))
    actors = [Actor("executed", qpos, timestep, EXECUTED_COLOUR, "")]
    return mujoco.MjModel.from_xml_string(BALL.format(more="")), actors, ""


@pytest.mark.parametrize("timestep", [1 / 600, 1 / 50, 0.5])
def test_a_film_has_as_many_pictures_as_its_seconds_need(
    timestep: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """30 a second and the last one, however finely the motion was simulated."""
    drawn = list[float]()
    blank = np.zeros((*film.SMALL_SIZE[::-1], 3), np.uint8)

    def noted(_: film.Camera, time: float) -> film.Picture:
        drawn.append(time)
        return blank

    monkeypatch.setattr(film.Camera, "frame", noted)
    shown = Show(*ball_at_rest(round(1.5 / timestep) + 1, timestep))
    film.write_video(shown, tmp_path / "film.mp4")
    assert len(drawn) == 45 + 1
    assert (tmp_path / "film.mp4").stat().st_size < 100_000


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_shows_how_much_of_a_film_is_done(
    terminal: bool,
    make_run: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    """A file or a pipe gets no bar, and standard output has only the film's name."""

    def write(show: Show, path: Path, progress: film.Progress) -> None:
        progress(0.5)

    monkeypatch.setattr(film, "write_video", write)
    monkeypatch.setenv("TTY_COMPATIBLE", "1" if terminal else "0")
    path = tmp_path / "film.mp4"
    assert cli.main(["view", str(make_run("rocket_navigation")), "--video", str(path)]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{path}\n"
    assert ("video" in captured.err and "50%" in captured.err) == terminal


def test_what_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    shown = Show(model, [Actor("executed", np.zeros((2, 3)), 0.1, PLAN_COLOUR, "")], "")
    there = tmp_path / "there.mp4"
    there.write_text("mine")
    with pytest.raises(TsbenchError, match=r"there\.mp4 exists and nothing is overwritten"):
        film.write_video(shown, there)
    with pytest.raises(TsbenchError, match=r"must end in \.png"):
        film.write_strip(shown, tmp_path / "x.jpg")
    monkeypatch.setattr(film, "imageio_ffmpeg", None)
    with pytest.raises(TsbenchError, match=r"pip install 'tsbench\[video\]'"):
        film.write_video(shown, tmp_path / "x.mp4")
    assert there.read_text() == "mine"


def test_no_other_file_is_touched(tmp_path: Path) -> None:
    """Not those that lie where earlier versions wrote, and no file that appears meanwhile."""
    shown, mine = Show(*ball_at_rest(2, 0.1)), tmp_path / "mine.txt"
    mine.write_text("mine")
    for name in ("x.mp4.part.mp4", "x.png.part"):
        (tmp_path / name).symlink_to(mine)
    before = set(tmp_path.iterdir())
    film.write_video(shown, tmp_path / "x.mp4")
    film.write_strip(shown, tmp_path / "x.png", 1)
    assert set(tmp_path.iterdir()) - before == {tmp_path / "x.mp4", tmp_path / "x.png"}
    late = tmp_path / "late.mp4"

    def appear(_: float) -> None:
        late.write_text("mine")

    with pytest.raises(TsbenchError, match=r"late\.mp4 exists and nothing is overwritten"):
        film.write_video(shown, late, appear)
    assert mine.read_text() == late.read_text() == "mine"


def test_a_strip_has_room_for_long_names(tmp_path: Path) -> None:
    model, (actor,), title = ball_at_rest(2)
    long = replace(actor, name="A: prm, shortcut=true, seed 3")
    film.write_strip(Show(model, [long], title), tmp_path / "strip.png", 1)
    strip = np.asarray(Image.open(tmp_path / "strip.png").convert("L"))
    gutter = strip.shape[1] - film.CELL
    columns = np.flatnonzero((strip[40:, :gutter] < 255).any(axis=0))
    assert columns.min() >= film.EDGE - 2
    assert columns.max() <= gutter - film.EDGE + 2
