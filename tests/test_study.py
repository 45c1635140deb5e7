"""The study of benchmarks/: what it does not run again, what it begins again, and what it keeps."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tsbench.core.files import write_json
from tsbench.runs import results
from tsbench.runs.directory import RunDirectory

STUDY = Path(__file__).parents[1] / "benchmarks" / "study.py"
SMALL = (
    "task=rocket_navigation method=twostage budget=smoke task.budgets.smoke.plan=1_024 "
    "task.budgets.smoke.act=1_024 task.training.plan.rollout=32 task.training.imitate.rollout=32"
)


def study(folder: Path, *lines: str, options: tuple[str, ...] = ()) -> tuple[int, str, str]:
    (folder / "study.txt").write_text("\n".join(lines))
    command = [sys.executable, str(STUDY), "study.txt", "--out", "kept", "--jobs", "2", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def test_a_study_keeps_each_run_and_does_none_twice(tmp_path: Path) -> None:
    lines = (f"trials=3 {SMALL} seed=0  # a run", f"{SMALL} seed=0 method.audit=stop")
    status, told, error = study(tmp_path, *lines)
    assert (status, error) == (0, "")
    assert "[2 of 2]" in told
    rows = results.load(tmp_path / "kept").rows.values()
    assert {(row.trials, bool(row.failure)) for row in rows} == {(3, False), (0, True)}
    assert study(tmp_path, *lines) == (0, "", "")
    # A run whose line is lost is collected again. A run of other code, unfinished, begins again.
    (tmp_path / "kept" / results.ROWS).unlink()
    run = next(RunDirectory(path.parent) for path in tmp_path.rglob("runs/**/score.json"))
    run.score_file.unlink()
    versions = run.versions()
    run.versions_file.unlink()
    write_json(run.versions_file, {**versions, "code": "other"})
    status, told, error = study(tmp_path, *lines)
    assert (status, error) == (0, "")
    assert told.count("was there already") == 1
    assert "begins again" in told
    assert run.versions() == versions
    assert len(results.load(tmp_path / "kept").rows) == 2


def test_a_mistake_in_a_study_is_told_before_anything_runs(tmp_path: Path) -> None:
    status, told, error = study(tmp_path, SMALL, "task=rocket_navigation method=twostag")
    assert (status, told) == (2, "")
    assert error.startswith("study: study.txt, line 2: unknown method 'twostag'")
    assert not (tmp_path / "runs").exists()


def test_a_study_names_what_is_left(tmp_path: Path) -> None:
    status, told, _ = study(tmp_path, f"{SMALL} 'seed=range(0,2)'", options=("--list",))
    assert status == 0
    assert [line.split("seed=")[1].split()[0] for line in told.splitlines()] == ["0", "1"]
    assert json.dumps(told).count("tsbench run") == 2


@pytest.mark.parametrize("line", ["trials=x task=rocket_navigation", "'"])
def test_a_line_that_cannot_be_read_is_named(tmp_path: Path, line: str) -> None:
    status, _, error = study(tmp_path, "", line)
    assert status == 2
    assert "study.txt, line 2: " in error
