"""What a pull request changes, and which entries it brings.

A submission may add files of new entries and nothing else. Everything that decides is taken from
git's own records, since a working tree may show something else than what would be merged.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

from tsbench.core.errors import TsbenchError, quoted
from tsbench.leaderboard.kept import BOARD, MANIFEST, PROTOCOL
from tsbench.leaderboard.submission import FILE

MOST_FILES = 2000
_PLACE = re.compile(rf"({BOARD}/{PROTOCOL}/[a-z0-9_]+/[a-z0-9][a-z0-9_.+-]*)/(.+)")
REGULAR = "100644"  # mode of a file that is no link and cannot be executed


def entries(repository: Path, base: str) -> tuple[list[Path], list[str]]:
    """The entries that a pull request brings, and why it is no submission, if it is none.

    Args:
        repository: a checkout of what is to be merged.
        base: the commit that it is to be merged into.

    Returns:
        Directories, and faults in sentences; the first few of them.

    Raises:
        TsbenchError: git does not know the commit.
    """
    found: dict[Path, None] = {}
    faults: list[str] = []
    count = 0
    for status, mode, path in _changes(repository, base):
        count += 1
        match = _PLACE.fullmatch(path)
        if status != "A":
            faults.append(f"{quoted(path)} is changed: a submission only adds files")
        elif match is None or not (match[2] == MANIFEST or FILE.fullmatch(match[2])):
            faults.append(
                f"{quoted(path)} is no file of an entry, {BOARD}/{PROTOCOL}/TASK/ENTRY/..."
            )
        elif mode != REGULAR:
            faults.append(f"{quoted(path)} has mode {mode}, not that of a regular file")
        else:
            found[repository / match[1]] = None
    if not count:
        faults.append("it changes nothing")
    if count > MOST_FILES:
        faults.append(f"it adds {count} files, at most {MOST_FILES} are allowed")
    if len(faults) > 10:
        faults = [*faults[:10], f"and {len(faults) - 10} more"]
    return list(found), faults


def _changes(repository: Path, base: str) -> Iterator[tuple[str, str, str]]:
    """Status, mode and path of everything that differs from where the branches parted."""
    if base.startswith("-"):
        raise TsbenchError(f"{quoted(base)} is no commit")
    command = [
        "git", "-C", str(repository), "-c", "core.fsmonitor=false", "diff", "--raw", "-z",
        "--no-renames", "--no-ext-diff", "--no-textconv", f"{base}...HEAD", "--",
    ]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True)
    except OSError as error:
        raise TsbenchError(f"git cannot be run: {error.strerror}") from None
    if done.returncode:
        reason = done.stderr.decode(errors="replace")
        raise TsbenchError(f"git cannot compare {repository} with {base}: {reason}")
    words = done.stdout.decode(errors="surrogateescape").split("\0")
    for head, path in zip(words[0:-1:2], words[1::2], strict=True):
        _, mode, _, _, status = head.removeprefix(":").split(" ")
        yield status, mode, path
