"""The run directory: its files and how to read them, and how a run is kept as an entry."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.files import (
    check_plain,
    parse_json,
    read_file,
    read_json,
)
from tsbench.core.motion import ActionLog, Plan, ReferenceMotion, Roadmap
from tsbench.core.policy import Policy
from tsbench.core.task import Task, plannable
from tsbench.core.typed import typed
from tsbench.core.words import command
from tsbench.evaluation.score import Score
from tsbench.rl.settings import iteration_steps
from tsbench.runs.schema import RunConfig

M = TypeVar("M", Plan, ReferenceMotion)

# Learning curves as an entry keeps them: `metrics.jsonl` with fewer rows and figures.
POINTS = 200  # of a stage
MOST_STAGES = 16  # of a run
LARGEST = 1e15  # figures that can be drawn without an overflow
RETURNS = ("episode_return", "normalized_return")

# Limits of the files, in bytes. The largest of the kept entries are 3, 1 and 49 KB.
MAX_CONFIG = 16 * 2**10
MAX_VERSIONS = 64 * 2**10
MAX_SCORE = 512 * 2**10
MAX_METRICS = 32 * 2**20
MAX_CURVES = 2 * 2**20
MAX_FAILURE = 16 * 2**10
MAX_PROCESSES = 10_000  # that trained together

# File names that `workspace` uses. `RunDirectory` has the paths of all files.
METRICS = "metrics.jsonl"
LOG = "log.txt"
EVENTS = "tensorboard"
CHECKPOINTS = "checkpoints"
LONGEST_NAME = 48  # characters of a run directory's name, without its hash


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


def overspent(stages: Sequence[Stage], config: RunConfig, processes: int = 1) -> str:
    """By how much the stages go beyond the run's budget, in words, or "" if they do not.

    A stage may finish the iteration in which its budget ends, if it does not double its budget by
    that. The largest iteration of the configuration counts, since a method's stages need not bear
    the names of their settings.

    Args:
        stages: what they used.
        config: of the run.
        processes: that trained together, each with the environments of the configuration.
    """
    budget, name = config.task.budgets[config.budget], f"the budget {config.budget}"
    allowed = budget.plan + budget.act
    planned = sum(stage.budget for stage in stages)
    if planned > allowed:
        return f"stages of {planned:,} steps, where {name} has {allowed:,}"
    training = config.task.training
    iteration = processes * max(
        iteration_steps(training, kind, budget.environments) for kind in ("", *training)
    )
    spare = sum(min(iteration, stage.budget) for stage in stages)
    used = sum(stage.steps for stage in stages)
    if used > allowed + spare:
        rest = f"and lets the stages finish iterations of {iteration:,}"
        return f"{used:,} steps used, where {name} has {allowed:,} {rest}"
    return ""


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


def standard_name(seed: int, budget: str, others: Collection[str]) -> str:
    """The name of a run's directory among those of its task and method. Other words of its command
    are part of it: the ends of their keys and their values, as far as there is room, and a hash of
    them all."""
    name, others = f"seed{seed}-{budget}", sorted(others)
    if not others:
        return name
    for word in others:
        key, separator, value = word.partition("=")
        name += re.sub(r"[^\w.=,-]+", "_", f",{key.rpartition('.')[2]}{separator}{value}")
    mark = hashlib.sha256("\n".join(others).encode()).hexdigest()[:8]
    return f"{name[:LONGEST_NAME].rstrip(',=')}-{mark}"


def _there(path: Path) -> bool:
    """Whether there is anything, be it a link to nothing, which its reader refuses."""
    return path.exists() or path.is_symlink()


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
    checkpoints = _File(CHECKPOINTS)
    dump_file = _File("not-finite.npz")
    failure_file = _File("failure.txt")  # the line that a failed plan has ended the run with
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
        return _there(self.score_file)

    @property
    def failure(self) -> str:
        """Why the run can never be finished: its plan has failed. "" if it has not failed."""
        if self.finished or not _there(self.failure_file):
            return ""
        return read_file(self.failure_file, MAX_FAILURE, "failure").decode(errors="replace").strip()

    @property
    def unfinished(self) -> str:
        """Why the run has no score, and how to go on, in words; "" if it has one, or if there is no
        run."""
        if self.finished or not self.begun:
            return ""
        if self.failure:
            return f"the run in {self.path} has failed: {self.failure}"
        return f"the run in {self.path} is not finished: {command('run', f'resume={self.path}')}"

    def config(self) -> RunConfig:
        """The configuration of the run."""
        try:
            config: RunConfig = typed(RunConfig, self.settings(), "")
        except TsbenchError as error:
            if str(self.config_file) in str(error):
                raise
            raise TsbenchError(f"damaged configuration {self.config_file}: {error}") from None
        return config

    def settings(self) -> Any:
        """The plain values of the configuration, which `config` gives their types."""
        path = self.config_file
        content = read_file(path, MAX_CONFIG, "configuration")
        try:
            return _plain_yaml(content)
        except (yaml.YAMLError, ValueError, RecursionError) as error:  # a date such as 2026-99-99
            reason = " ".join(str(error).split())
            raise TsbenchError(f"damaged configuration {path}: {reason}") from None

    @property
    def command(self) -> str:
        """The command that made the run: the first line of its configuration."""
        content = read_file(self.config_file, MAX_CONFIG, "configuration")
        return content.decode(errors="replace").partition("\n")[0].removeprefix("# ")

    def versions(self) -> dict[str, Any]:
        """The content of `versions.json`: versions and hashes of what the run was made with."""
        content = read_json(self.versions_file, MAX_VERSIONS, "versions")
        if not isinstance(content, dict):
            raise TsbenchError(f"damaged versions {self.versions_file}: no key: value pairs")
        return content

    def overspent(self, record: Record) -> str:
        """By how much the training has gone beyond its budget, as far as its files say; see the
        function `overspent`."""
        if not self.begun:
            return ""
        versions = self.versions() if self.versions_file.exists() else {}
        processes = versions.get("processes")  # kept of several alone
        together = processes if type(processes) is int and 1 < processes <= MAX_PROCESSES else 1
        return overspent(record.stages, self.config(), together)

    def record(self) -> Record:
        """The content of a finished run's `score.json`."""
        path = self.score_file
        content = read_json(path, MAX_SCORE, "score")
        try:
            record: Record = typed(Record, content, "")
        except (OverflowError, TsbenchError) as error:
            raise TsbenchError(f"damaged score, or another version's, {path}: {error}") from None
        return record

    def policy(self) -> Policy:
        """The policy. A directory with only the policy's two files suffices."""
        if not self.path.is_dir():
            raise TsbenchError(f"no run directory {self.path}")
        if not self.policy_info_file.exists() and self.unfinished:
            raise TsbenchError(self.unfinished)
        return Policy.load(self.path)

    def task(self, name: str) -> Task[Any]:
        """The task of that name with the run's constants; without a configuration file, with the
        standard constants."""
        constants = self.config().task.constants if _there(self.config_file) else {}
        try:
            return tasks.make(name, **constants)
        except TsbenchError as error:
            if not constants:
                raise
            raise TsbenchError(f"{self.config_file}: {error}") from None

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
        if not _there(self.roadmap_file):
            return None
        roadmap = Roadmap.load(self.roadmap_file)
        try:
            plannable(task).check_origin(roadmap)
        except TsbenchError as error:
            raise TsbenchError(f"{self.roadmap_file}: {error}") from None
        return roadmap

    def actions(self, task: Task[Any]) -> ActionLog | None:
        """The run's action log, or None if it has none.

        Raises:
            TsbenchError: the file is damaged, or the log is another task's.
        """
        if not _there(self.actions_file):
            return None
        log = ActionLog.load(self.actions_file)
        if (log.task, log.task_version) != (task.name, task.version):
            raise TsbenchError(
                f"{self.actions_file} is for {log.task} version {log.task_version}, "
                f"not for {task.name} version {task.version}"
            )
        return log

    @property
    def has_metrics(self) -> bool:
        """Whether the directory holds the metrics of the training."""
        return _there(self.metrics_file)


