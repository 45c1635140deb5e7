"""Benchmarks of speed: ratios of alternatives measured in turns in one run.

A comparison is one file in this package, with a docstring whose first line names the compared
things, and a function with `@comparison("NAME")`. There is no list to edit: `tsbench bench --only
NAME` finds it. Comparisons with libraries that tsbench does not need are in benchmarks/, outside
the package.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tsbench.bench.turns import FULL, QUICK, Effort, Range
from tsbench.core import plugins
from tsbench.core.errors import unknown

# Packages whose version can change a figure.
PACKAGES = ("mujoco", "numpy", "torch", "rsl-rl-lib", "dm-control", "gymnasium", "mink")
EXTRAS = ("envpool", "stable-baselines3")
INSTALL = "pip install 'tsbench[bench]'"


def machine() -> dict[str, Any]:
    """The processor, system and package versions of this machine."""
    found: dict[str, Any] = {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
    }
    versions = {name: plugins.version_of(name) for name in (*PACKAGES, *EXTRAS)}
    return found | {name: version for name, version in versions.items() if version}


def _processor() -> str:
    table = Path("/proc/cpuinfo")
    lines = table.read_text(encoding="utf-8").splitlines() if table.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


@dataclass
class Findings:
    """The results of comparisons.

    Attributes:
        figures: measured quantities with units, such as `laikago.batched`.
        ratios: ratios of quantities measured in turns, such as `laikago.batched/rollout`.
        notes: remarks on the results, and comparisons that could not be run.
        machine: the machine and its package versions.
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
        """The content of the `--json` file: `ratios` holds medians, `ranges` least and most."""
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
    """A registered comparison.

    Attributes:
        compare: measures with a given effort.
        requires: modules of optional packages that it needs.
        named: whether it runs only when it is named, because it takes long.
    """

    compare: Compare
    requires: tuple[str, ...]
    named: bool


_comparisons: dict[str, Comparison] = {}


def comparison(
    name: str, *, requires: tuple[str, ...] = (), named: bool = False
) -> Callable[[Compare], Compare]:
    """Registers a comparison under the name that `--only` takes.

    Args:
        name: the name.
        requires: modules of optional packages that it needs.
        named: whether it runs only when it is named.

    Raises:
        ValueError: the name is taken.
    """

    def add(compare: Compare) -> Compare:
        if name in _comparisons:
            raise ValueError(f"there is a comparison {name!r} already")
        _comparisons[name] = Comparison(compare, requires, named)
        return compare

    return add


@cache
def names() -> tuple[str, ...]:
    """The names of all comparisons whose files' packages are installed, sorted."""
    for module in pkgutil.iter_modules(__path__):
        try:
            importlib.import_module(f"{__name__}.{module.name}")
        except ModuleNotFoundError as error:
            # A machine without a network may lack other packages, but no module of this one.
            if (error.name or "").partition(".")[0] == __name__.partition(".")[0]:
                raise
    return tuple(sorted(_comparisons))


def find(name: str) -> Comparison:
    """The comparison of that name.

    Raises:
        TsbenchError: no comparison has that name.
    """
    if name not in names():
        raise unknown("comparison", name, names())
    return _comparisons[name]


def measure(
    only: str | None = None, *, quick: bool = False, tell: Callable[[str], None] = lambda _: None
) -> Findings:
    """Runs one comparison, or all of them.

    Args:
        only: name of the comparison; None runs all that do not have to be named.
        quick: measures for seconds instead of minutes, with larger ranges.
        tell: takes the name of each comparison before it runs.

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
