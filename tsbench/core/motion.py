"""Plans and reference motions, which the planning stage passes to the imitation stage."""

from __future__ import annotations

import dataclasses
import io
import math
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from tsbench.core.arrays import Array, array_namespace, step_of
from tsbench.core.errors import TsbenchError, quoted
from tsbench.core.files import read_file, write_whole

# Exceptions that numpy and zipfile raise for damaged files. RuntimeError covers encrypted members
# and unknown compression methods.
DAMAGE = (
    OSError, ValueError, TypeError, EOFError, KeyError, RuntimeError, MemoryError, OverflowError,
    zlib.error, zipfile.BadZipFile, struct.error, SyntaxError,
)  # fmt: skip

# Limits of a recording's file. A reference motion of 20 s at 100 Hz takes 1 MB unpacked.
MAX_FILE = 4 * 2**20  # bytes
MAX_UNPACKED = 16 * 2**20  # bytes of all arrays together
MAX_ARRAYS = 32
MAX_FRAMES = 20_000
_KINDS = "bifU"  # of arrays: truth values, numbers and text, nothing that is unpickled

_ORIGIN = ("task", "task_version", "timestep")  # fields of every recording


@dataclass(frozen=True)
class _Recording:
    """Arrays over time and their origin, saved in one npz file that contains no pickled code."""

    kind: ClassVar[str]
    dimensions: ClassVar[dict[str, int]]  # number of axes of each array

    task: str
    task_version: int
    timestep: float

    def __post_init__(self) -> None:
        problem = self._problem()
        if problem:
            raise TsbenchError(f"not a valid {self.kind}: {problem}")

    def _problem(self) -> str | None:
        for name, kind in (("task", str), ("task_version", int), ("timestep", float)):
            if type(getattr(self, name)) is not kind:
                return f"{name} must be {kind.__name__}, not {quoted(getattr(self, name))}"
        if not (np.isfinite(self.timestep) and self.timestep > 0.0):
            return f"the time step is {self.timestep}, it must be positive"
        for name, ndim in self.dimensions.items():
            array = getattr(self, name)
            if not isinstance(array, np.ndarray) or array.ndim != ndim:
                return f"{name} must be an array of {ndim} dimensions"
            if array.dtype != np.float64:
                return f"{name} is of type {array.dtype}"
        for name, array in self.arrays.items():
            if len(array) > MAX_FRAMES:
                return f"{name} has {len(array)} frames, at most {MAX_FRAMES} are allowed"
            if array.dtype.kind == "f" and not np.all(np.isfinite(array)):
                return f"{name} holds values that are not finite"
        return None

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays by name; their first axis is time."""
        return {name: getattr(self, name) for name in self.dimensions}

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in self.arrays.items())
        return f"<{type(self).__name__} of {self.task}: {shapes}, every {self.timestep:g} s>"

    def save(self, path: Path | str) -> None:
        """Writes the recording to a file, atomically (see `write_whole`).

        Raises:
            OSError: the file cannot be written.
        """
        content = io.BytesIO()
        np.savez_compressed(content, allow_pickle=False, kind=self.kind, **self._content())
        write_whole(Path(path), content.getvalue())

    def _content(self) -> dict[str, Any]:
        """The content of the file by name."""
        return {**{name: getattr(self, name) for name in _ORIGIN}, **self.arrays}

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads a recording.

        Raises:
            TsbenchError: the file is missing, damaged, or of another kind.
        """
        content = _content(Path(path), cls.kind)
        found = str(content.pop("kind", "unknown"))
        if found != cls.kind:
            raise TsbenchError(f"{path} is not a {cls.kind} file (it says: {found})")
        try:
            return cls._from_content({name: _plain(value) for name, value in content.items()})
        except (TsbenchError, TypeError, ValueError, AttributeError) as error:
            raise TsbenchError(f"damaged {cls.kind} file {path}: {error}") from None

    @classmethod
    def _from_content(cls, content: dict[str, Any]) -> Self:
        """The recording with the content of a file.

        Raises:
            TsbenchError: values are missing, unknown or wrong.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        if differing := names ^ set(content):
            raise TsbenchError(f"missing or unknown {', '.join(sorted(differing))}")
        return cls(**content)


def _content(path: Path, kind: str) -> dict[str, np.ndarray]:
    """The arrays of a recording's file, whose sizes are looked at before anything is unpacked.

    Raises:
        TsbenchError: the file is missing, damaged, or beyond the limits.
    """
    packed = read_file(path, MAX_FILE, kind)
    try:
        if not zipfile.is_zipfile(io.BytesIO(packed)):
            raise ValueError("it is no npz file")
        with zipfile.ZipFile(io.BytesIO(packed)) as file:
            members = file.infolist()
            if len(members) > MAX_ARRAYS:
                raise ValueError(f"it holds {len(members)} arrays, at most {MAX_ARRAYS} may be")
            if sum(member.file_size for member in members) > MAX_UNPACKED:
                raise ValueError(f"unpacked it is larger than {MAX_UNPACKED:,} bytes")
            content = {}
            for member in members:
                name = member.filename.removesuffix(".npy")
                try:
                    content[name] = _array(_unpacked(file, member))
                except ValueError as error:
                    raise ValueError(f"{quoted(name)}: {error}") from None
        if len(content) < len(members):
            raise ValueError("an array is there twice")
    except DAMAGE as error:
        reason = str(error) or type(error).__name__
        raise TsbenchError(f"damaged {kind} file {path}: {reason}") from None
    return content


def _unpacked(file: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """A member's data, and no more than the directory says, however much they would inflate to."""
    with file.open(member) as opened:
        return opened.read(member.file_size)


