"""What tests of pictures share: runs that nobody trained, and a marker for those with a browser."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tsbench import tasks
from tsbench.motion import Plan, ReferenceMotion
from tsbench.policy import Policy, PolicyInfo
from tsbench.sim.model import fingerprint

MEANS = {"normalized_reward": 0.01, "success": 0.0, "violations": 0.25, "goal_distance": 3.5}
SCORE = {
    "normalized_reward": 0.01,
    "optimality": 0.125,
    "success": 0.0,
    "nominal": {"episodes": 1, **MEANS, "steps": 180.0},
    "perturbed": {"episodes": 100, **MEANS, "steps": 170.0},
    "seed": 0,
    "robustness": {
        "survival_100N": 0.25,
        "survival_100N_interval": [0.1, 0.5],
        "impulse_50": 7.5,
        "impulse_50_is_lower_bound": False,
        "surface": {
            "forces_N": [50.0, 100.0],
            "headings_rad": [0.0, 1.5707963],
            "phases": [30, 34, 38, 42],
            "survived": [[[1, 1, 1, 1], [1, 1, 1, 1]], [[1, 0, 1, 0], [0, 0, 0, 0]]],
        },
    },
}


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "browser: opens a page in headless Chromium")


def steady(name: str, *action: float) -> Policy:
    """A policy for the task that always does the same."""
    task = tasks.make(name)
    layers = (task.observation_size, 1, task.action_size)
    info = PolicyInfo(name, task.version, fingerprint(task.spec()), "none", "tanh", layers)
    return Policy(
        info,
        mean=np.zeros(layers[0], np.float32),
        scale=np.ones(layers[0], np.float32),
        weights=(np.zeros((1, layers[0]), np.float32), np.zeros((layers[2], 1), np.float32)),
        biases=(
            np.zeros(1, np.float32),
            np.resize(np.array(action or (0.0,), np.float32), layers[2]),
        ),
    )


@pytest.fixture
def make_run(
    tmp_path: Path,
    naive_plan: Callable[[str], Plan],
    naive_reference: Callable[[str], ReferenceMotion],
) -> Callable[..., Path]:
    """Makes the directory of a run of a task, with the hand-made plan and a steady policy."""

    def make(name: str, *action: float, directory: str = "run") -> Path:
        path = tmp_path / directory
        path.mkdir()
        steady(name, *action).save(path)
        naive_plan(name).save(path / "plan.npz")
        naive_reference(name).save(path / "reference.npz")
        record = {"task": name, "method": "twostage", "seed": 0, "budget": "smoke", "score": SCORE}
        stages = [{"name": "plan", "steps": 1000, "physics_substeps": 0, "seconds": 61.0}]
        (path / "score.json").write_text(json.dumps({**record, "stages": stages}))
        rows = [{"stage": "plan", "steps": 100 * i, "episode_return": i} for i in range(5)]
        (path / "metrics.jsonl").write_text("\n".join(map(json.dumps, rows)))
        return path

    return make
