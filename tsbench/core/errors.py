"""Errors that the user can correct, each told in one line."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np  # takes half of the time in which `tsbench --help` answers

LONGEST = 2000  # characters of a message

_short = reprlib.Repr()
_short.maxstring = _short.maxother = 80
_short.maxlevel = 2


def quoted(value: object) -> str:
    """A value from outside for a message: its `repr`, shortened in the middle."""
    try:
        return _short.repr(value)
    except ValueError:  # a whole number of more digits than Python writes
        return "a huge number"


def plain_line(text: str) -> str:
    """The text on one line, cut in the middle if it is long, without control characters."""
    if len(text) > LONGEST:
        text = f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"
    text = " ".join(text.splitlines())
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class TsbenchError(Exception):
    """A mistake that the user can correct.

    The message is one line in plain words, even if it quotes a long text of several lines or of
    control characters. The command line prints it after `tsbench:` on the error stream and exits
    with status 2; no traceback is shown.
    """

    def __init__(self, message: str) -> None:
        super().__init__(plain_line(message))


class PlanError(TsbenchError):
    """A plan fails its audit, or there is none, so nothing is to be learned from it. To resume the
    run would give the same plan again: the training has failed, and counts as zero."""


class NotFiniteError(TsbenchError):
    """A computation has produced a number that is not finite.

    Attributes:
        arrays: the inputs of the computation by name, for finding the cause.
    """

    def __init__(self, message: str, arrays: Mapping[str, np.ndarray]) -> None:
        super().__init__(message)
        self.arrays = arrays

    def __reduce__(self) -> tuple[Any, ...]:
        """So that it can leave the process of a pool."""
        return type(self), (str(self), self.arrays)


class Stopped(KeyboardInterrupt):
    """A signal has stopped the run: Ctrl-C, or SIGTERM.

    Attributes:
        signal: number of the signal. The exit status is 128 plus this number, as in a shell.
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
        causes: reasons why further names are unavailable, one line each.
    """
    names = sorted(allowed)
    if len(given) > 80:  # to compare it with the names would take long
        given = f"{given[:40]}...{given[-37:]}"
    message = f"unknown {kind} '{given}'; allowed: {', '.join(names) or 'none'}"
    near = nearest(given, names)
    message += f" (did you mean '{near}'?)" if near else ""
    return TsbenchError("; ".join([message, *causes]))


def nearest(given: str, names: Iterable[str]) -> str | None:
    """The name that is most like the given one, whatever the case of the letters; None if none is
    like it."""
    folded = {name.casefold(): name for name in names}
    found = difflib.get_close_matches(given.casefold(), folded, n=1)
    return folded[found[0]] if found else None


@contextmanager
def os_errors(path: Path | str) -> Iterator[None]:
    """Turns an `OSError` (disk full, no permission) into a `TsbenchError`.

    Args:
        path: the file being read or written; the message names it if the error names no file.

    Raises:
        TsbenchError: the operating system has refused an operation within the context.
    """
    try:
        yield
    except OSError as error:
        raise TsbenchError(f"{error.filename or path}: {error.strerror or error}") from None


_NO_MEMORY = (
    "allocate memory",
    "start new thread",
    "Resource temporarily unavailable",
    "Caught an unknown exception!",  # MjSpec of mujoco, for a C++ bad_alloc
)


@contextmanager
def memory_errors() -> Iterator[None]:
    """Turns an out-of-memory error of Python, numpy, mujoco or torch into a `TsbenchError`.

    Raises:
        TsbenchError: memory has run out within the context.
    """
    try:
        yield
    except (MemoryError, RuntimeError, ValueError) as error:
        # torch and a thread that cannot start raise a RuntimeError, mujoco raises a ValueError.
        known = isinstance(error, MemoryError) or any(sign in str(error) for sign in _NO_MEMORY)
        if not known:
            raise
        raise TsbenchError("out of memory: fewer environments need less") from None