def _array(data: bytes) -> np.ndarray:
    """The array of an npy file in memory, made only once its header fits its size.

    Raises:
        ValueError: the data are no npy file of version 1, or of a kind that a recording lacks.
    """
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("it is of another version of the npy format")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.kind not in _KINDS:
        raise ValueError(f"it is of type {quoted(str(dtype))}")
    if math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError(f"its size is not that of its shape {quoted(shape)}")
    flat = np.frombuffer(data, dtype, offset=stream.tell())
    return flat.reshape(shape, order="F" if fortran else "C").copy(order="K")


def _plain(value: np.ndarray) -> Any:
    return value.item() if value.ndim == 0 else value


@dataclass(frozen=True, repr=False)
class Plan(_Recording):
    """The abstract trajectory of the planning stage.

    Attributes:
        states: abstract coordinates (`Abstraction.coordinates`), shape (T + 1, n).
        rewards: planning reward of each step, shape (T,).
    """

    kind: ClassVar[str] = "plan"
    dimensions: ClassVar[dict[str, int]] = {"states": 2, "rewards": 1}

    states: np.ndarray
    rewards: np.ndarray

    def _problem(self) -> str | None:
        if problem := super()._problem():
            return problem
        if len(self.states) != len(self.rewards) + 1 or len(self.states) < 2:
            return f"{len(self.states)} states and {len(self.rewards)} rewards do not match"
        return None

    @property
    def times(self) -> np.ndarray:
        """Seconds of each state, shape (T + 1,)."""
        return np.arange(len(self.states)) * self.timestep


@dataclass(frozen=True, repr=False)
class ReferenceMotion(_Recording):
    """A plan as full poses at the control rate.

    Attributes:
        qpos: generalised positions, shape (T + 1, nq).
        qvel: generalised velocities by central differences, shape (T + 1, nv).
        tracked: further arrays that the task's imitation reward compares, by name, each of shape
            (T + 1, ...), float64 or bool (`Plannable.tracked`).
    """

    kind: ClassVar[str] = "reference motion"
    dimensions: ClassVar[dict[str, int]] = {"qpos": 2, "qvel": 2}

    qpos: np.ndarray
    qvel: np.ndarray
    tracked: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def _problem(self) -> str | None:
        for name, array in self.tracked.items():
            if not isinstance(array, np.ndarray) or array.ndim < 1:
                return f"{name} must be an array over time"
            if array.dtype not in (np.float64, np.bool_):
                return f"{name} is of type {array.dtype}"
        if problem := super()._problem():
            return problem
        lengths = {name: len(array) for name, array in self.arrays.items()}
        if len(set(lengths.values())) != 1 or lengths["qpos"] < 2:
            return f"the lengths do not match: {lengths}"
        return None

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {**super().arrays, **self.tracked}

    def _content(self) -> dict[str, Any]:
        return {**super()._content(), "tracked": np.array(sorted(self.tracked), np.str_)}

    @classmethod
    def _from_content(cls, content: dict[str, Any]) -> Self:
        named = content.pop("tracked", None)
        if not isinstance(named, np.ndarray) or named.dtype.kind != "U" or named.ndim != 1:
            raise TsbenchError("missing the names of what is tracked")
        tracked = {name: content.pop(name) for name in named.tolist() if name in content}
        if missing := set(named.tolist()) - tracked.keys():
            raise TsbenchError(f"missing or unknown {', '.join(sorted(missing))}")
        return super()._from_content({**content, "tracked": tracked})

    @property
    def steps(self) -> int:
        return len(self.qpos) - 1

    @property
    def duration(self) -> float:
        """Seconds."""
        return self.steps * self.timestep

    @property
    def times(self) -> np.ndarray:
        """Seconds of each frame, shape (T + 1,)."""
        return np.arange(self.steps + 1) * self.timestep

    def frame(self, time: Array) -> Array:
        """Index of the frame nearest to each time in seconds, shape as `time`; the last frame for
        later times."""
        return array_namespace(time).clip(step_of(time, self.timestep), 0, self.steps)


