"""Atomic writes, and writes that refuse to replace an existing file."""

from __future__ import annotations

import json
import os
import re
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from tsbench.core.errors import TsbenchError, os_errors

PART = ".part"  # ends the name of a file that is being written


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file atomically: a reader finds all of it or nothing, even after a crash.

    The content is written to a temporary file in the same folder, which is synced and then renamed.
    An existing file is replaced. A failed write leaves no temporary file behind.

    Raises:
        OSError: the operating system has refused the write. The error names `path`.
    """
    temporary = path.with_name(path.name + PART)
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_folder(path.parent)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            error.filename, error.filename2 = str(path), None  # not the temporary file
        raise


def sync_folder(folder: Path) -> None:
    """Syncs a folder, so that renames and removals in it survive a crash.

    Raises:
        OSError: the operating system has refused to open or sync the folder.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def taken(place: Path, holds: str = "", way_out: str = "") -> TsbenchError:
    """The error for a path that is already in use.

    Args:
        place: a file or directory.
        holds: what the directory contains; "" to say only that the path exists.
        way_out: what the user can do instead.
    """
    state = f"holds {holds}" if holds else "exists"
    rest = f": {way_out}" if way_out else ""
    return TsbenchError(f"{place} {state} and nothing is overwritten{rest}")


def check_new(path: Path, way_out: str = "", *, parents: bool = False) -> None:
    """Checks that a new file or directory can be made.

    Args:
        path: the file or directory.
        way_out: what the user can do instead if the path exists.
        parents: whether the caller will also make the missing folders above it.

    Raises:
        TsbenchError: the path exists or cannot be made.
    """
    if path.exists():
        raise taken(path, way_out=way_out)
    folder = path.absolute().parent
    while parents and not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise TsbenchError(f"{path}: {error.strerror}") from None


def write_new(path: Path, content: bytes) -> None:
    """Writes a new file.

    Raises:
        TsbenchError: the file exists or cannot be written.
    """
    check_new(path)
    with os_errors(path):
        write_whole(path, content)


def write_json(path: Path | None, content: Any) -> None:
    """Writes a new JSON file, or nothing if `path` is None.

    Raises:
        TsbenchError: the file exists or cannot be written.
    """
    if path is not None:
        write_new(path, (_legible(json.dumps(content, indent=2)) + "\n").encode())


def _legible(text: str) -> str:
    """JSON with every list of plain values on one line."""
    return re.sub(r"\[[^][{}\"]*\]", lambda found: " ".join(found[0].split()), text)
