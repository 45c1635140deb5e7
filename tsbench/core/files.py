"""Files that appear whole or not at all, and never in the place of another."""

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
    """Writes a file so that whoever reads it, even after a crash, finds all of it or none.

    It is written beside its place, synced and renamed. A write that fails leaves nothing behind.

    Raises:
        OSError: as the system says.
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
            error.filename, error.filename2 = str(path), None  # the one that the caller knows
        raise


def sync_folder(folder: Path) -> None:
    """Makes what was renamed or removed in a folder last.

    Raises:
        OSError: as the system says.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def taken(place: Path, holds: str = "", way_out: str = "") -> TsbenchError:
    """The error for a place that is taken: nothing is ever overwritten.

    Args:
        place: a file or directory.
        holds: what is in it, for a directory that exists and may hold nothing else.
        way_out: what the user can do instead.
    """
    state = f"holds {holds}" if holds else "exists"
    rest = f": {way_out}" if way_out else ""
    return TsbenchError(f"{place} {state} and nothing is overwritten{rest}")


def check_new(path: Path, way_out: str = "", *, parents: bool = False) -> None:
    """
    Args:
        path: a file or directory to be made.
        way_out: what the user can do where it exists.
        parents: whether the folders above it will be made too.

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
    """Writes a file where there is none.

    Raises:
        TsbenchError: the file exists or cannot be written.
    """
    check_new(path)
    with os_errors(path):
        write_whole(path, content)


def write_json(path: Path | None, content: Any) -> None:
    """Writes a new JSON file, if one is asked for.

    Raises:
        TsbenchError: the file exists or cannot be written.
    """
    if path is not None:
        write_new(path, (_legible(json.dumps(content, indent=2)) + "\n").encode())


def _legible(text: str) -> str:
    """JSON with every list of plain values on one line."""
    return re.sub(r"\[[^][{}\"]*\]", lambda found: " ".join(found[0].split()), text)
