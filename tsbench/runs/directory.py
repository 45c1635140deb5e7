"""The run directory: its files and how to read them, and how a run is kept as an entry."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml

from tsbench import tasks
from tsbench.core.errors import TsbenchError, os_errors
from tsbench.core.files import check_new, write_json
from tsbench.core.motion import ActionLog, Plan, ReferenceMotion, Roadmap
from tsbench.core.policy import Policy
from tsbench.core.task import Task, plannable
from tsbench.core.typed import typed
from tsbench.evaluation.protocol import PROTOCOLS, Protocol
from tsbench.evaluation.score import Score
from tsbench.runs.config import RunConfig

M = TypeVar("M", Plan, ReferenceMotion)

# File names that `workspace` uses. `RunDirectory` has the paths of all files.
METRICS = "metrics.jsonl"
LOG = "log.txt"
EVENTS = "tensorboard"
CHECKPOINTS = "checkpoints"


@dataclass
class Stage:
    """What a stage has used so far.

    Attributes:
        name: the method's name for the stage.
        budget: environment steps that the stage may use.
        steps: environment steps that the stage has used.
        physics_substeps: physics steps within those; 0 in a kinematic stage.
        warnings: number of MuJoCo's warnings during the stage, by MuJoCo's names.
        seconds: wall-clock time of the work that is in the result. Work lost by an interruption
            and the time until the run was resumed do not count.
        interruptions: how often the stage was resumed.
    """

    name: str
    budget: int
    steps: int = 0
    physics_substeps: int = 0
    warnings: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    interruptions: int = 0


@dataclass(frozen=True)
class Record:
    """The content of `score.json`.

    Attributes:
        task: name of the task.
        task_version: version of the task.
        standard: whether the task had its standard constants; otherwise the score cannot be ranked.
        method: name of the method that made the policy.
        seed: seed of the training.
        budget: name of the budget.
        score: score of the policy.
        stages: steps and seconds of each stage of the training.
    """

    task: str
    task_version: int
    standard: bool
    method: str
    seed: int
    budget: str
    score: Score
    stages: tuple[Stage, ...]

    @property
    def title(self) -> str:
        """One line that names the run."""
        return f"{self.task}, {self.method}, seed {self.seed}, budget {self.budget}"

    def as_dict(self) -> dict[str, Any]:
        """The record as JSON holds it."""
        return {**asdict(self), "score": self.score.as_dict()}


class _File:
    """An attribute of a `RunDirectory`: the path of a file with a fixed name."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, directory: RunDirectory, _: type) -> Path:
        return directory.path / self.name


@dataclass(frozen=True)
class RunDirectory:
    """The directory of a run or of a kept entry: the paths of its files, and their content.

    Every method that reads a file raises a TsbenchError that names a missing or damaged file.

    Attributes:
        path: the directory.
    """

    path: Path

    config_file = _File("config.yaml")  # begins with the command; its presence says: run begun
    versions_file = _File("versions.json")
    metrics_file = _File(METRICS)
    log_file = _File(LOG)
    events_file = _File(EVENTS)
    checkpoints = _File(CHECKPOINTS)
    dump_file = _File("not-finite.npz")
    plan_file = _File("plan.npz")
    reference_file = _File("reference.npz")
    roadmap_file = _File("roadmap.npz")
    policy_info_file = _File("policy.json")
    policy_file = _File("policy.safetensors")
    actions_file = _File("actions.npz")
    score_file = _File("score.json")  # written last; its presence says: run finished
    curves_file = _File("learning_curves.png")
    view_file = _File("view.html")
    report_file = _File("report.html")  # the last page that is made of a finished run

    @property
    def begun(self) -> bool:
        """Whether a run has begun in this directory."""
        return self.config_file.is_file()

    @property
    def trained(self) -> bool:
        """Whether the directory holds training progress or a plan, which must not be removed."""
        metrics = self.metrics_file
        return (metrics.exists() and metrics.stat().st_size > 0) or self.plan_file.exists()

    @property
    def finished(self) -> bool:
        """Whether a run in this directory has been trained and scored."""
        return self.score_file.exists()

    @property
    def essential(self) -> tuple[Path, ...]:
        """The files without which a run cannot become an entry."""
        return (
            self.config_file, self.versions_file, self.policy_info_file, self.policy_file,
            self.score_file,
        )  # fmt: skip

    @property
    def optional(self) -> tuple[Path, ...]:
        """The files that an entry has if its method makes them."""
        return self.plan_file, self.reference_file, self.roadmap_file

    def config(self) -> RunConfig:
        """The configuration of the run."""
        path = self.config_file
        try:
            with os_errors(path):
                content = yaml.safe_load(path.read_text(encoding="utf-8"))
            config: RunConfig = typed(RunConfig, content, "")
        except (yaml.YAMLError, ValueError, RecursionError) as error:  # a date such as 2026-99-99
            reason = " ".join(str(error).split())
            raise TsbenchError(f"damaged configuration {path}: {reason}") from None
        except TsbenchError as error:
            raise TsbenchError(f"damaged configuration {path}: {error}") from None
        return config

    def versions(self) -> dict[str, Any]:
        """The content of `versions.json`: versions and hashes of what the run was made with."""
        path = self.versions_file
        with os_errors(path):
            content = path.read_bytes()
        try:
            return dict(json.loads(content))
        except (ValueError, TypeError, RecursionError) as error:
            raise TsbenchError(f"damaged versions {path}: {error}") from None

    def record(self) -> Record:
        """The content of a finished run's `score.json`."""
        path = self.score_file
        with os_errors(path):
            content = path.read_bytes()
        try:
            values = json.loads(content)
            json.dumps(values, allow_nan=False)  # raises where a number is not finite
            record: Record = typed(Record, values, "")
        except (ValueError, OverflowError, RecursionError, TsbenchError) as error:
            raise TsbenchError(f"damaged score, or another version's, {path}: {error}") from None
        return record

    def policy(self) -> Policy:
        """The policy. A directory with only the policy's two files suffices."""
        if not self.path.is_dir():
            raise TsbenchError(f"no run directory {self.path}")
        return Policy.load(self.path)

    def task(self, name: str) -> Task[Any]:
        """The task of that name with the run's constants; without a configuration file, with the
        standard constants."""
        constants = self.config().task.constants if self.config_file.exists() else {}
        return tasks.make(name, **constants)

    def plan(self, task: Task[Any]) -> Plan | None:
        """The run's plan, or None if it has none.

        Raises:
            TsbenchError: the file is damaged, or the plan does not fit the task.
        """
        return _motion(Plan, self.plan_file, task)

    def reference(self, task: Task[Any]) -> ReferenceMotion | None:
        """The run's reference motion (the plan as full poses), or None if it has none.

        Raises:
            TsbenchError: the file is damaged, or the motion does not fit the task.
        """
        return _motion(ReferenceMotion, self.reference_file, task)

    def roadmap(self, task: Task[Any]) -> Roadmap | None:
        """The roadmap that the run planned with, or None if it used none.

        Raises:
            TsbenchError: the file is damaged, or the roadmap is another task's.
        """
        if not self.roadmap_file.exists():
            return None
        roadmap = Roadmap.load(self.roadmap_file)
        plannable(task).check_origin(roadmap)
        return roadmap

    def actions(self) -> ActionLog | None:
        """The run's action log, or None if it has none."""
        return ActionLog.load(self.actions_file) if self.actions_file.exists() else None


