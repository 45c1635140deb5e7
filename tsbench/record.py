"""What lies in a run directory, and how to read it back."""

from __future__ import annotations

import json
import math
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tsbench import tasks
from tsbench.config import RunConfig
from tsbench.errors import TsbenchError, os_errors
from tsbench.files import write_whole
from tsbench.mdp import Task
from tsbench.motion import ActionLog
from tsbench.policy import Policy
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


def read_score(directory: Path) -> dict[str, Any]:
    """The content of a finished run's `score.json`.

    Raises:
        TsbenchError: the file is missing or damaged.
    """
    path = directory / SCORE
    with os_errors(path):
        content = path.read_bytes()
    try:
        record = json.loads(content)
        score = record["score"]
        _ = [record[name] for name in ("task", "method", "seed", "budget")]
        needed = [score[name] for name in ("normalized_reward", "optimality", "success")]
        needed += [score["perturbed"][name] for name in ("episodes", "success", "violations")]
        if robustness := score.get("robustness"):
            needed += [robustness[name] for name in ("survival_100N", "impulse_50")]
            needed.append(robustness["impulse_50_is_lower_bound"])
            shape = tuple(
                len(robustness["surface"][name]) for name in ("forces_N", "headings_rad", "phases")
            )
            if np.shape(robustness["surface"]["survived"]) != shape:
                raise ValueError("the surface of pushes does not fit its axes")
        for stage in record["stages"]:
            needed += [stage[name] for name in ("steps", "physics_substeps", "seconds")]
            _ = str(stage["name"])
        for value in needed:
            if not (isinstance(value, (int, float)) and math.isfinite(value)):
                raise ValueError(f"{value!r} where a number should be")
    except KeyError as error:
        raise TsbenchError(f"damaged score {path}: {error} is missing") from None
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise TsbenchError(f"damaged score {path}: {error}") from None
    return dict(record)


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


def read_actions(directory: Path) -> ActionLog | None:
    """The action log of a run, if it has one.

    Raises:
        TsbenchError: the file is damaged.
    """
    path = directory / ACTIONS
    return ActionLog.load(path) if path.exists() else None


def check_keep(run: Path, entry: Path) -> None:
    """
    Raises:
        TsbenchError: `keep` could not work, whatever the score.
    """
    missing = [name for name in KEPT if not (run / name).exists()]
    if missing:
        raise TsbenchError(f"{run} is no finished two-stage run: it lacks {', '.join(missing)}")
    if not tasks.standard(read_policy(run)[1]):
        raise TsbenchError(f"{run} was made with changed constants: it cannot be an entry")
    if entry.exists():
        raise TsbenchError(f"{entry} exists and nothing is overwritten")


def keep(run: Path, entry: Path, score: dict[str, Any], log: ActionLog) -> None:
    """Copies what matters of a run into a new directory, with a score made now.

    Raises:
        TsbenchError: the run is not finished, or the directory exists or cannot be written.
    """
    check_keep(run, entry)
    content = read_score(run) | {"score": score}
    with os_errors(entry):
        entry.mkdir(parents=True)
        for name in KEPT:
            if name != SCORE:
                shutil.copy(run / name, entry / name)
        log.save(entry / ACTIONS)
    write_json(entry / SCORE, content)


def shown(record: dict[str, Any]) -> dict[str, Any]:
    """What `--json` has of a run: its score's figures, and what its stages took."""
    return {**record["score"], "stages": record["stages"]}


def check_new(path: Path) -> None:
    """
    Raises:
        TsbenchError: `write_json` could not write there, whatever the content.
    """
    if path.exists():
        raise TsbenchError(f"{path} exists and nothing is overwritten")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise TsbenchError(f"{path}: {error.strerror}") from None


def write_json(path: Path | None, content: Any) -> None:
    """Writes a JSON file, if one is asked for; nothing is overwritten.

    Raises:
        TsbenchError: the file exists or cannot be written.
    """
    if path is None:
        return
    check_new(path)
    with os_errors(path):
        write_whole(path, (_legible(json.dumps(content, indent=2)) + "\n").encode())


def _legible(text: str) -> str:
    """JSON with every list of plain values on one line."""
    return re.sub(r"\[[^][{}\"]*\]", lambda found: " ".join(found[0].split()), text)
