"""Bounded reads of files that anybody may have made, atomic writes, writes that refuse to replace
an existing file, and locks."""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from tsbench.core.errors import TsbenchError, os_errors, quoted

# The name of a file while it is being written: hidden, and not to be guessed.
_TEMPORARY = re.compile(r"\.(.+)\.[0-9a-f]{32}\.part")

MAX_DEPTH = 24  # of nested lists and mappings; a score has nine
MAX_INTEGER = 2**64


def read_file(path: Path, limit: int, what: str = "file") -> bytes:
    """The content of a regular file. Nothing else is opened for reading: no symbolic link, FIFO or
    device.

    Args:
        path: the file.
        limit: the largest size allowed, in bytes.
        what: the file in words, for messages.

    Raises:
        TsbenchError: there is no such file, it is not a regular one, or it is too large.
    """
    # A FIFO without a writer blocks whoever opens it, unless told not to wait.
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        if path.is_symlink():
            raise TsbenchError(f"{path} is a link: only regular files are read")
        descriptor = os.open(path, flags)
    except (FileNotFoundError, NotADirectoryError):
        raise TsbenchError(f"no {what} {path}") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise TsbenchError(f"cannot read {path}: {reason}") from None
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        os.close(descriptor)
        raise TsbenchError(f"{path} is not a regular file")
    with os.fdopen(descriptor, "rb") as file, os_errors(path):
        if status.st_size > limit:
            raise _too_large(path, limit)
        content = file.read(limit + 1)
    if len(content) > limit:  # it has grown
        raise _too_large(path, limit)
    return content


def _too_large(path: Path, limit: int) -> TsbenchError:
    return TsbenchError(f"{path} is larger than the {limit:,} bytes that are allowed")


def read_json(path: Path, limit: int, what: str = "file") -> Any:
    """The content of a JSON file, as plain values.

    Raises:
        TsbenchError: as `read_file`, or the content is no JSON or not `parse_json`'s kind of it.
    """
    content = read_file(path, limit, what)
    try:
        return parse_json(content)
    except ValueError as error:
        raise TsbenchError(f"damaged {what} {path}: {error}") from None


def parse_json(content: bytes | str) -> Any:
    """Plain values from JSON whose keys are unique and whose numbers are finite (`check_plain`).

    Raises:
        ValueError: the content is something else.
    """
    try:
        values = json.loads(content, object_pairs_hook=_unique, parse_constant=_no_number)
    except (RecursionError, MemoryError):
        raise ValueError("it is nested too deeply") from None
    check_plain(values)
    return values


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"the key {quoted(name)} is there twice")
        found[name] = value
    return found


def _no_number(word: str) -> Any:
    raise ValueError(f"{word} is no finite number")


def check_plain(value: Any, depth: int = 0, *, finite: bool = True) -> None:
    """Checks plain values from JSON or YAML for what code downstream need not expect.

    Args:
        value: None, a scalar, or lists and mappings of such values.
        depth: of the lists and mappings around it.
        finite: whether numbers must be finite.

    Raises:
        ValueError: values nested too deeply, whole numbers beyond 64 bits, numbers that are not
            finite, or text that UTF-8 cannot hold.
    """
    if isinstance(value, (list, dict)):
        if depth >= MAX_DEPTH:
            raise ValueError("it is nested too deeply")
        inner: Sequence[Any] = value if isinstance(value, list) else [*value, *value.values()]
        for one in inner:
            check_plain(one, depth + 1, finite=finite)
    elif isinstance(value, float):
        if finite and not math.isfinite(value):
            raise ValueError("it holds a number that is not finite")
    elif isinstance(value, int):
        if abs(value) >= MAX_INTEGER:
            raise ValueError("it holds a whole number of more than 64 bits")
    elif isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError:
            raise ValueError("it holds text that is no Unicode") from None


def append(path: Path) -> BinaryIO:
    """Opens a regular file for writing at its end, a new one if there is none. No link is followed,
    and no file is written that has a second name, perhaps in another directory.

    Raises:
        TsbenchError: the file cannot be opened, is not a regular one, or has a second name.
    """
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
    if path.is_symlink():
        raise TsbenchError(f"{path} is a link: nothing is written through it")
    with os_errors(path):
        file = os.fdopen(os.open(path, flags, 0o666), "ab")
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode):
        file.close()
        raise TsbenchError(f"{path} is not a regular file")
    if status.st_nlink > 1:
        file.close()
        raise TsbenchError(f"{path} has a second name (a hard link): put a copy in its place")
    return file


def leftovers(folder: Path) -> Iterator[tuple[Path, str]]:
    """The temporary files that interrupted calls of `write_whole` have left in a folder, each with
    the name of the file that it was to become."""
    for path in folder.iterdir():
        if match := _TEMPORARY.fullmatch(path.name):
            yield path, match[1]


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file atomically: a reader finds all of it or nothing, even after a crash.

    The content is written to a temporary file in the same folder, which is synced and then renamed.
    An existing file is replaced. A failed write leaves no temporary file behind.

    Raises:
        OSError: the operating system has refused the write. The error names `path`.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(16)}.part")
    try:
        with temporary.open("xb") as file:  # a new file: nobody's link is followed
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


def check_ending(path: Path, ending: str) -> None:
    """Checks that a file's name ends as files of its kind do, such as ".png".

    Raises:
        TsbenchError: it has another ending.
    """
    if path.suffix.lower() != ending:
        raise TsbenchError(f"{path} must end in {ending}")


def check_new(path: Path, way_out: str = "", *, parents: bool = False) -> None:
    """Checks that a new file or directory can be made.

    Args:
        path: the file or directory.
        way_out: what the user can do instead if the path exists.
        parents: whether the caller will also make the missing folders above it.

    Raises:
        TsbenchError: the path exists or cannot be made.
    """
    if path.exists() or path.is_symlink():
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
        write_new(path, encode_json(content))


# A text, which stays as it is, or a list without texts, lists and objects.
_LIST = re.compile(r'("(?:[^"\\]|\\.)*")|\[[^][{}"]*\]')


def encode_json(content: Any) -> bytes:
    """The bytes of a JSON file that `write_json` writes: every list of plain values on one line."""
    text = json.dumps(content, indent=2)
    return (_LIST.sub(lambda one: one[1] or " ".join(one[0].split()), text) + "\n").encode()


def lock(path: Path, *, wait: bool) -> int | None:
    """Locks a folder, or a file, which is made if need be, against other processes. The kernel
    releases the lock when its holder ends, however it ends.

    Returns:
        The descriptor that holds the lock, to be closed; None if another process has the lock and
        `wait` is false.
    """
    if path.is_dir():
        descriptor = os.open(path, os.O_RDONLY)
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Has the `lock` of a folder or file, for which it waits."""
    descriptor = lock(path, wait=True)
    assert descriptor is not None
    try:
        yield
    finally:
        os.close(descriptor)
