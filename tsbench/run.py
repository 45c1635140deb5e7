"""One training run: a configuration in, a directory that explains itself out."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import yaml
from rich.console import Console

from tsbench import curves, methods, tables, tasks
from tsbench.config import RunConfig
from tsbench.errors import TsbenchError, os_errors
from tsbench.evaluation.evaluate import Score, evaluate
from tsbench.motion import ReferenceMotion
from tsbench.problem import Problem
from tsbench.record import CONFIG, CURVES, METRICS, PAGE, REFERENCE, SCORE, VERSIONS, write_json
from tsbench.rl.stages import KINDS, settings
from tsbench.sim.model import fingerprint
from tsbench.viewer.run_page import write_run_page
from tsbench.workspace import RunWorkspace

# What can change a number in a run.
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


def prepare(config: RunConfig) -> Problem:
    """What the configuration asks for, with all of it checked and nothing written.

    Raises:
        TsbenchError: unknown names, or values of the wrong type.
    """
    problem = Problem(
        task=tasks.make(config.task.name, **config.task.constants),
        budget=config.task.budgets[config.budget],
        training=config.task.training,
        options=config.method,
        seed=config.seed,
        threads=config.threads,
    )
    methods.options(methods.find(config.method["name"]).Options, problem)
    for kind in sorted(set(KINDS) | set(config.task.training)):
        settings(problem, kind)
    return problem


def execute(config: RunConfig, words: Sequence[str] = (), console: Console | None = None) -> Score:
    """Trains, evaluates, and leaves it all in `config.directory`.

    Args:
        config: what to run, with its directory.
        words: of the command line, for the record.
        console: where progress and results are shown.

    Raises:
        TsbenchError: the configuration is wrong, the directory exists or cannot be written, or
            the method cannot do the task. A run that fails before it has trained leaves nothing.
    """
    console = console or Console()
    problem = prepare(config)
    directory = Path(config.directory or "")
    with os_errors(directory):
        _create(directory)
        workspace: RunWorkspace | None = None
        try:
            _write_provenance(directory, config, problem, words)
            workspace = RunWorkspace(directory, console)
            workspace.note(f"{' '.join(['tsbench run', *words])} -> {directory}")
            return _train(config, problem, workspace, console)
        except (TsbenchError, OSError):
            if workspace is None or not workspace.stages:
                shutil.rmtree(directory, ignore_errors=True)
            raise
        finally:
            if workspace is not None:
                workspace.close()


def _train(config: RunConfig, problem: Problem, workspace: RunWorkspace, console: Console) -> Score:
    directory = workspace.directory
    policy = methods.find(config.method["name"]).train(problem, workspace)
    policy.save(directory)
    score = evaluate(policy, problem.task)
    record = {
        "task": problem.task.name,
        "task_version": problem.task.version,
        "standard": tasks.standard(problem.task),
        "method": config.method["name"],
        "seed": config.seed,
        "budget": config.budget,
        "score": score.as_dict(),
        "stages": workspace.stage_rows(),
    }
    curves.draw(directory / METRICS, directory / CURVES)
    reference = directory / REFERENCE
    write_run_page(
        directory / PAGE,
        problem.task,
        policy,
        ReferenceMotion.load(reference) if reference.exists() else None,
        title=tables.run_title(record),
        summary=tables.summary(record),
    )
    write_json(directory / SCORE, record)  # last: its presence says that the run is finished
    tables.show_run(console, record, directory)
    return score


def _create(directory: Path) -> None:
    try:
        directory.mkdir(parents=True)
    except FileExistsError:
        if not directory.is_dir():
            raise
        state = "a finished run" if (directory / SCORE).exists() else "an unfinished run"
        raise TsbenchError(
            f"{directory} holds {state} and nothing is overwritten: choose another directory=PATH"
        ) from None


def _write_provenance(
    directory: Path, config: RunConfig, problem: Problem, words: Sequence[str]
) -> None:
    """Writes what is needed to repeat the run: config.yaml and versions.json."""
    command = " ".join(["tsbench run", *words])
    content = yaml.safe_dump(asdict(config), sort_keys=False)
    (directory / CONFIG).write_text(f"# {command}\n{content}", encoding="utf-8")
    versions = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: _version(name) for name in PACKAGES},
        "commit": _commit(),
        "physics": {problem.task.name: fingerprint(problem.task.spec())},
    }
    write_json(directory / VERSIONS, versions)


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit of the checkout that this file lies in, with "+" when it has been changed."""
    root = Path(__file__).parents[1]
    if not (root / ".git").exists() or shutil.which("git") is None:
        return None
    git = ["git", "-C", str(root)]
    commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True)
    changes = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True)
    if commit.returncode:
        return None
    return commit.stdout.strip() + ("+" if changes.stdout else "")
