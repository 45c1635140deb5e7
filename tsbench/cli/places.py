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
        found = kept.find(word)
        near = nearest(word, kept.entries()) if found is None and "/" in word else None
        if near is not None:
            raise TsbenchError(f"no run directory {place} (did you mean the kept entry {near}?)")
        place = found or place
    if not (place / "policy.json").exists() and (seeds := kept.trainings(place)):
        return seeds[0]
    return place


def entry(word: str) -> Path:
    """The directory of an entry: the one that a word names, or a kept one's, TASK/ENTRY."""
    place = path(word)
    return place if place.exists() or place.is_symlink() else kept.find(word) or place
