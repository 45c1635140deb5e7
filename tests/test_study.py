"""Programs of benchmarks/: what a study does not run again, what it begins again, and what it
keeps; and what a mistake in a call of the others does."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from io import BytesIO
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tsbench.core.errors import NotFiniteError, TsbenchError
from tsbench.core.files import write_json
from tsbench.runs import results
from tsbench.runs.directory import RunDirectory


def outside(name: str) -> Any:
    """A program of benchmarks/ as a module."""
    spec = spec_from_file_location(name, Path(__file__).parents[1] / "benchmarks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look for the types of their fields
    spec.loader.exec_module(module)
    return module


STUDY, RELIABILITY = outside("study"), outside("reliability")
SMALL = (
    "task=rocket_navigation method=twostage budget=smoke task.budgets.smoke.plan=1_024 "
    "task.budgets.smoke.act=1_024 task.training.plan.rollout=32 task.training.imitate.rollout=32"
)
# The obstacles stand between start and goal, and the roadmap has no other point.
NO_WAY = "task=rocket_obstacles method=prm method.samples=0 budget=smoke"
Study = Callable[..., tuple[int, str, str]]


@pytest.fixture(name="study")
def study_fixture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Study:
    """A function that does a study of these lines, and returns its status, output and errors."""
    monkeypatch.chdir(tmp_path)

    def study(*lines: str, options: tuple[str, ...] = ()) -> tuple[int, str, str]:
        Path("study.txt").write_text("\n".join(lines))
        status = STUDY.main(["study.txt", "--out", "kept", "--jobs", "2", *options])
        return (status, *capsys.readouterr())

    return study


def test_a_study_keeps_each_run_and_does_none_twice(study: Study) -> None:
    lines = (f"trials=3 {SMALL} seed=0  # a run", f"{SMALL} seed=0 method.audit=stop")
    status, told, error = study(*lines)
    assert (status, error) == (0, "")
    assert "[2 of 2]" in told
    rows = results.load(Path("kept")).rows.values()
    assert {(row.trials, bool(row.failure)) for row in rows} == {(3, False), (0, True)}
    assert study(*lines) == (0, "", "")
    # A run whose line is lost is collected again. A run of other code, unfinished, begins again.
    (Path("kept") / results.ROWS).unlink()
    run = next(RunDirectory(path.parent) for path in Path("runs").rglob("score.json"))
    run.score_file.unlink()
    versions = run.versions()
    run.versions_file.unlink()
    write_json(run.versions_file, {**versions, "code": "other"})
    status, told, error = study(*lines)
    assert (status, error) == (0, "")
    assert told.count("was there already") == 1
    assert "begins again" in told
    assert run.versions() == versions
    assert len(results.load(Path("kept")).rows) == 2


def test_a_roadmap_without_a_way_is_a_training_that_failed(study: Study) -> None:
    for _ in range(2):  # it is not tried again
        status, told, error = study(f"{NO_WAY} seed=0")
        assert (status, error) == (0, "")
    assert told == ""
    (row,) = results.load(Path("kept")).rows.values()
    assert row.failure.startswith("the roadmap of 0 samples has no way to the goal")
    assert (row.solved_reward, row.normalized_reward, row.success) == (0.0, 0.0, 0.0)


def test_the_table_of_reliability_counts_it_too(capsys: pytest.CaptureFixture[str]) -> None:
    row = RELIABILITY.train(NO_WAY.split(), 0, 0.0)
    assert (row["solved"], row["solved_reward"], row["normalized_reward"]) == (0.0, 0.0, 0.0)
    assert "seed 0, rounding 0: the roadmap of 0 samples has no way" in capsys.readouterr().err


def test_a_number_that_is_not_finite_is_a_training_that_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def train(*_: object) -> None:
        raise NotFiniteError("the reward is not finite", {})

    found = SimpleNamespace(find=lambda _: SimpleNamespace(train=train))
    monkeypatch.setattr(RELIABILITY, "methods", found)
    assert RELIABILITY.train(SMALL.split(), 3, 0.0)["solved"] == 0.0
    assert "seed 3, rounding 0: the reward is not finite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stopping", "status", "told"),
    [
        (True, 128 + signal.SIGTERM, "stopped: "),
        (False, 128 + signal.SIGTERM, "failed: "),
        (True, -signal.SIGKILL, "failed: "),  # as by a lack of memory
    ],
)
def test_a_training_that_is_killed_has_failed(
    stopping: bool,
    status: int,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("study.txt").write_text(f"{NO_WAY} seed=0")
    (job,) = STUDY.read_jobs(Path("study.txt"))
    ended = STUDY.Training(job, SimpleNamespace(returncode=status), BytesIO(), 0.0)
    study = STUDY.Study([job], Path("kept"))
    study._stopping = stopping
    study._finish(ended)
    assert study.failed == (told == "failed: ")
    said = capsys.readouterr().out
    assert told in said
    assert (status > 0) or said.endswith("killed by SIGKILL\n")


def test_a_mistake_in_a_study_is_told_before_anything_runs(study: Study) -> None:
    status, told, error = study(SMALL, "task=rocket_navigation method=twostag")
    assert (status, told) == (2, "")
    assert error.startswith("study: study.txt, line 2: unknown method 'twostag'")
    assert not Path("runs").exists()


def test_no_training_is_left_at_work_where_a_result_cannot_be_kept(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Any] = []

    def start(self: Any, job: Any) -> None:
        own_start(self, job)
        begun.extend(self.running[-1:])

    def collect(*_: object) -> None:
        if len(begun) == 2:
            raise TsbenchError("the disk is full")

    own_start = STUDY.Study._start
    monkeypatch.setattr(STUDY.Study, "_start", start)
    monkeypatch.setattr(results, "of_run", collect)
    status, _, error = study(f"{NO_WAY} seed=0", "task=laikago_trot method=monolithic")
    assert (status, error) == (2, "study: the disk is full\n")
    assert len(begun) == 2
    assert all(training.process.poll() is not None for training in begun)


def test_a_study_names_what_is_left(study: Study) -> None:
    status, told, _ = study(f"{SMALL} 'seed=range(0,2)'", options=("--list",))
    assert status == 0
    assert [line.split("seed=")[1].split()[0] for line in told.splitlines()] == ["0", "1"]


@pytest.mark.parametrize(
    "line",
    [
        "trials=x task=rocket_navigation", "trials=3", "'",
        "task=rocket_navigation directory=one", "task=rocket_navigation threads=2",
    ],
)  # fmt: skip
def test_a_line_that_cannot_be_read_is_named(study: Study, line: str) -> None:
    status, _, error = study("", line)
    assert status == 2
    assert "study.txt, line 2: " in error


def test_a_bundle_replaces_no_other_folder(tmp_path: Path) -> None:
    bundle, folder = outside("bundle"), tmp_path / "mine"
    folder.mkdir()
    bundle.renew(folder)  # an empty one
    bundle.renew(folder)  # one of a bundle that was interrupted
    (folder / "SHA256SUMS").unlink()
    with pytest.raises(FileExistsError, match="mine is no bundle"):
        bundle.renew(folder)
    assert (folder / "install").exists()


def test_each_kept_entry_is_checked_on_a_gpu() -> None:
    pytest.importorskip("mujoco_warp")
    board = Path(__file__).parents[1] / "leaderboards" / "v1"
    kept = outside("gpu_physics").kept(board)
    assert {board / entry / run.name for entry, run in kept.items()} == set(kept.values())
    assert set(kept) == {f"{path.parts[-3]}/{path.parts[-2]}" for path in board.glob("*/*/seed*")}


@pytest.mark.parametrize("name", ["footsteps", "planners"])
def test_a_wrong_task_is_told_in_a_line(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if name == "planners":  # OMPL is not among the packages of the tests
        ompl = SimpleNamespace(PLANNERS=(), Ways=None)
        monkeypatch.setitem(sys.modules, "planner_ompl", ModuleType("planner_ompl"))
        monkeypatch.setitem(sys.modules, "planner_ompl.method", ompl)
    monkeypatch.setattr(sys, "argv", [name, "laikago_fly"])
    with pytest.raises(SystemExit) as ended:
        outside(name).main()
    assert ended.value.code == 2
    assert "error: laikago_fly is no " in capsys.readouterr().err
