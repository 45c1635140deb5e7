"""Checkpoints: the state that an interrupted run continues from, as data that cannot execute code.

A checkpoint is a safetensors file: arrays, and JSON for the rest. Its name holds the hash of its
content, so a file that a crash tore or that was damaged later is detected.
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

from tsbench.core.errors import TsbenchError
from tsbench.core.files import read_file, write_whole
from tsbench.core.method import Snapshot

FORMAT = 1
MAX_FILE = 2**30  # bytes
KEPT = 2  # checkpoints of each stage: if the last one is damaged, the one before serves
NAME = re.compile(r"(\d{2})-(\w+)-(\d{12})-([0-9a-f]{64})\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as it was read.

    Attributes:
        stage: number of the stage in the run, from 0.
        name: the stage's name.
        steps: environment steps of the stage so far.
        path: the file.
        content: the saved snapshot.
    """

    stage: int
    name: str
    steps: int
    path: Path
    content: Snapshot


class Checkpoints:
    """The checkpoints of a run, in a folder of its directory."""

    def __init__(self, folder: Path, damaged: Callable[[str], None]) -> None:
        """
        Args:
            folder: the folder of the checkpoints; `save` makes it.
            damaged: takes one line about each file that cannot be used.
        """
        self.folder = folder
        self._damaged = damaged

    def save(self, stage: int, name: str, steps: int, content: Snapshot) -> None:
        """Writes a checkpoint and removes the stage's oldest ones.

        Raises:
            OSError: the file cannot be written. The earlier checkpoints are still there then.
        """
        data = encode(content)
        digest = hashlib.sha256(data).hexdigest()
        before = self._paths(stage)
        self.folder.mkdir(exist_ok=True)
        write_whole(self.folder / f"{stage:02}-{name}-{steps:012}-{digest}.safetensors", data)
        for path in before[: len(before) - KEPT + 1]:
            path.unlink()

    def newest(self, stage: int | None = None) -> Checkpoint | None:
        """The newest undamaged checkpoint of a stage, or with `stage` None of the run.

        A damaged file is reported and renamed.
        """
        for path in reversed(self._paths(stage)):
            match = NAME.fullmatch(path.name)
            assert match is not None
            try:
                data = read_file(path, MAX_FILE, "checkpoint")
                if hashlib.sha256(data).hexdigest() != match[4]:
                    raise ValueError("its hash differs")
                return Checkpoint(int(match[1]), match[2], int(match[3]), path, decode(data))
            except (TsbenchError, ValueError) as error:
                self._damaged(f"damaged checkpoint {path} ({error}): going back to the one before")
                with suppress(OSError):  # so that no later run reads it again
                    path.rename(f"{path}.damaged")
        return None

    def _paths(self, stage: int | None) -> list[Path]:
        """The checkpoint files of a stage, or of all, in the order in which they were written."""
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
    """The snapshot that `encode` wrote.

    Raises:
        ValueError: the bytes are no checkpoint of this format.
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
