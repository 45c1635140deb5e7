"""Constants of a task as one explicit record, each with its unit and its source."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from types import ModuleType
from typing import Any, NamedTuple

# Sources of constants, by the letters that docs/calibration.md and the task cards use.
SOURCES = {"P": "the paper", "D": "decided here", "C": "calibrated (docs/calibration.md)"}


def constant(value: Any, unit: str, source: str, meaning: str) -> Any:
    """A field of a frozen dataclass of constants.

    Args:
        value: a number, or a tuple of them.
        unit: unit of the value; "" if it has none.
        source: one or two letters of `SOURCES`. One letter is the source of the value. Two letters
            are the source of the formula, then the source of the value.
        meaning: what the constant means, in a few words.
    """
    assert set(source) <= SOURCES.keys(), source
    return dataclasses.field(
        default=value, metadata={"unit": unit, "source": source, "meaning": meaning}
    )


class Described(NamedTuple):
    """A constant of a record, with what `constant` was told of it."""

    name: str
    value: Any
    unit: str
    source: str
    meaning: str


def described(module: ModuleType) -> Iterator[Described]:
    """The constants of all records in a task's module."""
    for record in vars(module).values():
        if not dataclasses.is_dataclass(record) or isinstance(record, type):
            continue
        for field in dataclasses.fields(record):
            if about := field.metadata:
                value = getattr(record, field.name)
                yield Described(field.name, value, about["unit"], about["source"], about["meaning"])
