"""Suppression of mujoco's warnings, which tsbench counts instead."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import mujoco


class Quiet:
    """A context in which mujoco writes no warnings. Several threads may be in it at once.

    The code in the context reads the counts of warnings (`Batch.warning`, `mjData.warning`).
    Outside, mujoco writes each warning to the error stream and to a file in the current directory.
    mujoco has one handler for the whole process: the first thread to enter the context replaces it,
    and the last one to leave restores it.
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
    """A handler of mujoco warnings that does nothing."""


QUIET = Quiet()
