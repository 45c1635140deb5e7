"""Constants of a task as one explicit record, each with its unit and its source."""

from __future__ import annotations

import dataclasses
from typing import Any

# Where a constant comes from, as docs/calibration.md and the task cards have it.
SOURCES = {"P": "the paper", "D": "decided here", "C": "calibrated (docs/calibration.md)"}


def constant(value: Any, unit: str, source: str, meaning: str) -> Any:
    """A field of a frozen dataclass of constants.

    Args:
        value: a number, or a tuple of them.
        unit: of it; "" where it has none.
        source: letters of `SOURCES`: of the value, or of its form and then of its value.
        meaning: in a few words.
    """
    assert set(source) <= SOURCES.keys(), source
    return dataclasses.field(
        default=value, metadata={"unit": unit, "source": source, "meaning": meaning}
    )
