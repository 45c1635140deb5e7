"""Constants of a task as one explicit record, each with its unit and its source."""

from __future__ import annotations

import dataclasses
from typing import Any

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
