"""Imports run downwards only, and heavy packages stay in their rooms."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import tsbench
from tsbench import methods, tasks

ROOT = Path(tsbench.__file__).parent

# The rooms that each room may import, lowest first. A room is a package or a file beside them.
MAY_KNOW: dict[str, set[str]] = {
    "core": set(),
    "gl": {"core"},
    "conf": set(),
    "planning": {"core"},
    "sim": {"core"},
    "tasks": {"core", "sim", "planning"},
    "rl": {"core", "sim"},
    "methods": {"core", "sim", "planning", "rl"},
    "evaluation": {"core", "sim", "tasks"},
    "runs": {"core", "sim", "tasks", "rl", "methods", "evaluation"},
    "leaderboard": {"core", "sim", "tasks", "evaluation", "runs"},
    "viewer": {"core", "sim", "tasks", "evaluation", "runs"},
    "bench": {"core", "sim", "tasks", "rl", "methods", "evaluation", "runs"},
}
# The commands and the public interfaces may import every room.
ROOFS = {"cli", "gym", "testing", "tsbench", "__main__"}

# The rooms, or single files of rooms, that may import each package.
ONLY_IN: dict[str, set[str]] = {
    "torch": {"rl", "sim.device", "sim.warp", "bench.gpu", "testing", "evaluation.on_robot"},
    "warp": {"sim.warp"},
    "mujoco_warp": {"sim.warp"},
    "rsl_rl": {"rl", "testing"},
    "tensordict": {"rl"},
    "threadpoolctl": {"rl", "evaluation.origin"},
    "gymnasium": {"sim.gym", "gym", "bench"},
    "mink": {"planning"},
    "dm_control": {"sim", "tsbench"},
    "dm_env": {"sim", "testing"},
    "mujoco": {"core.task", "planning", "sim", "tasks", "viewer", "bench"},
    "safetensors": {"core.policy", "runs.checkpoint", "evaluation.on_robot"},
    "optuna": {"runs.tune"},
    "hydra": {"runs.config", "cli.launch"},
    "omegaconf": {"runs.config", "cli.launch"},
    "jinja2": {"leaderboard"},
    "meshcat": {"viewer"},
    "matplotlib": {"viewer"},
    "pytest": {"testing"},
    "tensorboard": {"runs.events"},
    "wandb": {"runs.events"},
    "mlflow": {"runs.events"},
    "rich": {"runs.progress", "runs.workspace", "runs.execute", "cli", "bench"},
}
# The rooms that may delay an import until they need it.
STARTS_FAST = {"tsbench", "cli"}


def room(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "tsbench"


def modules() -> Iterator[tuple[str, ast.Module]]:
    for path in sorted(ROOT.rglob("*.py")):
        relative = path.relative_to(ROOT.parent).with_suffix("")
        yield ".".join(relative.parts).removesuffix(".__init__"), ast.parse(path.read_text("utf-8"))


def imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            module = node.module or ""
            for alias in node.names:  # from tsbench.cli import launch, or from numpy import array
                inner = f"{module}.{alias.name}"
                yield inner if module == "tsbench" or inner in MODULES else module


MODULES = dict(modules())


def ours(name: str) -> set[str]:
    found = {name for name in imported(MODULES[name]) if name.split(".")[0] == "tsbench"}
    # A name that is no module was taken from the package itself: from tsbench import load.
    return {name if room(name) in MAY_KNOW.keys() | ROOFS else "tsbench" for name in found}


def test_the_table_has_an_order() -> None:
    tuple(TopologicalSorter(MAY_KNOW).static_order())
    assert set().union(*MAY_KNOW.values()) <= MAY_KNOW.keys()


@pytest.mark.parametrize("name", MODULES)
def test_imports_run_downwards(name: str) -> None:
    own = room(name)
    if own in ROOFS:
        return
    assert own in MAY_KNOW, f"{name} has no place among the rooms"
    strangers = {other for other in ours(name) if room(other) not in MAY_KNOW[own] | {own}}
    assert not strangers


def test_no_circles_within_a_room() -> None:
    graph = {name: ours(name) & MODULES.keys() - {name} for name in MODULES}
    tuple(TopologicalSorter(graph).static_order())


def test_tasks_and_methods_do_not_know_their_like() -> None:
    """A new task or method is one file: the registry finds it, and no other file names it."""
    for package in ("tsbench.tasks", "tsbench.methods"):
        files = {name for name in MODULES if name.startswith(f"{package}.")}
        assert len(files) >= 2
        for name in (package, *files):
            assert not ours(name) & files, name


def test_nothing_lists_tasks_or_methods() -> None:
    """Outside the file of a task or method no string of the package is its name, except where the
    paper's figures say which methods are the paper's."""
    listed = {*tasks.names(), *methods.names()}
    for name, tree in MODULES.items():
        if room(name) not in ("tasks", "methods") and name != "tsbench.viewer.paper.exhibit":
            strings = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)}
            assert not strings & listed, name


def test_heavy_packages_stay_in_their_rooms() -> None:
    for name, tree in MODULES.items():
        for package in {other.split(".")[0] for other in imported(tree)} & ONLY_IN.keys():
            place = name.removeprefix("tsbench.")
            assert {place, room(name)} & ONLY_IN[package], f"{name} imports {package}"


def test_imports_stand_at_the_top() -> None:
    """An import within a function hides a cycle, except where it makes a command start fast."""
    for name, tree in MODULES.items():
        functions = [n for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.Lambda))]
        inner = [other for function in functions for other in imported(function)]
        assert not inner or room(name) in STARTS_FAST, f"{name} imports {inner} in a function"


def test_evaluation_needs_no_learning() -> None:
    """No part of the public interface loads torch."""
    program = (
        "import sys, tsbench, tsbench.evaluation.evaluate, tsbench.core.policy, tsbench.methods\n"
        "tsbench.load('rocket_navigation').reset()\n"
        "print(*sorted({'torch', 'rsl_rl', 'hydra', 'meshcat', 'warp'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT.parent
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
