"""What passes between a task and what steps it: states, courses, starts and sensor readings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np

from tsbench.core.arrays import Array, array_namespace

Rng = np.random.Generator


@dataclass(frozen=True)
class Batch:
    """Arrays with the same leading batch axes."""

    def replace(self, **changes: Array) -> Self:
        return dataclasses.replace(self, **changes)

    def updated(self, rows: Array, other: Self) -> Self:
        """The same with the members of `other` in place of `rows` (first batch axis)."""

        def merge(field: dataclasses.Field[Any]) -> Array:
            old = getattr(self, field.name)
            values = array_namespace(old).asarray(old, copy=True)
            values[rows] = getattr(other, field.name)
            return values

        return self.replace(**{f.name: merge(f) for f in dataclasses.fields(self)})

    def rows(self, rows: Array | slice) -> Self:
        """Some members of the batch (first batch axis)."""
        return self.replace(
            **{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)}
        )

    @classmethod
    def joined(cls, batches: Sequence[Self]) -> Self:
        """All members, one batch after the other."""
        names = [field.name for field in dataclasses.fields(batches[0])]
        xp = array_namespace(getattr(batches[0], names[0]))
        return batches[0].replace(
            **{name: xp.concat([getattr(batch, name) for batch in batches]) for name in names}
        )


@dataclass(frozen=True)
class State(Batch):
    """The state of a task at one time step.

    Attributes:
        time: seconds since the start of the episode, shape (...,).
    """

    time: Array


S = TypeVar("S", bound=State)


@dataclass(frozen=True)
class Course(Batch):
    """The history of an episode that its last state does not tell.

    Attributes:
        violated: whether anything was violated on the way, shape (...,).
    """

    violated: Array


@dataclass(frozen=True)
class Start(Batch):
    """The states in which episodes begin or go on.

    Attributes:
        time: seconds since the start of the episode, shape (n,).
        qpos: generalised positions, shape (n, nq).
        qvel: generalised velocities, shape (n, nv).
        memory: the memory of `Plant.control`, shape (n, m).
    """

    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    memory: np.ndarray


@dataclass(frozen=True)
class Readings:
    """The quantities that a task reads from the physics after a control step.

    Attributes:
        time: seconds since the start of the episode, shape (...,).
        qpos: generalised positions, shape (..., nq).
        qvel: generalised velocities, shape (..., nv).
        sensors: values of the MJCF's sensors by name, each (..., dim). Position and velocity
            sensors are current at qpos and qvel; acceleration sensors lag by one substep.
        memory: what `Plant.control` remembers, shape (..., m).
    """

    time: Array
    qpos: Array
    qvel: Array
    sensors: Mapping[str, Array]
    memory: Array
