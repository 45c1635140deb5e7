"""Scores to hold others against: doing nothing, doing anything, and the best motion known.

The package that brings a task may keep them, in `references/TASK.json`.
`python -m tsbench.evaluation.references TASK ...` makes such files, for all tasks where none is
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
from tsbench.core.errors import unknown
from tsbench.core.task import MDP, Task
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.foreign import ForeignPolicy, from_function
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.protocol import V1
from tsbench.evaluation.score import Score

DECIMALS = 6  # of an observation that the random policy tells apart


def zero(mdp: MDP[Any]) -> ForeignPolicy:
    """Every action is zero: the nominal pose, or no thrust."""
    return from_function(lambda _: np.zeros(mdp.action_size), mdp)


def random(mdp: MDP[Any]) -> ForeignPolicy:
    """Uniform actions. Each is drawn from a generator that its observation seeds, so that the
    policy is a function, and repeats; rounded, since its last bits depend on the processor."""

    def answer(observation: np.ndarray) -> np.ndarray:
        seen = np.round(observation, DECIMALS) + 0.0  # -0.0 is 0.0
        rng = np.random.default_rng(zlib.crc32(seen.tobytes()))
        return rng.uniform(-1.0, 1.0, mdp.action_size)

    return from_function(answer, mdp)


POLICIES: dict[str, Callable[[MDP[Any]], ForeignPolicy]] = {"random": random, "zero": zero}


def named(path: Path, mdp: MDP[Any]) -> ForeignPolicy | None:
    """The reference policy of that name, unless there is a file or directory of that name."""
    make = POLICIES.get(str(path))
    return None if make is None or path.exists() else make(mdp)


def rows(task: Task[Any]) -> dict[str, Any]:
    """The oracle's return and row, and those of the reference policies by protocol v1."""
    best = best_return(task)
    oracle = {
        "normalized_reward": best / (task.max_reward * task.horizon),
        "optimality": 1.0,
        "success": 1.0,
    }
    policies = {name: row(evaluate(make(task), task)) for name, make in sorted(POLICIES.items())}
    return {
        "task_version": task.version,
        "protocol": V1.name,
        "best_return": best,
        "rows": {"oracle": oracle, **policies},
    }


def row(score: Score) -> dict[str, Any]:
    """The figures of a score that a reader compares with."""
    return {
        "normalized_reward": score.normalized_reward,
        "optimality": score.optimality,
        "success": score.success,
        "perturbed_success": score.perturbed.success,
        "survival_100N": score.robustness.survival_100N,
        "impulse_50": score.robustness.impulse_50,
    }


def stored(task: str) -> dict[str, Any] | None:
    """What `rows` gave for a task, from its file; None where there is none.

    Raises:
        TsbenchError: no such task.
    """
    path = _file(task)
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def _file(task: str) -> Path:
    provider = tasks.provider(task)
    if provider is None:
        raise unknown("task", task, tasks.names())
    return Path(str(provider.folder() / "references" / f"{task}.json"))


def main(names: Sequence[str]) -> None:
    """Makes the files of some tasks again."""
    for name in names:
        content = json.dumps(rows(tasks.make(name)), indent=2) + "\n"
        path = _file(name)
        path.parent.mkdir(exist_ok=True)
        path.write_text(content, encoding="utf-8")
        sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    main(sys.argv[1:] or tasks.names())
