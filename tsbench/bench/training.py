"""The shares of a training's time: physics, MDP math, network inference, update, records.

The planning and the imitation stage run as in `tsbench run budget=fast`, with records in files, but
for fewer iterations. The imitation follows the plan of the hand-made planner. Each robot's first
task with a planning variant is trained.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console

from tsbench.bench import Findings, comparison
from tsbench.bench.domains import domains, planned
from tsbench.bench.turns import Effort, Range
from tsbench.core.method import Problem
from tsbench.core.task import plannable
from tsbench.rl.stages import learn_physics, learn_planning, settings
from tsbench.runs.config import compose
from tsbench.runs.directory import METRICS
from tsbench.runs.execute import prepare
from tsbench.runs.workspace import RunWorkspace
from tsbench.sim.kinematic import naive_plan
from tsbench.sim.tracking import Imitation


@comparison("training")
def compare(effort: Effort) -> Findings:
    findings = Findings()
    for group in domains().values():
        if (task := planned(group)) is None:
            continue
        problem = prepare(compose([f"task={task.name}"]))
        for stage in ("plan", "imitate"):
            chosen = settings(problem, stage)
            steps = chosen.steps
            rows = train(problem, stage, steps * (effort.iterations + 1))
            findings.add(split(f"{task.name}.{stage}", rows, steps))
    return findings


def train(problem: Problem, stage: str, steps: int) -> list[dict[str, float]]:
    """Trains a stage; returns the record of each iteration."""
    with tempfile.TemporaryDirectory() as folder:
        workspace = RunWorkspace(Path(folder), Console(quiet=True))
        if stage == "plan":
            learn_planning(problem, workspace, steps)
        else:
            task = plannable(problem.task)
            imitation = Imitation(task, task.reference(naive_plan(task)))
            learn_physics(problem, workspace, stage, imitation, stage, steps)
        workspace.close()
        lines = (Path(folder) / METRICS).read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def split(name: str, rows: list[dict[str, float]], steps: int) -> Findings:
    """The shares of an iteration's time.

    Args:
        name: prefix of the figures' names.
        rows: the record of each iteration, with its end time. The first iteration is left out,
            because it allocates memory.
        steps: environment steps of an iteration.
    """
    whole = np.diff([row["seconds"] for row in rows])
    collect, update, environment, physics = (
        np.array([row[f"{part}_seconds"] for row in rows[1:]])
        for part in ("collect", "update", "environment", "physics")
    )
    parts = {
        "physics": physics,
        "mdp": environment - physics,
        "inference": collect - environment,
        "update": update,
        "records": whole - collect - update,
    }
    return Findings(
        figures={f"{name}": Range.of(steps / whole, "steps/s")},
        ratios={f"{name}.{part}/whole": Range.of(taken / whole) for part, taken in parts.items()},
    )