def read_metrics(path: Path) -> Iterator[dict[str, Any]]:
    """The rows of a run's `metrics.jsonl`, one for each iteration.

    Raises:
        TsbenchError: the file is missing or damaged.
    """
    for line in read_file(path, MAX_METRICS, "metrics").splitlines():
        try:
            row = parse_json(line)
            if not isinstance(row, dict):
                raise ValueError("a row holds no key: value pairs")
        except ValueError as error:
            raise TsbenchError(f"damaged metrics {path}: {error}") from None
        yield row


def curve_points(path: Path) -> Iterator[tuple[str, dict[str, float]]]:
    """The learning curves in a run's `metrics.jsonl`: of each row with a return its stage, and its
    steps, seconds and returns by their names.

    Raises:
        TsbenchError: the file is missing or damaged.
    """
    stages = set()
    for row in read_metrics(path):
        returns = {name: row[name] for name in RETURNS if name in row}
        if not returns:
            continue
        stage = row.get("stage")
        point: dict[str, Any] = {"steps": row.get("steps"), "seconds": row.get("seconds")} | returns
        numbers = all(type(one) in (int, float) and abs(one) < LARGEST for one in point.values())
        if not (isinstance(stage, str) and len(stage) <= 64 and numbers):
            raise TsbenchError(
                f"damaged metrics {path}: a row lacks its stage, steps, seconds or return"
            )
        stages.add(stage)
        if len(stages) > MOST_STAGES:
            raise TsbenchError(f"damaged metrics {path}: more than {MOST_STAGES} stages")
        yield stage, point


def thin_metrics(path: Path) -> bytes:
    """A run's `metrics.jsonl` with the learning curves alone: of each stage at most `POINTS` rows,
    the first and the last among them, with steps, seconds and returns. Thinning it again changes
    nothing. Empty where there are no returns.

    Raises:
        TsbenchError: the file is missing or damaged.
    """
    stages: dict[str, list[dict[str, Any]]] = {}
    for stage, point in curve_points(path):
        stages.setdefault(stage, []).append({"stage": stage, **point})
    lines = (json.dumps(rows[i]) for rows in stages.values() for i in thin(len(rows)))
    return "".join(f"{line}\n" for line in lines).encode()


def thin(count: int) -> np.ndarray:
    """Indices of at most `POINTS` of `count` points, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, POINTS).round().astype(int))


class _PlainLoader(yaml.SafeLoader):
    """Refuses aliases, with which a short file becomes a huge value, as it reads."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it holds an alias")
        return super().compose_node(parent, index)


def _plain_yaml(content: bytes) -> Any:
    """
    Raises:
        ValueError, YAMLError: the content is no YAML, or holds aliases or values that `check_plain`
            refuses.
    """
    values = yaml.load(content, _PlainLoader)
    check_plain(values, finite=False)
    return values


def _motion(kind: type[M], path: Path, task: Task[Any]) -> M | None:
    if not _there(path):
        return None
    motion = kind.load(path)
    try:
        plannable(task).check_fit(motion)
    except TsbenchError as error:
        raise TsbenchError(f"{path}: {error}") from None
    return motion


def shown(record: Record) -> dict[str, Any]:
    """The figures of a run that `--json` writes: the score, whether it can be ranked (`standard`),
    and the stages."""
    values = record.as_dict()
    return {**values["score"], "standard": values["standard"], "stages": values["stages"]}
