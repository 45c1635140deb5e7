"""Two processes that learn together on the CPU, as torchrun starts them."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.method import Budget, Problem
from tsbench.rl import processes
from tsbench.rl.stages import physics_environment, settings
from tsbench.runs.execute import resume

# Trains the planner and prints what should be equal in both processes, and what should not.
PROGRAM = """
import hashlib, json, torch
from tsbench import tasks
from tsbench.core.method import Budget, Problem
from tsbench.rl import processes
from tsbench.rl.ppo import Learner
from tsbench.rl.stages import planning_environment, settings
from tsbench.sim.kinematic import Planning

training = {"plan": {"environments": 8, "rollout": 8, "minibatches": 2, "hidden": [16]}}
task = tasks.make("rocket_navigation")
problem = Problem(task, Budget(1, 1), training, {}, seed=4, threads=1)
with processes.together(torch.device("cpu")):
    chosen = settings(problem, "plan")
    environment = planning_environment(problem, Planning(task, explore=0.5), 8)
    learner = Learner(environment, chosen, problem.seed)
    learner.learn(4 * chosen.steps)

def hashed(arrays):
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays.values())).hexdigest()

snapshot = learner.snapshot()
print(json.dumps({
    "weights": [hashed(snapshot[name]) for name in ("actor", "critic")],
    "observation": hashed(snapshot["environment"]["observation"]),
    "rate": snapshot["update"]["learning_rate"],
    "steps": learner.steps,
    "collected": chosen.steps,
}))
"""


def both(arguments: list[str], folder: Path) -> list[subprocess.CompletedProcess[str]]:
    """Starts two processes with the same arguments for python, and waits for them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    started: list[subprocess.Popen[str]] = []
    with ExitStack() as ends:
        for rank in range(2):
            places = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": 2, "MASTER_PORT": port}
            environment = {**os.environ, "MASTER_ADDR": "127.0.0.1"}
            environment |= {name: str(value) for name, value in places.items()}
            process = subprocess.Popen(
                [sys.executable, *arguments], cwd=folder, env=environment, text=True,
                stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            )  # fmt: skip
            started.append(ends.enter_context(process))
            ends.callback(process.kill)  # before its context waits for it
        outputs = [process.communicate(timeout=600) for process in started]
    return [
        subprocess.CompletedProcess(arguments, process.returncode, *output)
        for process, output in zip(started, outputs, strict=True)
    ]


def test_two_processes_have_the_same_weights_and_other_episodes(tmp_path: Path) -> None:
    ends = both(["-c", PROGRAM], tmp_path)
    assert [end.returncode for end in ends] == [0, 0], [end.stderr for end in ends]
    first, second = (json.loads(end.stdout.splitlines()[-1]) for end in ends)
    assert first["weights"] == second["weights"]
    assert first["rate"] == second["rate"]
    assert first["observation"] != second["observation"]
    # Four iterations' worth of steps, which two processes take in two.
    assert first["steps"] == second["steps"] == 4 * first["collected"]


def test_only_the_first_process_writes_a_run(tmp_path: Path) -> None:
    small = "environments: 4, rollout: 8, minibatches: 2, hidden: [8]"
    words = [
        "task=rocket_navigation", "budget=smoke", "threads=1", "directory=run",
        "task.budgets.smoke.plan=128", "task.budgets.smoke.act=128",
        f"task.training.plan={{{small}}}", f"task.training.imitate={{{small}, repeat: 1}}",
    ]  # fmt: skip
    ends = both(["-m", "tsbench", "run", *words], tmp_path)
    assert [end.returncode for end in ends] == [0, 0], [end.stderr for end in ends]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert ends[1].stdout == ""
    assert json.loads((tmp_path / "run" / "versions.json").read_text())["processes"] == 2
    stages = json.loads((tmp_path / "run" / "score.json").read_text())["stages"]
    assert [stage["steps"] for stage in stages] == [128, 128]


def test_the_rise_counts_the_steps_of_all_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "4")
    disturb = {"push": 100.0, "rise": 1000, "latency": 2}
    training = {"imitate": {"environments": 2, "disturb": disturb}}
    task = tasks.make("rocket_navigation")
    problem = Problem(task, Budget(1, 1), training, {}, seed=0, threads=1)
    chosen = settings(problem, "imitate")
    physics: Any = physics_environment(problem, task, chosen).dynamics
    assert chosen.disturb.rise == 1000
    assert physics.disturbances == replace(chosen.disturb, rise=250)


def test_what_several_processes_cannot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert (processes.count(), processes.rank(), processes.own(7)) == (1, 0, 7)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    assert processes.own(2**32 - 1) == 0
    with pytest.raises(TsbenchError, match="cannot be resumed"):
        resume(tmp_path)
