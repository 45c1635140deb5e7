"""Checkpoints: what an interrupted run goes on from, as data that cannot execute code.

A checkpoint is a safetensors file: arrays, and JSON for the rest. Its name holds the hash of its
content, so that one that was torn by a crash or damaged later is told from a whole one.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from tsbench.core.files import write_whole
from tsbench.core.method import Snapshot

FORMAT = 1
KEPT = 2  # of each stage: should the last one turn out damaged, there is the one before
NAME = re.compile(r"(\d{2})-(\w+)-(\d{12})-([0-9a-f]{64})\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """Attributes:
    stage: number of the stage in the run, from 0.
    name: of the stage.
    steps: environment steps of the stage.
    path: the file.
    content: what was saved.
    """

    stage: int
    name: str
    steps: int
    path: Path
    content: Snapshot


class Checkpoints:
    """The checkpoints of a run, in a folder of its directory."""

    def __init__(self, folder: Path, damaged: Callable[[str], None]) -> None:
        """`damaged` is told, in a line, of each file that cannot be used."""
        self.folder = folder
        self._damaged = damaged

    def save(self, stage: int, name: str, steps: int, content: Snapshot) -> None:
        """Writes a checkpoint and removes the stage's oldest ones.

        Raises:
            OSError: as the system says; the checkpoints from before are then still there.
        """
        data = encode(content)
        digest = hashlib.sha256(data).hexdigest()
        before = self._paths(stage)
        self.folder.mkdir(exist_ok=True)
        write_whole(self.folder / f"{stage:02}-{name}-{steps:012}-{digest}.safetensors", data)
        for path in before[: len(before) - KEPT + 1]:
            path.unlink()

    def newest(self, stage: int | None = None) -> Checkpoint | None:
        """The last one that is whole: of a stage, or of the run."""
        for path in reversed(self._paths(stage)):
            match = NAME.fullmatch(path.name)
            assert match is not None
            try:
                data = path.read_bytes()
                if hashlib.sha256(data).hexdigest() != match[4]:
                    raise ValueError("its hash differs")
                return Checkpoint(int(match[1]), match[2], int(match[3]), path, decode(data))
            except (OSError, ValueError) as error:
                self._damaged(f"damaged checkpoint {path} ({error}): going back to the one before")
                with suppress(OSError):  # out of the way
                    path.rename(f"{path}.damaged")
        return None

    def _paths(self, stage: int | None) -> list[Path]:
        """In the order in which they were written."""
        if not self.folder.is_dir():
            return []
        paths = [path for path in self.folder.iterdir() if NAME.fullmatch(path.name)]
        if stage is not None:
            paths = [path for path in paths if path.name.startswith(f"{stage:02}-")]
        return sorted(paths)


def encode(content: Snapshot) -> bytes:
    """A snapshot as a safetensors file."""
    arrays: dict[str, np.ndarray] = {}
    rest = {"format": FORMAT, "content": _without_arrays(content, "", arrays)}
    return save(arrays, metadata={"rest": json.dumps(rest)})


def _without_arrays(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_arrays(v, f"{path}/{key}", arrays) for key, v in value.items()}
    if isinstance(value, np.ndarray):
        arrays[path] = np.asarray(value, order="C")
        return None
    return value


def decode(data: bytes) -> Snapshot:
    """What `encode` was given.

    Raises:
        ValueError: the bytes are something else.
    """
    try:
        arrays = load(data)
        length = int.from_bytes(data[:8], "little")
        rest = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["rest"])
        if rest["format"] != FORMAT:
            raise ValueError(f"its format is {rest['format']}, not {FORMAT}")
        content = rest["content"]
        for path, array in arrays.items():
            *folders, name = path.split("/")[1:]
            place = content
            for folder in folders:
                place = place[folder]
            place[name] = array
    except (SafetensorError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"not a checkpoint ({error})") from None
    if not isinstance(content, dict):
        raise ValueError("not a checkpoint")
    return content
