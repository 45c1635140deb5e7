"""Measures cases in turns, so that other load on the machine affects all of them alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Self

import numpy as np


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes:
        repeats: turns of every case.
        seconds: duration of a turn.
        count: environments in a batch.
        counts: numbers of environments that `scaling` compares.
        iterations: iterations of a training whose time is split.
        budget: budget of a training that is compared by its score.
    """

    repeats: int
    seconds: float
    count: int
    counts: tuple[int, ...]
    iterations: int
    budget: str


FULL = Effort(15, 0.7, 512, (1, 8, 64, 512, 4096, 16384), 10, "fast")
QUICK = Effort(5, 0.15, 512, (1, 64, 1024), 3, "smoke")


@dataclass(frozen=True)
class Range:
    """A quantity over repeated measurements."""

    median: float
    least: float
    most: float
    unit: str = ""

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray, unit: str = "") -> Self:
        return cls(float(median(values)), float(min(values)), float(max(values)), unit)


@dataclass(frozen=True)
class Case:
    """A thing to measure.

    Attributes:
        name: its name.
        steps: makes some control steps and returns their number, summed over environments.
        close: releases its processes and threads.
    """

    name: str
    steps: Callable[[], int]
    close: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class Rates:
    """Control steps per second of each case, one value for each turn."""

    turns: dict[str, np.ndarray]

    def range(self, name: str) -> Range:
        return Range.of(self.turns[name], "steps/s")

    def ratio(self, over: str, under: str) -> Range:
        """The range of the ratios of two cases, one ratio for each turn."""
        return Range.of(self.turns[over] / self.turns[under])


def take_turns(cases: Sequence[Case], effort: Effort) -> Rates:
    """Measures the cases in turns, and closes them."""
    turns: dict[str, list[float]] = {case.name: [] for case in cases}
    for case in cases:
        case.steps()  # the first call allocates memory
    for _ in range(effort.repeats):
        for case in cases:
            done, elapsed, began = 0, 0.0, time.perf_counter()
            while not done or elapsed < effort.seconds:
                done += case.steps()
                elapsed = time.perf_counter() - began
            turns[case.name].append(done / elapsed)
    for case in cases:
        case.close()
    return Rates({name: np.array(rates) for name, rates in turns.items()})
