"""What works on this machine: OpenGL, GPU, extras, threads and versions, each on one line."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import requires

from tsbench import gl, methods, tasks
from tsbench.core import plugins
from tsbench.core.errors import TsbenchError
from tsbench.leaderboard import kept

VERSIONS = ("mujoco", "dm-control", "gymnasium", "numpy", "torch", "rsl-rl-lib")
FOR_DEVELOPERS = ("bench", "dev")  # extras that users do without
_REQUIREMENT = re.compile(r"([\w.-]+).*extra == ['\"]([\w-]+)['\"]")
GPU = "import torch; print(torch.cuda.get_device_name() if torch.cuda.is_available() else '')"
MISSING = "missing"
SECONDS = 120.0  # for torch to load


def findings() -> Iterator[tuple[str, str]]:
    """Subjects and what is found about each."""
    yield "tsbench", f"{plugins.own().version}, Python {platform.python_version()}, {_system()}"
    yield "packages", ", ".join(f"{name} {_version(name)}" for name in VERSIONS)
    cores = os.cpu_count()  # macOS knows no affinity
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else cores
    yield "threads", f"{allowed} of {cores} cores may be used"
    yield "OpenGL", _graphics()
    yield "GPU", _gpu()
    for state, names in _extras().items():
        yield f"extras {state}", names
    yield "tasks", f"{len(tasks.names())}, and {len(kept.entries())} kept entries"
    others = sorted(str(one) for one in plugins.providers() if one != plugins.own())
    yield "plug-ins", ", ".join(others) or "none"
    for line in dict.fromkeys((*tasks.refused(), *methods.refused())):
        yield "refused", line
    yield "directory", _directory()


def _system() -> str:
    return f"{platform.system()} {platform.machine()}"


def _version(name: str) -> str:
    return plugins.version_of(name) or MISSING


def _graphics() -> str:
    try:
        gl.find_working_backend()
    except TsbenchError as error:
        return f"{error}; all else works without"
    return f"{os.environ.get('MUJOCO_GL', 'the window system')} draws videos and strips"


def _gpu() -> str:
    """torch is asked in a process of its own: it loads slowly, and a broken driver may end it."""
    words = [sys.executable, "-W", "ignore", "-c", GPU]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return "unknown: torch does not answer"
    if done.returncode:
        return f"unknown: {(done.stderr.splitlines() or ['torch does not start'])[-1]}"
    name = done.stdout.strip()
    return f"{name}: device=cuda" if name else "none that torch can use: device=cpu"


def _extras() -> dict[str, str]:
    """The installed extras and the others, with how to install them."""
    parts: dict[str, list[str]] = {}
    for line in requires(plugins.OWN) or ():
        if (match := _REQUIREMENT.match(line)) and match[2] not in FOR_DEVELOPERS:
            parts.setdefault(match[2], []).append(_version(match[1]))
    missing = [name for name, versions in parts.items() if MISSING in versions]
    there = [name for name in parts if name not in missing]
    found = {"installed": ", ".join(there) or "none"}
    if missing:
        found["missing"] = f"{', '.join(missing)} (pip install 'tsbench[{','.join(missing)}]')"
    return found


def _directory() -> str:
    return "runs can be written here" if os.access(".", os.W_OK) else "nothing can be written here"
