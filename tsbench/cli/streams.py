"""The surroundings that a command may be started in: closed streams, and warnings made errors."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


def open_closed() -> None:
    """Opens what the shell has closed (`>&-`) to nowhere, so that the first file that a command
    opens does not get the number of a standard stream and with it what is meant for the stream."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDONLY if mode == "r" else os.O_WRONLY)
            if nowhere != number:  # a lower number is closed too, which is not a stream's
                os.dup2(nowhere, number)
                os.close(nowhere)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


@contextmanager
def loading() -> Iterator[None]:
    """Says on a terminal that libraries are loaded, which takes seconds, until they are."""
    if not sys.stderr.isatty():
        yield
        return
    sys.stderr.write("loading ...")
    sys.stderr.flush()
    try:
        yield
    finally:
        sys.stderr.write("\r           \r")
        sys.stderr.flush()


@contextmanager
def warnings_as_usual() -> Iterator[None]:
    """Shows the warnings of other libraries to those who ask for warnings, and never raises them:
    with PYTHONWARNINGS=error a library's remark would end a command."""
    with warnings.catch_warnings():
        if sys.warnoptions:
            warnings.simplefilter("default")
        yield
