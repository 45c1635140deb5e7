"""What a user can get wrong, told in one line."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np


class TsbenchError(Exception):
    """A mistake that the user can mend.

    The message is one line in plain words, even where it quotes what has several. The command line
    prints it after `tsbench: ` on the error stream and exits with status 2; no traceback is shown.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))


class NotFiniteError(TsbenchError):
    """A number that is not finite has turned up: the computation has gone wrong.

    Attributes:
        arrays: what it was computed from, by name, for whoever looks for the cause.
    """

    def __init__(self, message: str, arrays: Mapping[str, np.ndarray]) -> None:
        super().__init__(message)
        self.arrays = arrays


class Stopped(KeyboardInterrupt):
    """A signal has stopped the run: Ctrl-C, or SIGTERM.

    Attributes:
        signal: its number. The exit status is 128 more, as a shell counts.
    """

    def __init__(self, signal: int, message: str = "interrupted") -> None:
        super().__init__(message)
        self.signal = signal


def unknown(
    kind: str, given: str, allowed: Iterable[str], causes: Iterable[str] = ()
) -> TsbenchError:
    """The error for a name that does not exist, with the nearest one that does.

    Args:
        kind: what was named, e.g. "task".
        given: the name given.
        allowed: the names that exist.
        causes: why more names do not exist, a line each.
    """
    names = sorted(allowed)
    message = f"unknown {kind} '{given}'; allowed: {', '.join(names) or 'none'}"
    near = difflib.get_close_matches(given, names, n=1)
    message += f" (did you mean '{near[0]}'?)" if near else ""
    return TsbenchError("; ".join([message, *causes]))


@contextmanager
def os_errors(path: Path | str) -> Iterator[None]:
    """Turns what the operating system refuses (disk full, no permission) into one line.

    Args:
        path: what is being read or written; named where the refusal names no file itself.
    """
    try:
        yield
    except OSError as error:
        raise TsbenchError(f"{error.filename or path}: {error.strerror or error}") from None


_NO_MEMORY = (
    "allocate memory",
    "start new thread",
    "Resource temporarily unavailable",
    "Caught an unknown exception!",  # mujoco's MjSpec, of a C++ bad_alloc
)


@contextmanager
def memory_errors() -> Iterator[None]:
    """Turns a refusal of memory, by Python, numpy, mujoco or torch, into one line."""
    try:
        yield
    except (MemoryError, RuntimeError, ValueError) as error:
        # torch, and whoever cannot start a thread, raises a RuntimeError, mujoco a ValueError.
        known = isinstance(error, MemoryError) or any(sign in str(error) for sign in _NO_MEMORY)
        if not known:
            raise
        raise TsbenchError("out of memory: fewer environments need less") from None
