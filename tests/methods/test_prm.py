"""The method prm: what it plans with, what it refuses, what it leaves behind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsbench import TsbenchError, methods, tasks
from tsbench.core.method import Budget, Problem
from tsbench.core.motion import Plan, ReferenceMotion, Roadmap
from tsbench.core.task import plannable
from tsbench.leaderboard import submission
from tsbench.methods import prm
from tsbench.runs.directory import RunDirectory
from tsbench.sim.kinematic import naive_plan
from tsbench.tasks.rocket import RocketAbstraction
from tsbench.testing.contracts import Desk

TRAINING = {"imitate": {"rollout": 8, "epochs": 1, "minibatches": 2, "hidden": [16]}}


def problem(task_name: str, **options: Any) -> Problem:
    task = tasks.make(task_name)
    return Problem(task, Budget(192, 64, 8), TRAINING, options, seed=0, threads=1)


def test_a_roadmap_is_planned_with_and_kept(tmp_path: Path) -> None:
    """No stage of planning steps: the roadmap takes none, and says what it took instead."""
    desk = Desk(tmp_path)
    policy = methods.find("prm").train(problem("rocket_obstacles", samples=300), desk)
    assert policy.info.method == "prm"
    assert desk.stages == [("imitate", 64)]
    assert desk.notes[0].startswith("roadmap: 300 samples, ")
    assert desk.notes[1] == "plan audit: passed"
    roadmap = Roadmap.load(tmp_path / "roadmap.npz")
    assert 290 < len(roadmap.nodes) < 302  # samples in obstacles are dropped
    plan = Plan.load(tmp_path / "plan.npz")
    np.testing.assert_allclose(roadmap.path[-1, [0, 2]], plan.states[-1, :2])
    ReferenceMotion.load(tmp_path / "reference.npz")


def test_a_run_has_its_roadmap(tmp_path: Path) -> None:
    """It is one of the files that an entry keeps, and is checked like its plan."""
    run, given = RunDirectory(tmp_path), problem("rocket_obstacles", samples=300)
    assert run.roadmap(given.task) is None
    prm.train(given, Desk(tmp_path))
    assert run.roadmap_file.name in submission.OPTIONAL
    assert run.roadmap(given.task) is not None
    with pytest.raises(TsbenchError, match="the roadmap is for rocket_obstacles version 1, not"):
        run.roadmap(tasks.make("rocket_navigation"))
    run.roadmap_file.write_bytes(run.plan_file.read_bytes())
    with pytest.raises(TsbenchError, match="is not a roadmap file"):
        run.roadmap(given.task)
    run.roadmap_file.write_bytes(b"nonsense")
    with pytest.raises(TsbenchError, match="damaged roadmap file"):
        run.roadmap(given.task)


def test_options_change_the_plan(tmp_path: Path) -> None:
    plans = []
    for options in ({}, {"samples": 500}, {"shortcut": True}, {"neighbours": 5}):
        prm.train(problem("rocket_obstacles", **options), Desk(tmp_path))
        plans.append(Plan.load(tmp_path / "plan.npz").states.tobytes())
    assert len(set(plans)) == 4


def test_a_layered_roadmap_beats_the_hand_made_planner(tmp_path: Path) -> None:
    """It is as fast, no foot slips, and what it earns on the way is more."""
    given = problem("laikago_trot", roadmap="layered")
    prm.train(given, Desk(tmp_path))
    plan, naive = Plan.load(tmp_path / "plan.npz"), naive_plan(given.task)
    assert len(plan.rewards) <= len(naive.rewards)
    assert plan.rewards.sum() > 1.1 * naive.rewards.sum()
    task = plannable(given.task)
    assert task.audit(plan, task.reference(plan)).passed
    assert not (tmp_path / "roadmap.npz").exists()


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("rocket_navigation", {"roadmap": "dense"}, "method.roadmap must be one of blind, layered"),
        ("rocket_navigation", {"roadmap": "layered"}, "rocket_navigation has no gait"),
        ("rocket_navigation", {"samples": -1}, "method.samples must lie in"),
        ("rocket_navigation", {"neighbours": 0}, "method.neighbours must lie in"),
        ("rocket_navigation", {"samples": 21_000}, "method.samples must lie in 0 to 19,998, not"),
        ("rocket_navigation", {"samples": 19_000, "neighbours": 100}, "lie in 1 to 52 with 19,000"),
        ("rocket_obstacles", {"samples": 0, "neighbours": 1}, "has no way to the goal"),
    ],
)
def test_what_it_refuses(task: str, options: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(TsbenchError, match=message):
        prm.train(problem(task, **options), Desk(tmp_path))
    assert not list(tmp_path.iterdir())


def test_a_task_without_a_roadmap_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RocketAbstraction, "roadmap_space", lambda _: None)
    message = "^the method prm cannot do rocket_navigation: it has no roadmap space$"
    with pytest.raises(TsbenchError, match=message):
        prm.train(problem("rocket_navigation"), Desk(tmp_path))
