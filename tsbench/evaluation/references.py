"""Reference rows, with which a score is compared: the policies `zero` and `random`, and the best
motion known.

The package that brings a task may keep its rows in `references/TASK.json`.
`python -m tsbench.evaluation.references TASK ...` makes these files, for all tasks if no task is
named.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tsbench import tasks
from tsbench.core.errors import TsbenchError, unknown
from tsbench.core.task import MDP, Task
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.foreign import ForeignPolicy, from_function
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.origin import constants_hash
from tsbench.evaluation.protocol import V1
from tsbench.evaluation.score import Score

ROBUSTNESS = ("survival_100N", "recovery_100N", "survival_impulse_50", "recovery_impulse_50")
DECIMALS = 6  # to which the random policy rounds an observation


def zero(mdp: MDP[Any]) -> ForeignPolicy:
    """Every action is zero: the nominal pose, or no thrust."""
    return from_function(lambda _: np.zeros(mdp.action_size), mdp)


def random(mdp: MDP[Any]) -> ForeignPolicy:
    """Uniform actions. The observation seeds the generator of the action, so that the policy is a
    function. The observation is rounded, because its last bits depend on the processor."""

    def answer(observation: np.ndarray) -> np.ndarray:
        seen = np.round(observation, DECIMALS) + 0.0  # turns -0.0 into 0.0
        rng = np.random.default_rng(zlib.crc32(seen.tobytes()))
        return rng.uniform(-1.0, 1.0, mdp.action_size)

    return from_function(answer, mdp)


POLICIES: dict[str, Callable[[MDP[Any]], ForeignPolicy]] = {"random": random, "zero": zero}


def named(path: Path, mdp: MDP[Any]) -> ForeignPolicy | None:
    """The reference policy of that name; None if no such policy exists, or if a file or directory
    has the name."""
    make = POLICIES.get(str(path))
    return None if make is None or path.exists() else make(mdp)


def rows(task: Task[Any]) -> dict[str, Any]:
    """The content of a task's file: the return and row of the best motion known, and the rows of
    the reference policies by protocol v1."""
    best = best_return(task)
    most = best / (task.max_reward * task.horizon)
    oracle = {
        "solved_reward": most,
        "normalized_reward": most,
        "success": 1.0,
        "against_plan": 1.0,
    }
    policies = {name: row(evaluate(make(task), task)) for name, make in sorted(POLICIES.items())}
    return {
        "task_version": task.version,
        "protocol": V1.name,
        "constants": constants_hash(task),
        "best_return": best,
        "rows": {"oracle": oracle, **policies},
    }


def row(score: Score) -> dict[str, Any]:
    """The figures of a score that a row shows."""
    return {
        **{
            name: getattr(score, name)
            for name in ("solved_reward", "normalized_reward", "success", "against_plan")
        },
        **{name: getattr(score.robustness, name) for name in ROBUSTNESS},
    }


def stored(task: str) -> dict[str, Any] | None:
    """The stored `rows` of a task; None for a task without a file.

    Raises:
        TsbenchError: the task does not exist.
    """
    path = _file(task)
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def _file(task: str) -> Path:
    provider = tasks.provider(task)
    if provider is None:
        raise unknown("task", task, tasks.names())
    return Path(str(provider.folder() / "references" / f"{task}.json"))


def main(names: Sequence[str]) -> None:
    """Makes the files of these tasks again."""
    for name in names:
        content = json.dumps(rows(tasks.make(name)), indent=2) + "\n"
        path = _file(name)
        path.parent.mkdir(exist_ok=True)
        path.write_text(content, encoding="utf-8")
        sys.stdout.write(f"{path}\n")


def beside(score: Score) -> dict[str, dict[str, Any]]:
    """The stored rows of the reference policies, by name, for the task and protocol of a score.

    Empty for a task without stored rows, and for a score by another protocol or with other
    constants of the task.
    """
    return {
        name: row
        for name, row in comparable(score).items()
        if name in POLICIES and score.protocol == V1.name
    }


def comparable(score: Score) -> dict[str, dict[str, Any]]:
    """The stored rows, by protocol v1, that a score by any protocol may be seen beside: those of
    its task with its constants. Empty for a task without stored rows."""
    content = (stored(score.origin.task) if score.origin.task in tasks.names() else None) or {}
    same = content.get("constants") == score.origin.constants
    rows: dict[str, dict[str, Any]] = content["rows"] if same else {}
    return rows


if __name__ == "__main__":
    try:
        main(sys.argv[1:] or tasks.names())
    except TsbenchError as error:
        sys.stderr.write(f"tsbench: {error}\n")
        sys.exit(2)
