"""Kept results: what a run leaves in them, how they are merged, and which policies stay."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsbench import cli
from tsbench.core.errors import TsbenchError
from tsbench.core.files import lock, write_json, write_whole
from tsbench.runs import config, provenance, results
from tsbench.runs.directory import POINTS, Record, RunDirectory
from tsbench.runs.execute import prepare
from tsbench.runs.provenance import write_provenance
from tsbench.runs.results import Result, Results
from tsbench.runs.schema import words_of

ROCKET = ["task=rocket_navigation", "budget=smoke"]


def begin(path: Path, words: list[str], points: int = 5) -> RunDirectory:
    """A run that has begun, and has learned for so many iterations."""
    path.mkdir(parents=True)
    run, chosen = RunDirectory(path), config.compose(words)
    write_provenance(run, chosen, prepare(chosen), words)
    rows = [
        {"stage": "plan", "steps": 10 * i, "seconds": float(i), "normalized_return": i / points}
        for i in range(1, points + 1)
    ]
    run.metrics_file.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run


def finish(run: RunDirectory, record: Record, solved_reward: float = 0.004) -> None:
    score = record.score
    perturbed = replace(score.perturbed, solved_reward=solved_reward)
    chosen = run.config()
    record = replace(
        record,
        seed=chosen.seed,
        budget=chosen.budget,
        method=str(chosen.method["name"]),
        score=replace(score, solved_reward=solved_reward, perturbed=perturbed),
    )
    write_json(run.score_file, record.as_dict())
    for path in (run.policy_info_file, run.policy_file):
        path.write_text(f"seed {chosen.seed}")


def only(found: Results | None) -> Result:
    assert found is not None
    (row,) = found.rows.values()
    return row


def test_a_run_is_named_by_the_words_that_decide_its_result() -> None:
    given = ["seed=3", "threads=2", "++task.constants.distance=24", "task=rocket_navigation"]
    found = words_of(config.compose(given), given)
    assert found == (
        "task=rocket_navigation", "method=twostage", "budget=fast", "seed=3",
        "task.constants.distance=24",
    )  # fmt: skip


def test_a_finished_run_is_kept_with_its_words_distance_and_thin_curves(
    tmp_path: Path, invented_record: Callable[[str], Record]
) -> None:
    run = begin(tmp_path / "run", [*ROCKET, "seed=1", "task.constants.distance=24"], points=1000)
    assert results.of_run(run) is None
    finish(run, invented_record("rocket_navigation"))
    found = results.of_run(run)
    row = only(found)
    assert (row.seed, row.distance, row.standard, row.success) == (1, 24.0, False, 0.4)
    assert row.command.endswith("seed=1 task.constants.distance=24")
    assert found is not None
    (curve,) = found.curves[row.words]
    assert len(curve.steps) == POINTS
    assert (curve.steps[0], curve.steps[-1], curve.returns[-1]) == (10, 10_000, 1)


def test_a_commit_is_marked_by_changes_of_the_package_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not by the results, which a study writes after each run."""
    package = tmp_path / "tsbench"
    for folder in (package, tmp_path / "models", tmp_path / "results"):
        folder.mkdir()
        (folder / "file").write_text("before")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=A", "-c", "user.email=a@example.org"]
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-q", "-m", "all"]):
        subprocess.run([*git, *words], check=True)
    monkeypatch.setattr(provenance, "PACKAGE", package)
    marks = []
    for name in ("results/file", "results/new", "models/file"):
        (tmp_path / name).write_text("after")
        marks.append((provenance._commit() or "")[40:])
    assert marks == ["", "", "+"]


def test_a_plan_that_fails_is_a_result_of_zero(tmp_path: Path) -> None:
    run = begin(tmp_path / "run", ROCKET)
    assert results.of_run(run) is None  # it may still be finished
    run.failure_file.write_text("the plan fails its audit\n")
    row = only(results.of_run(run))
    assert row.failure == "the plan fails its audit"
    assert (row.solved_reward, row.normalized_reward, row.success, row.steps) == (0, 0, 0, 50)


def test_a_failed_run_has_used_the_steps_of_stages_without_curves_too(tmp_path: Path) -> None:
    run = begin(tmp_path / "run", ROCKET)
    with run.metrics_file.open("a") as file:
        for steps in (20, 16_777_217):  # more than a float of 32 bits can count
            file.write(json.dumps({"stage": "roadmap", "steps": steps, "seconds": 7.5}) + "\n")
    run.failure_file.write_text("no way\n")
    stages = only(results.of_run(run)).stages
    assert [(one.name, one.steps, one.seconds) for one in stages] == [
        ("plan", 50, 5.0),
        ("roadmap", 16_777_217, 7.5),
    ]


