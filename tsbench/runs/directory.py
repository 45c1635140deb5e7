"""What lies in a run directory, and how to read it back."""

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
from tsbench.core.motion import ActionLog, Plan, ReferenceMotion
from tsbench.core.policy import Policy
from tsbench.core.task import Task, plannable
from tsbench.core.typed import typed
from tsbench.evaluation.protocol import PROTOCOLS, Protocol
from tsbench.evaluation.score import Score
from tsbench.runs.config import RunConfig

M = TypeVar("M", Plan, ReferenceMotion)

# Names that `workspace` needs relative to the directory; `RunDirectory` has the paths of all files.
METRICS = "metrics.jsonl"
LOG = "log.txt"
EVENTS = "tensorboard"
CHECKPOINTS = "checkpoints"


@dataclass
class Stage:
    """What a stage has used so far.

    Attributes:
        name: as the method calls it.
        budget: environment steps it may use.
        steps: environment steps it has used.
        physics_substeps: steps of the physics under them; none in a kinematic stage.
        warnings: how often mujoco warned meanwhile, by mujoco's names.
        seconds: wall-clock of the work that is in the result. What was lost when a run was
            interrupted, and the time until it was resumed, do not count.
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
        task: its name.
        task_version: of it.
        standard: whether the task has its own constants; another score cannot be ranked.
        method: that made the policy.
        seed: of the training.
        budget: its name.
        score: of the policy.
        stages: what the training took.
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
        """The run in a line."""
        return f"{self.task}, {self.method}, seed {self.seed}, budget {self.budget}"

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "score": self.score.as_dict()}


class _File:
    """An attribute that is the path of a file with a fixed name in a directory."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, directory: RunDirectory, _: type) -> Path:
        return directory.path / self.name


@dataclass(frozen=True)
class RunDirectory:
    """The directory of a run or of a kept entry: where each file lies, and what it says.

    Whatever reads a file raises a TsbenchError that names it where it is missing or damaged.

    Attributes:
        path: of the directory.
    """

    path: Path

    config_file = _File("config.yaml")  # its first line is the command; it says that a run began
    versions_file = _File("versions.json")
    metrics_file = _File(METRICS)
    log_file = _File(LOG)
    events_file = _File(EVENTS)
    checkpoints = _File(CHECKPOINTS)
    dump_file = _File("not-finite.npz")
    plan_file = _File("plan.npz")
    reference_file = _File("reference.npz")
    policy_info_file = _File("policy.json")
    policy_file = _File("policy.safetensors")
    actions_file = _File("actions.npz")
    score_file = _File("score.json")  # written last: it says that a run is finished
    curves_file = _File("learning_curves.png")
    view_file = _File("view.html")
    report_file = _File("report.html")  # the last of the pages that are made of a finished run

    @property
    def begun(self) -> bool:
        """Whether a run has begun here."""
        return self.config_file.is_file()

    @property
    def trained(self) -> bool:
        """Whether a run has anything that would be lost with its directory."""
        return self.metrics_file.exists() and self.metrics_file.stat().st_size > 0

    @property
    def finished(self) -> bool:
        """Whether a run has been trained and scored here."""
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
        """The files that an entry has as well where its method makes them."""
        return self.plan_file, self.reference_file

    def config(self) -> RunConfig:
        """The configuration that the run was made with."""
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
        """What the run was made with."""
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
        """The policy. A directory with nothing but its two files will do."""
        if not self.path.is_dir():
            raise TsbenchError(f"no run directory {self.path}")
        return Policy.load(self.path)

    def task(self, name: str) -> Task[Any]:
        """The task of that name with the constants of the run; without a configuration here, the
        standard one."""
        constants = self.config().task.constants if self.config_file.exists() else {}
        return tasks.make(name, **constants)

    def plan(self, task: Task[Any]) -> Plan | None:
        """The plan for a task, if the run has one.

        Raises:
            TsbenchError: the file is damaged, or the plan does not fit the task.
        """
        return _motion(Plan, self.plan_file, task)

    def reference(self, task: Task[Any]) -> ReferenceMotion | None:
        """The plan as full poses, if the run has one.

        Raises:
            TsbenchError: the file is damaged, or the motion does not fit the task.
        """
        return _motion(ReferenceMotion, self.reference_file, task)

    def actions(self) -> ActionLog | None:
        """The action log, if the run has one."""
        return ActionLog.load(self.actions_file) if self.actions_file.exists() else None


def _motion(kind: type[M], path: Path, task: Task[Any]) -> M | None:
    if not path.exists():
        return None
    motion = kind.load(path)
    plannable(task).check_fit(motion)
    return motion


def check_keep(run: RunDirectory, entry: Path, protocol: Protocol) -> None:
    """
    Raises:
        TsbenchError: `keep` could not work, whatever the score.
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
            raise TsbenchError(f"{run.path} mixes several runs: its files are not of one {what}")
    run.plan(task)
    run.reference(task)
    check_new(entry, parents=True)


def keep(run: RunDirectory, entry: Path, score: Score) -> None:
    """Copies what matters of a run into a new directory, with a score made now.

    Raises:
        TsbenchError: the run is not finished or not of one piece, the score cannot be ranked, or
            the directory exists or cannot be written.
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
    """What `--json` has of a run: its score's figures, whether they can be ranked with those of
    others (`standard`), and what its stages took."""
    values = record.as_dict()
    return {**values["score"], "standard": values["standard"], "stages": values["stages"]}
