"""Chooses the OpenGL library that draws pictures, before mujoco or dm_control is imported."""

from __future__ import annotations

import os
import subprocess
import sys
from ctypes.util import find_library

from tsbench.core.errors import TsbenchError

TRIAL = "import mujoco; mujoco.GLContext(8, 8).make_current()"


def choose_backend() -> None:
    """Sets MUJOCO_GL on a machine without a display, unless the user has set it.

    It takes EGL, else OSMesa. Without either, everything but pictures works.
    """
    if sys.platform != "linux" or "MUJOCO_GL" in os.environ:
        return
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    libraries = {"egl": "EGL", "osmesa": "OSMesa"}
    found = (name for name, library in libraries.items() if find_library(library))
    os.environ["MUJOCO_GL"] = next(found, "disable")


def draw_nothing() -> None:
    """Keeps mujoco from loading an OpenGL library, for a process that draws no pictures: a setting
    of MUJOCO_GL that does not work here is no hindrance then, and mujoco is imported faster."""
    if "mujoco" not in sys.modules:
        os.environ["MUJOCO_GL"] = "disable"


def find_working_backend() -> None:
    """Sets MUJOCO_GL to a library that draws: its present value if that works, else EGL or OSMesa.

    An installed library may still find no device to draw on, so each one is tried.

    Raises:
        TsbenchError: none of them works.
    """
    for backend in dict.fromkeys((os.environ.get("MUJOCO_GL"), "egl", "osmesa")):
        changes = {} if backend is None else {"MUJOCO_GL": backend}
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", TRIAL],
            env={**os.environ, **changes},
            capture_output=True,
        )
        if done.returncode == 0:
            os.environ.update(changes)
            return
    raise TsbenchError(
        "no OpenGL draws pictures here: install EGL (Debian: libegl1 libgl1-mesa-dri) or OSMesa "
        "(Debian: libosmesa6)"
    )
