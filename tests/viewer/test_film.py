"""Videos and motion strips, made by the command line with the OpenGL library that works here."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tsbench.core.errors import TsbenchError
from tsbench.viewer import film
from tsbench.viewer.show import PLAN_COLOUR, PUSH_COLOUR, Actor, Show


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
