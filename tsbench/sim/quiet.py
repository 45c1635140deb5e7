"""mujoco's warnings, which are counted and not written."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import mujoco


class Quiet:
    """A context in which mujoco writes no warnings, whichever threads are in it.

    Whoever computes in it counts the warnings (`Batch.warning`, `mjData.warning`). Outside, mujoco
    writes each to the error stream, and to a file in the current directory. The handler is one for
    the whole process: the first who enters replaces it, and the last who leaves puts it back.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0
        self._before: Callable[[str], None] | None = None

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(_ignore)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                mujoco.set_mju_user_warning(self._before)


def _ignore(message: str) -> None:
    """What mujoco hands a warning to."""


QUIET = Quiet()
