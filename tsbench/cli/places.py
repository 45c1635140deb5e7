"""The places that words of the command line name: files, run directories and kept entries."""

from __future__ import annotations

import os
from pathlib import Path

from tsbench.core.errors import TsbenchError, nearest
from tsbench.leaderboard import kept

# Files that stand for the directory of the run or policy in which they lie.
PARTS = ("config.yaml", "policy.json", "policy.safetensors", "report.html", "score.json")


def path(word: str) -> Path:
    """The path that a word names, with ~ for the home directory: a shell leaves `--html=~/x` and
    `directory=~/x` as they are."""
    return Path(os.path.expanduser(word))  # noqa: PTH111  Path's own fails for an unknown user


def run(word: str) -> Path:
    """The directory of a run: the one that a word names, the one in which the file that it names
    lies, or a kept entry's, TASK/ENTRY. Of an entry with several trainings it is the one with the
    lowest seed.

    What does not exist is returned as it is, so that the reader can say what is missing.

    Raises:
        TsbenchError: nothing has that name, and a kept entry has one much like it.
    """
    place = path(word)
    if place.is_file() and place.name in PARTS:
        place = place.parent
    if not (place.exists() or place.is_symlink()):
        place = _kept(word, "run directory") or place
    if not (place / "policy.json").exists() and (seeds := kept.trainings(place)):
        return seeds[0]
    return place


def entry(word: str) -> Path:
    """The directory of an entry: the one that a word names, or a kept one's, TASK/ENTRY.

    Raises:
        TsbenchError: as `run`.
    """
    place = path(word)
    return place if place.exists() or place.is_symlink() else _kept(word, "directory") or place


def board(given: Path | None, here: Path, *, written: bool) -> Path:
    """The board: the one that an option gives, the one here, or that of the kept entries, which
    commands only read.

    Raises:
        TsbenchError: there is none, or none here to write to.
    """
    kept_board = next((folder for folder in kept.FOLDERS if folder.is_dir()), here)
    chosen = given or (here if written or (here / kept.PROTOCOL).is_dir() else kept_board)
    if not chosen.is_dir():
        raise TsbenchError(f"no board {chosen}: --board names its directory")
    return chosen


def _kept(word: str, what: str) -> Path | None:
    """The kept entry of that name; None if nothing is called nearly so.

    Raises:
        TsbenchError: there is none, but one with much the same name, or entries of a task with it.
    """
    found, entries = kept.find(word), kept.entries()
    if found is None and "/" in word:
        near = nearest(word, entries)
    elif found is None:
        task = nearest(word, {name.partition("/")[0] for name in entries})
        near = next((name for name in entries if name.startswith(f"{task}/")), None)
    else:
        return found
    if near is not None:
        raise TsbenchError(f"no {what} {path(word)} (did you mean the kept entry {near}?)")
    return None
