"""Provenance: the configuration, code, versions and physics that determine a run's results."""

from __future__ import annotations

import hashlib
import platform
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

from tsbench import methods, tasks
from tsbench.core import plugins
from tsbench.core.errors import TsbenchError
from tsbench.core.files import write_json, write_whole
from tsbench.core.method import Problem
from tsbench.core.words import command
from tsbench.rl import processes
from tsbench.rl.devices import CPU, described
from tsbench.runs import schema
from tsbench.runs.directory import RunDirectory
from tsbench.runs.schema import RunConfig
from tsbench.sim.model import compiled_hash

PACKAGE = Path(str(files("tsbench")))
# Packages whose version can change a number in a run.
PACKAGES = (
    "dm-control",
    "gymnasium",
    "hydra-core",
    "mink",
    "mujoco",
    "numpy",
    "rsl-rl-lib",
    "scipy",
    "torch",
    "tsbench",
)
_NAMES = {  # the keys of `identity`, in words
    "configuration": "configuration",
    "python": "version of Python",
    "packages": "version of a package",
    "code": "version of tsbench's own code",
    "plug-ins": "version of a plug-in",
    "physics": "model of the task",
    "device": "GPU, driver or version of mujoco-warp",
    "processes": "number of processes",
}


def write_provenance(
    run: RunDirectory, config: RunConfig, problem: Problem, words: Sequence[str]
) -> None:
    """Writes versions.json and config.yaml, which suffice to repeat the run.

    config.yaml comes last: its presence says that the run has begun.
    """
    versions = {
        **identity(config, problem),
        "platform": platform.platform(),
        "commit": _commit(),
    }
    run.versions_file.unlink(missing_ok=True)
    write_json(run.versions_file, versions)
    write_whole(run.config_file, schema.encode(asdict(config), command("run", *words)))


def identity(config: RunConfig, problem: Problem) -> dict[str, Any]:
    """Hashes and versions that determine a run's results to the last bit, on one kind of machine.

    They cover the configuration, Python, packages, tsbench's code, plug-ins, the physics model and,
    off the CPU, the device. On a GPU without `deterministic` they do not determine the last bits.
    """
    code = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        code.update(path.read_bytes())
    brought = {tasks.provider(problem.task.name), methods.provider(config.method["name"])}
    foreign = sorted(one for one in brought if one not in (None, plugins.own()))
    where: dict[str, Any] = {}
    if config.device != CPU:
        where["device"] = described(config.device)
    if processes.count() > 1:
        where["processes"] = processes.count()
    return {
        "configuration": schema.identity_hash(asdict(config)),
        "python": platform.python_version(),
        "packages": {name: plugins.version_of(name) for name in PACKAGES},
        "code": code.hexdigest(),
        "plug-ins": {
            provider.distribution: {"version": provider.version, "code": provider.code()}
            for provider in foreign
        },
        "physics": {problem.task.name: compiled_hash(problem.task.spec())},
        **where,
    }


def check_provenance(run: RunDirectory, config: RunConfig, problem: Problem) -> None:
    """Checks that a resumed run would end with the same bits as the run that was begun.

    Raises:
        TsbenchError: a part of the run's identity differs from its `versions.json`.
    """
    before = run.versions()
    now = identity(config, problem)
    for name in _NAMES:
        if before.get(name) != now.get(name):
            raise TsbenchError(
                f"{run.path} was begun with another {_NAMES[name]} (see {run.versions_file}), "
                "so an exact resume is impossible: begin it again elsewhere"
            )


def _commit() -> str | None:
    """The git commit of tsbench's checkout, with "+" if a file of the package or a model was
    changed; None without git."""
    root = PACKAGE.parent
    if not (root / ".git").exists() or shutil.which("git") is None:
        return None
    git = ["git", "-C", str(root)]
    commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True)
    status = [*git, "status", "--porcelain", "--", PACKAGE.name, "models"]
    changes = subprocess.run(status, capture_output=True, text=True)
    if commit.returncode:
        return None
    return commit.stdout.strip() + ("+" if changes.stdout else "")
