"""Which OpenGL is picked on which machine."""

from __future__ import annotations

import os
import sys

import pytest

from tsbench import gl


@pytest.mark.parametrize(
    ("platform", "environment", "libraries", "chosen"),
    [
        ("linux", {}, {"EGL", "OSMesa"}, "egl"),
        ("linux", {}, {"OSMesa"}, "osmesa"),
        ("linux", {}, set(), "disable"),
        ("linux", {"DISPLAY": ":0"}, {"EGL"}, None),
        ("linux", {"DISPLAY": ""}, {"EGL"}, "egl"),
        ("linux", {"WAYLAND_DISPLAY": "wayland-0"}, {"EGL"}, None),
        ("linux", {"MUJOCO_GL": "osmesa"}, {"EGL"}, "osmesa"),  # the user's word is the last
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
        monkeypatch.setenv(name, "")  # so that what choose_backend sets is undone too
        monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(gl, "find_library", lambda name: name if name in libraries else None)
    gl.choose_backend()
    assert os.environ.get("MUJOCO_GL") == chosen
