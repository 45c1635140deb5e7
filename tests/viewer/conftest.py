"""Fixtures of the viewer's tests: runs made without training, and a marker for browser tests."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tsbench import tasks
from tsbench.core.files import write_json
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.policy import Policy, PolicyInfo
from tsbench.runs.directory import Record
from tsbench.sim.model import fingerprint


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "browser: opens a page in headless Chromium")


def steady(name: str, *action: float) -> Policy:
    """A policy for the task with a constant action."""
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
    invented_record: Callable[[str], Record],
) -> Callable[..., Path]:
    """A function that makes a run directory with the hand-made plan and a constant policy."""

    def make(name: str, *action: float, directory: str = "run") -> Path:
        path = tmp_path / directory
        path.mkdir()
        steady(name, *action).save(path)
        naive_plan(name).save(path / "plan.npz")
        naive_reference(name).save(path / "reference.npz")
        write_json(path / "score.json", invented_record(name).as_dict())
        rows = [{"stage": "plan", "steps": 100 * i, "episode_return": i} for i in range(5)]
        (path / "metrics.jsonl").write_text("\n".join(map(json.dumps, rows)))
        return path

    return make