def read_motion(path: Path | str) -> Plan | ReferenceMotion:
    """Reads a plan or a reference motion, whichever the file holds.

    Raises:
        TsbenchError: the file is missing, damaged, or neither.
    """
    found = str(_content(Path(path), "plan").get("kind"))
    return ReferenceMotion.load(path) if found == ReferenceMotion.kind else Plan.load(path)


@dataclass(frozen=True, repr=False)
class ActionLog(_Recording):
    """The actions and rewards of some episodes, from which their physics can be replayed.

    Attributes:
        actions: actions of the nominal, then of the perturbed episodes, shape (T, n, action_size).
        rewards: reward of each step, shape (T, n); zero after the end of an episode.
    """

    kind: ClassVar[str] = "action log"
    dimensions: ClassVar[dict[str, int]] = {"actions": 3, "rewards": 2}

    actions: np.ndarray
    rewards: np.ndarray

    def _problem(self) -> str | None:
        if problem := super()._problem():
            return problem
        if self.actions.shape[:2] != self.rewards.shape:
            return f"actions {self.actions.shape} and rewards {self.rewards.shape} do not match"
        return None


@dataclass(frozen=True, repr=False)
class Roadmap(_Recording):
    """A roadmap as it is drawn. Positions are the robot's, in the world frame in metres.

    Attributes:
        nodes: shape (n, 3).
        edges: pairs of indices of nodes, int64, shape (m, 2).
        path: the way that was planned, shape (k, 3).
        checked: edges that were checked, free or not.
    """

    kind: ClassVar[str] = "roadmap"
    dimensions: ClassVar[dict[str, int]] = {"nodes": 2, "path": 2}

    nodes: np.ndarray
    edges: np.ndarray
    path: np.ndarray
    checked: int

    def _problem(self) -> str | None:
        if problem := super()._problem():
            return problem
        if type(self.checked) is not int or self.checked < 0:
            return f"checked must be a number of edges, not {self.checked!r}"
        if self.nodes.shape[1] != 3 or self.path.shape[1] != 3 or len(self.path) < 2:
            return "nodes and path must be positions"
        edges = self.edges
        if not isinstance(edges, np.ndarray) or edges.dtype != np.int64 or edges.shape[1:] != (2,):
            return "edges must be pairs of indices"
        if edges.size and not 0 <= edges.min() <= edges.max() < len(self.nodes):
            return "edges join nodes that are not there"
        return None

    def _content(self) -> dict[str, Any]:
        return {**super()._content(), "edges": self.edges, "checked": self.checked}


@dataclass(frozen=True)
class AuditItem:
    """One measured property of a plan or reference motion, and its largest allowed value."""

    what: str
    value: float
    limit: float
    unit: str

    @property
    def passed(self) -> bool:
        return bool(self.value <= self.limit)

    def __str__(self) -> str:
        verdict = "ok" if self.passed else "TOO MUCH"
        return f"{self.what}: {self.value:.3g} {self.unit} (at most {self.limit:.3g}) {verdict}"


@dataclass(frozen=True)
class Audit:
    """Measured properties that tell whether physics can follow a plan."""

    items: tuple[AuditItem, ...]

    @property
    def passed(self) -> bool:
        return all(item.passed for item in self.items)

    @property
    def failures(self) -> tuple[AuditItem, ...]:
        return tuple(item for item in self.items if not item.passed)
