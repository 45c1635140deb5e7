"""Files that appear whole or not at all, and never in the place of another."""

from __future__ import annotations

import json
import os
import re
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from tsbench.errors import TsbenchError, os_errors

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


def check_new(path: Path) -> None:
    """
    Raises:
        TsbenchError: `write_json` could not write there, whatever the content.
    """
    if path.exists():
        raise TsbenchError(f"{path} exists and nothing is overwritten")
    check_writable(path, path.parent)


def check_writable(path: Path, folder: Path) -> None:
    """
    Raises:
        TsbenchError: `path` cannot be made, since nothing can be in `folder`.
    """
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise TsbenchError(f"{path}: {error.strerror}") from None


def write_json(path: Path | None, content: Any) -> None:
    """Writes a JSON file, if one is asked for; nothing is overwritten.

    Raises:
        TsbenchError: the file exists or cannot be written.
    """
    if path is None:
        return
    check_new(path)
    with os_errors(path):
        write_whole(path, (_legible(json.dumps(content, indent=2)) + "\n").encode())


def _legible(text: str) -> str:
    """JSON with every list of plain values on one line."""
    return re.sub(r"\[[^][{}\"]*\]", lambda found: " ".join(found[0].split()), text)