def test_no_two_processes_change_a_results_folder_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, invented_record: Callable[[str], Record]
) -> None:
    run = begin(tmp_path / "run", ROCKET)
    finish(run, invented_record("rocket_navigation"))
    place, free = tmp_path / "results", []
    write = write_whole

    def noted(path: Path, content: bytes) -> None:
        free.append(lock(place, wait=False))
        write(path, content)

    monkeypatch.setattr(results, "write_whole", noted)
    results.collect(results.read([run.path]), place)
    assert free == [None, None]
    descriptor = lock(place, wait=False)
    assert descriptor is not None
    os.close(descriptor)


def test_results_are_read_as_they_were_kept_and_merged_by_their_words(
    tmp_path: Path, invented_record: Callable[[str], Record]
) -> None:
    record, out = invented_record("rocket_navigation"), tmp_path / "results"
    for seed in range(2):
        run = begin(tmp_path / "runs" / str(seed), [*ROCKET, f"seed={seed}"])
        finish(run, record, solved_reward=0.1 * seed)
    kept = results.collect(results.read([tmp_path / "runs"]), out, trials=12)
    assert results.load(out).rows == kept.rows
    assert [row.trials for row in kept.rows.values()] == [12, 12]
    for words, curves in results.load(out).curves.items():
        for one, other in zip(curves, kept.curves[words], strict=True):
            np.testing.assert_array_equal(one.returns, other.returns)
    again = begin(tmp_path / "again", [*ROCKET, "seed=1"])
    finish(again, record, solved_reward=0.7)
    merged = results.collect(results.read([again.path]), out)
    assert [(row.solved_reward, row.trials) for row in merged.rows.values()] == [(0, 12), (0.7, 12)]
    assert results.read([out]).rows == merged.rows