def _motion(kind: type[M], path: Path, task: Task[Any]) -> M | None:
    if not path.exists():
        return None
    motion = kind.load(path)
    plannable(task).check_fit(motion)
    return motion


def check_keep(run: RunDirectory, entry: Path, protocol: Protocol) -> None:
    """Checks before an evaluation that `keep` can make an entry of the run.

    Raises:
        TsbenchError: the protocol cannot be ranked; the run is not finished, mixes files of several
            runs, has changed constants or a damaged file; or the entry exists.
    """
    if not protocol.ranked:
        raise TsbenchError(f"a score by protocol {protocol.name} cannot be an entry")
    if PROTOCOLS.get(protocol.name) != protocol:
        raise TsbenchError(
            f"a score with another seed or other numbers than protocol {protocol.name} has "
            "cannot be an entry"
        )
    missing = [path.name for path in run.essential if not path.exists()]
    if missing:
        raise TsbenchError(f"{run.path} is no finished run: it lacks {', '.join(missing)}")
    policy, config, record = run.policy().info, run.config(), run.record()
    task = run.task(policy.task)
    if not (tasks.standard(task) and record.standard):
        raise TsbenchError(f"{run.path} was made with changed constants: it cannot be an entry")
    run.versions()
    for what, said in (
        ("task", (policy.task, record.task, config.task.name)),
        ("version of the task", (policy.task_version, record.task_version)),
        ("method", (policy.method, record.method, config.method["name"])),
        ("seed", (record.seed, config.seed)),
        ("budget", (record.budget, config.budget)),
        ("policy", (policy.sha256, record.score.origin.policy)),
    ):
        if len(set(said)) > 1:
            raise TsbenchError(f"{run.path} mixes several runs: its files disagree on the {what}")
    run.plan(task)
    run.reference(task)
    run.roadmap(task)
    check_new(entry, parents=True)


def keep(run: RunDirectory, entry: Path, score: Score) -> None:
    """Copies the files of an entry from a run into a new directory, with a new score.

    Args:
        run: a finished run.
        entry: the new directory.
        score: the score of the run's policy, with its action log.

    Raises:
        TsbenchError: as `check_keep`, or the directory cannot be written.
    """
    check_keep(run, entry, score.origin.protocol)
    assert score.log is not None
    content = replace(run.record(), score=score).as_dict()
    kept = RunDirectory(entry)
    with os_errors(entry):
        entry.mkdir(parents=True)
        for path in (*run.essential, *run.optional):
            if path.exists() and path != run.score_file:
                shutil.copy(path, entry / path.name)
        score.log.save(kept.actions_file)
    write_json(kept.score_file, content)


def shown(record: Record) -> dict[str, Any]:
    """The figures of a run that `--json` writes: the score, whether it can be ranked (`standard`),
    and the stages."""
    values = record.as_dict()
    return {**values["score"], "standard": values["standard"], "stages": values["stages"]}
