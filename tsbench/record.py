"""What lies in a run directory, and how to read it back."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from tsbench import tasks
from tsbench.config import RunConfig
from tsbench.errors import TsbenchError, os_errors
from tsbench.evaluation.protocol import Protocol
from tsbench.evaluation.score import Score
from tsbench.files import check_writable, write_json
from tsbench.motion import ActionLog, Plan, ReferenceMotion
from tsbench.policy import Policy
from tsbench.task import Task, plannable
from tsbench.typed import typed

CONFIG = "config.yaml"
VERSIONS = "versions.json"
METRICS = "metrics.jsonl"
LOG = "log.txt"
EVENTS = "tensorboard/events.out.tfevents.0"
PLAN = "plan.npz"
REFERENCE = "reference.npz"
DUMP = "not-finite.npz"
CHECKPOINTS = "checkpoints"
SCORE = "score.json"
ACTIONS = "actions.npz"
CURVES = "learning_curves.png"
PAGE = "view.html"
REPORT = "report.html"
# What an entry keeps of a run; the first line of its configuration is the command.
KEPT = (CONFIG, VERSIONS, "policy.json", "policy.safetensors", PLAN, REFERENCE, SCORE)


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

    def as_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "score": self.score.as_dict()}


def read_config(directory: Path) -> RunConfig:
    """The configuration that a run was made with.

    Raises:
        TsbenchError: the file is missing, damaged, or no configuration of this tsbench.
    """
    path = directory / CONFIG
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


def read_score(directory: Path) -> Record:
    """The content of a finished run's `score.json`.

    Raises:
        TsbenchError: the file is missing or damaged.
    """
    path = directory / SCORE
    with os_errors(path):
        content = path.read_bytes()
    try:
        values = json.loads(content)
        json.dumps(values, allow_nan=False)  # raises where a number is not finite
        record: Record = typed(Record, values, "")
    except (ValueError, OverflowError, RecursionError, TsbenchError) as error:
        raise TsbenchError(f"damaged score, or another version's, {path}: {error}") from None
    return record


def read_policy(directory: Path) -> tuple[Policy, Task[Any]]:
    """A run's policy and the task that it solves, with the constants that it was trained for.

    A directory with nothing but the policy's two files will do; the task is then the standard one.

    Raises:
        TsbenchError: there is no such directory, or a file in it is damaged.
    """
    if not directory.is_dir():
        raise TsbenchError(f"no run directory {directory}")
    policy = Policy.load(directory)
    constants = {}
    if (directory / CONFIG).exists():
        constants = read_config(directory).task.constants
    return policy, tasks.make(policy.info.task, **constants)


def read_versions(directory: Path) -> dict[str, Any]:
    """What a run was made with, as `versions.json` has it.

    Raises:
        TsbenchError: the file is missing or damaged.
    """
    path = directory / VERSIONS
    with os_errors(path):
        content = path.read_bytes()
    try:
        return dict(json.loads(content))
    except (ValueError, TypeError, RecursionError) as error:
        raise TsbenchError(f"damaged versions {path}: {error}") from None


def read_actions(directory: Path) -> ActionLog | None:
    """The action log of a run, if it has one.

    Raises:
        TsbenchError: the file is damaged.
    """
    path = directory / ACTIONS
    return ActionLog.load(path) if path.exists() else None


def check_keep(run: Path, entry: Path, protocol: Protocol) -> None:
    """
    Raises:
        TsbenchError: `keep` could not work, whatever the score.
    """
    if not protocol.ranked:
        raise TsbenchError(f"a score by protocol {protocol.name} cannot be an entry")
    missing = [name for name in KEPT if not (run / name).exists()]
    if missing:
        raise TsbenchError(f"{run} is no finished two-stage run: it lacks {', '.join(missing)}")
    policy, task = read_policy(run)
    record = read_score(run)
    if not (tasks.standard(task) and record.standard):
        raise TsbenchError(f"{run} was made with changed constants: it cannot be an entry")
    read_versions(run)
    for what, here, there in (
        ("task", policy.info.task, record.task),
        ("task", policy.info.task, read_config(run).task.name),
        ("method", policy.info.method, record.method),
        ("policy", policy.info.sha256, record.score.origin.policy),
    ):
        if here != there:
            raise TsbenchError(f"{run} mixes several runs: its files are not of one {what}")
    for motion in (Plan.load(run / PLAN), ReferenceMotion.load(run / REFERENCE)):
        plannable(task).check_fit(motion)
    if entry.exists():
        raise TsbenchError(f"{entry} exists and nothing is overwritten")
    check_writable(entry, next(one for one in entry.absolute().parents if one.exists()))


def keep(run: Path, entry: Path, score: Score) -> None:
    """Copies what matters of a run into a new directory, with a score made now.

    Raises:
        TsbenchError: the run is not finished or not of one piece, the score cannot be ranked, or
            the directory exists or cannot be written.
    """
    check_keep(run, entry, score.origin.protocol)
    assert score.log is not None
    content = replace(read_score(run), score=score).as_dict()
    with os_errors(entry):
        entry.mkdir(parents=True)
        for name in KEPT:
            if name != SCORE:
                shutil.copy(run / name, entry / name)
        score.log.save(entry / ACTIONS)
    write_json(entry / SCORE, content)


def shown(record: Record) -> dict[str, Any]:
    """What `--json` has of a run: its score's figures, whether they can be ranked with those of
    others (`standard`), and what its stages took."""
    values = record.as_dict()
    return {**values["score"], "standard": values["standard"], "stages": values["stages"]}
