"""Which OpenGL draws pictures; to be settled before mujoco or dm_control is imported."""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library


def choose_backend() -> None:
    """Sets MUJOCO_GL on a machine without a display, unless the user has set it.

    EGL if there is one, else OSMesa, else none: then everything works but pictures.
    """
    if sys.platform != "linux" or "MUJOCO_GL" in os.environ:
        return
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    libraries = {"egl": "EGL", "osmesa": "OSMesa"}
    found = (name for name, library in libraries.items() if find_library(library))
    os.environ["MUJOCO_GL"] = next(found, "disable")
