"""The output of a run, and a progress bar on a terminal."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn


class Output(Console):
    """A console on which a reader that has left is an error like any other of the system, where
    rich would end the process without a word of how to resume the run."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))


@contextmanager
def progress_bar(
    console: Console | None, what: str, shown: bool = True
) -> Iterator[Callable[[float], None]]:
    """A progress bar on a terminal; elsewhere nothing is shown. Yields a function that takes the
    share done, in [0, 1].

    Args:
        console: the terminal; None for that of the error stream.
        what: is done, in a word.
        shown: False to show nothing at all.
    """
    console = console or Console(stderr=True)
    columns = (TextColumn("{task.description:<10}"), BarColumn(), TaskProgressColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not (shown and console.is_terminal)
    ) as bar:
        row = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(row, completed=share)