def test_the_command_says_what_it_has_added_and_replaced(
    tmp_path: Path, invented_record: Callable[[str], Record], capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(2):
        finish(
            begin(tmp_path / str(seed), [*ROCKET, f"seed={seed}"]),
            invented_record("rocket_navigation"),
        )
    words = ["collect", "--out", str(tmp_path / "out"), str(tmp_path / "0")]
    assert cli.main(words) == 0
    assert "out: 1 added, 0 replaced, 1 in all" in capsys.readouterr().out
    assert cli.main([*words, str(tmp_path / "1")]) == 0
    assert "out: 1 added, 1 replaced, 2 in all" in capsys.readouterr().out


def test_curves_whose_rows_are_lost_stay(
    tmp_path: Path, invented_record: Callable[[str], Record]
) -> None:
    out = tmp_path / "out"
    for seed in range(3):
        run = begin(tmp_path / str(seed), [*ROCKET, f"seed={seed}"])
        finish(run, invented_record("rocket_navigation"))
    before = results.collect(results.read([tmp_path / "0", tmp_path / "1"]), out).curves
    (out / results.ROWS).unlink()
    for seed in (2, 1):
        results.collect(results.read([tmp_path / str(seed)]), out)
    found = results.load(out)
    assert len(found.rows) == 2
    assert before.keys() < found.curves.keys()
    assert len(found.curves) == 3


def test_damaged_curves_are_one_line(
    tmp_path: Path, invented_record: Callable[[str], Record]
) -> None:
    run, curves = begin(tmp_path / "run", ROCKET), tmp_path / "out" / results.CURVES
    finish(run, invented_record("rocket_navigation"))
    results.collect(results.read([run.path]), curves.parent)
    content, told = curves.read_bytes(), []
    places = range(0, len(content), 7)
    for place in places:
        spoilt = bytearray(content)
        spoilt[place : place + 40] = bytes(byte ^ 0xFF for byte in spoilt[place : place + 40])
        curves.write_bytes(spoilt)
        try:
            results.load(curves.parent)
        except TsbenchError as error:
            told.append(str(error))
    assert len(told) > 0.5 * len(places)
    assert all(str(curves) in line and "\n" not in line for line in told)


@pytest.mark.parametrize("steps", ["many", None, 1e300])
def test_damaged_metrics_are_one_line(
    tmp_path: Path, invented_record: Callable[[str], Record], steps: Any
) -> None:
    run = begin(tmp_path / "run", ROCKET)
    finish(run, invented_record("rocket_navigation"))
    row = {"stage": "plan", "steps": steps, "seconds": 1.0, "normalized_return": 0.5}
    run.metrics_file.write_text(json.dumps(row) + "\n")
    with pytest.raises(TsbenchError, match=r"damaged metrics .*: a row lacks its stage, steps"):
        results.read([run.path])


@pytest.mark.parametrize("arrays", [{"loss": np.zeros(3)}, {"a b": np.zeros((3, 4))}])
def test_curves_that_somebody_else_keeps_are_not_replaced(
    tmp_path: Path, invented_record: Callable[[str], Record], arrays: dict[str, np.ndarray]
) -> None:
    run, curves = begin(tmp_path / "run", ROCKET), tmp_path / results.CURVES
    finish(run, invented_record("rocket_navigation"))
    np.savez(curves, allow_pickle=False, **arrays)
    content = curves.read_bytes()
    with pytest.raises(TsbenchError, match=r"curves\.npz holds no learning curves of tsbench"):
        results.collect(results.read([run.path]), tmp_path)
    assert curves.read_bytes() == content
    assert not (tmp_path / results.ROWS).exists()


def test_a_tuned_run_is_kept_whatever_its_settings(
    tmp_path: Path, invented_record: Callable[[str], Record]
) -> None:
    """Its words hold spaces, and are too long for the name of a folder."""
    settings = [
        f"task.training.{stage}.{key}=0.123456789012345678"
        for stage in ("plan", "imitate", "finetune")
        for key in ("learning_rate", "entropy", "gae_lambda")
    ]
    words = [*ROCKET, "task.training.imitate.hidden=[64, 64]", *settings]
    run, out = begin(tmp_path / "run", words), tmp_path / "results"
    finish(run, invented_record("rocket_navigation"))
    kept = results.collect(results.read([run.path]), out, trials=12)
    loaded = results.load(out)
    assert loaded.rows == kept.rows
    assert len(loaded.rows) == 1
    assert loaded.folders.keys() == loaded.curves.keys() == loaded.rows.keys()


def test_the_policies_of_the_best_the_median_and_the_worst_seed_stay(
    tmp_path: Path, invented_record: Callable[[str], Record]
) -> None:
    record, out = invented_record("rocket_navigation"), tmp_path / "results"

    def kept() -> set[str]:
        return {path.parent.name[:5] for path in out.rglob("policy.json")}

    for seed, worth in enumerate((0.3, 0.1, 0.5, 0.2, 0.4)):
        run = begin(tmp_path / "runs" / str(seed), [*ROCKET, f"seed={seed}"])
        finish(run, record, solved_reward=worth)
        results.collect(results.read([run.path]), out)
    assert kept() == {"seed1", "seed0", "seed2"}
    other = begin(tmp_path / "other", [*ROCKET, "seed=5", "task.constants.distance=24"])
    finish(other, replace(record, standard=False))
    results.collect(results.read([other.path]), out)
    assert kept() == {"seed1", "seed0", "seed2"}  # changed tasks are for their scores alone
    best = begin(tmp_path / "best", [*ROCKET, "seed=6"])
    finish(best, record, solved_reward=0.9)
    found = results.collect(results.read([best.path]), out)
    # The median is now one of two; seed 4 has gone, so that seed 0 stays for it.
    assert {found.rows[words].seed for words in found.folders} == {0, 1, 6}
    assert len(found.rows) == 7


def test_what_is_no_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TsbenchError, match="there is no directory"):
        results.read([tmp_path / "nowhere"])
    with pytest.raises(TsbenchError, match="no finished run, no entry and no results of tsbench"):
        results.read([tmp_path])
    (tmp_path / results.ROWS).write_text('{"task": 3}\n')
    with pytest.raises(TsbenchError, match=r"damaged results .*runs\.jsonl, line 1: task must be"):
        results.read([tmp_path])


@pytest.mark.parametrize("name", [results.ROWS, results.CURVES])
def test_only_regular_files_of_a_results_folder_are_read(
    tmp_path: Path, invented_record: Callable[[str], Record], name: str
) -> None:
    run, out = begin(tmp_path / "run", ROCKET), tmp_path / "results"
    finish(run, invented_record("rocket_navigation"))
    results.collect(results.read([run.path]), out)
    (out / name).rename(tmp_path / name)
    (out / name).symlink_to(tmp_path / name)
    with pytest.raises(TsbenchError, match=f"{name} is a link: only regular files are read"):
        results.load(out)
