"""The kept entries that an installation brings, by short names such as `laikago_trot/twostage`."""

from __future__ import annotations

import re
from pathlib import Path

BOARD = Path("leaderboards")  # in a checkout
# A wheel ships it inside the package; a checkout has it beside the package.
FOLDERS = (Path(__file__).parents[1] / BOARD, Path(__file__).parents[2] / BOARD)
PROTOCOL = "v1"  # of the kept entries
MANIFEST = "manifest.json"  # makes a directory an entry
_SEED = re.compile(r"seed\d{1,10}")
_TRAINING = re.compile(rf"(.+)/({_SEED.pattern})")


def entries() -> dict[str, Path]:
    """The directories of the kept entries, by TASK/ENTRY, sorted."""
    for folder in FOLDERS:
        if (board := folder / PROTOCOL).is_dir():
            return {
                f"{task.name}/{entry.name}": entry
                for task in folders(board)
                for entry in folders(task)
                if (entry / MANIFEST).is_file()
            }
    return {}


def trainings(entry: Path) -> list[Path]:
    """The directories of an entry's trainings, by seed; none for another directory."""
    found = [one for one in folders(entry) if _SEED.fullmatch(one.name)]
    return sorted(found, key=lambda one: int(one.name.removeprefix("seed")))


def find(name: str) -> Path | None:
    """The directory of a kept entry, TASK/ENTRY, or of one of its trainings, TASK/ENTRY/seedN; None
    if there is no such entry."""
    found, name = entries(), name.removeprefix(f"{PROTOCOL}/").rstrip("/")
    if name in found:
        return found[name]
    match = _TRAINING.fullmatch(name)
    if match is None or match[1] not in found:
        return None
    return next((one for one in trainings(found[match[1]]) if one.name == match[2]), None)


def folders(path: Path) -> list[Path]:
    """The folders in a folder of a board, sorted; none where it is no folder."""
    if not path.is_dir():
        return []
    return sorted(one for one in path.iterdir() if one.is_dir() and not one.name.startswith("."))
