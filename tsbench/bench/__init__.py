"""How fast tsbench is, and what else is: ratios measured side by side in one run.

A comparison is one file here: a docstring whose first line says what is compared, and a function
with `@comparison("NAME")`. There is no list to edit; `tsbench bench --only NAME` finds it. Those
with libraries that tsbench does not need lie in benchmarks/, beside the package.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tsbench.bench.turns import FULL, QUICK, Effort, Range
from tsbench.core.errors import unknown

# What can change a figure.
PACKAGES = ("mujoco", "numpy", "torch", "rsl-rl-lib", "dm-control", "gymnasium", "mink")
EXTRAS = ("envpool", "stable-baselines3")
INSTALL = "pip install 'tsbench[bench]'"


def machine() -> dict[str, Any]:
    """Where this is, and with which versions."""
    found: dict[str, Any] = {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
    }
    for name in (*PACKAGES, *EXTRAS):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue  # an extra that nobody installed
    return found


def _processor() -> str:
    table = Path("/proc/cpuinfo")
    lines = table.read_text(encoding="utf-8").splitlines() if table.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


@dataclass
class Findings:
    """Attributes:
    figures: what was measured, such as `laikago.batched`, with units.
    ratios: of what was measured side by side, such as `laikago.batched/rollout`.
    notes: what to know about them, and what could not be measured.
    machine: where, and with which versions.
    """

    figures: dict[str, Range] = field(default_factory=dict)
    ratios: dict[str, Range] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    machine: dict[str, Any] = field(default_factory=machine)

    def add(self, other: Findings) -> None:
        self.figures |= other.figures
        self.ratios |= other.ratios
        self.notes += other.notes

    def as_dict(self) -> dict[str, Any]:
        """For `--json`: `ratios` are medians, `ranges` their least and most."""
        return {
            "ratios": {name: ratio.median for name, ratio in self.ratios.items()},
            "ranges": {name: [ratio.least, ratio.most] for name, ratio in self.ratios.items()},
            "figures": {name: vars(figure) for name, figure in self.figures.items()},
            "notes": self.notes,
            "machine": self.machine,
        }


Compare = Callable[[Effort], Findings]


@dataclass(frozen=True)
class Comparison:
    """Attributes:
    compare: measures, with a given effort.
    requires: modules beyond tsbench's own that it cannot do without.
    named: whether it takes so long that it is only run when it is named.
    """

    compare: Compare
    requires: tuple[str, ...]
    named: bool


_comparisons: dict[str, Comparison] = {}


def comparison(
    name: str, *, requires: tuple[str, ...] = (), named: bool = False
) -> Callable[[Compare], Compare]:
    """Adds a comparison, under the name that `--only` takes."""

    def add(compare: Compare) -> Compare:
        if name in _comparisons:
            raise ValueError(f"there is a comparison {name!r} already")
        _comparisons[name] = Comparison(compare, requires, named)
        return compare

    return add


@cache
def names() -> tuple[str, ...]:
    """All comparisons, sorted."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    return tuple(sorted(_comparisons))


def find(name: str) -> Comparison:
    """The comparison of that name.

    Raises:
        TsbenchError: there is none.
    """
    if name not in names():
        raise unknown("comparison", name, names())
    return _comparisons[name]


def measure(
    only: str | None = None, *, quick: bool = False, tell: Callable[[str], None] = lambda _: None
) -> Findings:
    """Runs the comparisons, or one of them.

    Args:
        only: its name; None for all that do not have to be named.
        quick: seconds instead of minutes, and larger ranges.
        tell: is told what is being measured.

    Raises:
        TsbenchError: `only` names no comparison.
    """
    wanted = [name for name in names() if not find(name).named] if only is None else [only]
    findings = Findings()
    for name in wanted:
        chosen = find(name)
        missing = [module for module in chosen.requires if find_spec(module) is None]
        if missing:
            findings.notes.append(f"{name}: not measured, lacks {', '.join(missing)} ({INSTALL})")
            continue
        tell(name)
        findings.add(chosen.compare(QUICK if quick else FULL))
    return findings
