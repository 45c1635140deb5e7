"""The choice of the OpenGL library on different machines."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tsbench import gl
from tsbench.core.errors import TsbenchError


@pytest.mark.parametrize(
    ("platform", "environment", "libraries", "chosen"),
    [
        ("linux", {}, {"EGL", "OSMesa"}, "egl"),
        ("linux", {}, {"OSMesa"}, "osmesa"),
        ("linux", {}, set(), "disable"),
        ("linux", {"DISPLAY": ":0"}, {"EGL"}, None),
        ("linux", {"DISPLAY": ""}, {"EGL"}, "egl"),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, {"EGL"}, None),
        ("linux", {"MUJOCO_GL": "osmesa"}, {"EGL"}, "osmesa"),  # the user's choice stays
        ("darwin", {}, {"EGL"}, None),
    ],
)
def test_backend(
    monkeypatch: pytest.MonkeyPatch,
    platform: str,
    environment: dict[str, str],
    libraries: set[str],
    chosen: str | None,
) -> None:
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")  # so that pytest also undoes the setting of choose_backend
        monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(gl, "find_library", lambda name: name if name in libraries else None)
    gl.choose_backend()
    assert os.environ.get("MUJOCO_GL") == chosen


@pytest.mark.parametrize(
    ("chosen", "works", "taken"),
    [
        ("egl", {"egl", "osmesa"}, "egl"),
        ("egl", {"osmesa"}, "osmesa"),  # EGL is installed but finds no device
        ("disable", {"osmesa"}, "osmesa"),
        (None, {None}, None),  # a window system
    ],
)
def test_what_draws_is_found_by_trial(
    monkeypatch: pytest.MonkeyPatch, chosen: str | None, works: set[str | None], taken: str | None
) -> None:
    def trial(*_: object, env: dict[str, str], **__: object) -> subprocess.CompletedProcess[bytes]:
        return subprocess.CompletedProcess([], 0 if env.get("MUJOCO_GL") in works else 1)

    monkeypatch.setenv("MUJOCO_GL", chosen or "")
    if chosen is None:
        monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr(subprocess, "run", trial)
    gl.find_working_backend()
    assert os.environ.get("MUJOCO_GL") == taken
    works.clear()
    with pytest.raises(TsbenchError, match=r"install EGL .* or OSMesa"):
        gl.find_working_backend()
