"""Durations, numbers and commands as text."""

from __future__ import annotations

import math
import shlex
from typing import Any


def duration(seconds: float) -> str:
    """h:mm:ss, or m:ss below an hour."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def command(*words: object) -> str:
    """A command of tsbench as a shell reads it, with quotes where they are needed."""
    return shlex.join(["tsbench", *map(str, words)])


def several(count: int, what: str) -> str:
    """A count of things: "1 seed", "2 seeds"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def short(steps: float) -> str:
    """A number of steps to three digits: k for thousands, M for millions, G for billions."""
    rounded = float(f"{steps:.3g}")
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if rounded >= size:
            return f"{rounded / size:.3g}{letter}"
    return f"{rounded:.0f}"


def number(value: Any) -> str:
    """A number as text: a float with four significant digits; a dash for None, infinity or NaN."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
