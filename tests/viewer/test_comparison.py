"""Runs beside each other: differences by hand, and the picture of their learning curves."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsbench import cli
from tsbench.core.errors import TsbenchError
from tsbench.evaluation.protocol import SMOKE, V1
from tsbench.runs.directory import Record, Stage
from tsbench.runs.results import Curve, Result, Results
from tsbench.viewer import comparison

TASK = "rocket_navigation"
ROOT = Path(__file__).parents[2]


@pytest.fixture(name="made")
def made_fixture(invented_record: Callable[[str], Record]) -> Callable[..., Results]:
    """A function from scores by method and seed to results with these."""
    score = invented_record(TASK).score
    score = replace(score, protocol=V1.name, origin=replace(score.origin, protocol=V1))

    def made(**methods: dict[int, float]) -> Results:
        found = Results()
        for method, runs in methods.items():
            for seed, reward in runs.items():
                summary = replace(score.perturbed, solved_reward=reward)
                words = (f"task={TASK}", f"method={method}", "budget=fast", f"seed={seed}")
                found.rows[words] = Result(
                    words=words, task=TASK, method=method, seed=seed, budget="fast",
                    distance=60.0, standard=True, commit=None, settings="",
                    stages=(Stage("task", 100, steps=100, physics_substeps=100, seconds=1.0),),
                    score=replace(score, solved_reward=reward, perturbed=summary),
                )  # fmt: skip
        return found

    return made


def test_a_difference_by_hand(made: Callable[..., Results]) -> None:
    """Seeds 1 and 2 are common: (0.5 - 0.1 + 0.3 - 0.2) / 2 = 0.25. Of the four equally likely
    choices of two signs, two give a mean as far from zero."""
    (pair,) = comparison.pairs(made(prm={0: 0.9, 1: 0.5, 2: 0.3}, other={1: 0.1, 2: 0.2, 3: 0.7}))
    assert (pair.first, pair.second, pair.seeds) == ("prm", "other", 2)
    assert pair.difference is not None
    assert pair.difference.mean == pytest.approx(0.25)
    assert pair.difference.interval is None
    assert pair.p_value == pytest.approx(0.5)


def test_pairs_without_a_common_seed(made: Callable[..., Results]) -> None:
    (pair,) = comparison.pairs(made(prm={0: 0.9}, other={1: 0.1}))
    assert (pair.seeds, pair.difference, pair.p_value) == (0, None, None)
    (pair,) = comparison.pairs(made(prm={1: 0.9}, other={1: 0.1}))
    assert pair.difference is not None
    assert pair.p_value is None  # nothing can be told from one seed


def test_scores_that_differ_in_kind_are_not_compared(made: Callable[..., Results]) -> None:
    """Of a longer way, of another protocol, and of failed plans, which count everywhere."""
    found = made(prm={0: 0.9}, far={0: 0.5}, failed={0: 0.0}, smoke={0: 0.4})

    def change(method: str, *more: str, **origin: Any) -> None:
        (row,) = (row for row in found.rows.values() if row.method == method)
        del found.rows[row.words]
        assert row.score is not None
        score = replace(row.score, origin=replace(row.score.origin, **origin))
        changed = replace(row, words=(*row.words, *more), score=score)
        found.rows[changed.words] = changed

    change("far", "task.constants.distance=80", constants="0" * 64)
    change("smoke", protocol=SMOKE)
    (row,) = (row for row in found.rows.values() if row.method == "failed")
    found.rows[row.words] = replace(row, score=None, failure="no way")
    longer = (*row.words, "task.constants.distance=40")
    found.rows[longer] = replace(row, words=longer, score=None, failure="no way")
    names = comparison.names(found)
    assert {names[words] for words in found.rows} == {
        "prm", "far, distance=80", "smoke, protocol smoke", "failed", "failed, distance=40"
    }  # fmt: skip
    assert comparison.incomparable(found)
    assert {frozenset((pair.first, pair.second)) for pair in comparison.pairs(found)} == {
        frozenset((name, "failed")) for name in ("prm", "smoke, protocol smoke")
    }


def test_p_values_are_adjusted_for_the_number_of_pairs(made: Callable[..., Results]) -> None:
    """Ten seeds that all differ by 0.1 or more: p = 2 / 2**10 of each pair, times three by Holm."""
    seeds = range(10)
    found = comparison.pairs(
        made(
            prm={seed: 0.9 + 0.001 * seed for seed in seeds},
            a=dict.fromkeys(seeds, 0.5),
            b={seed: 0.1 - 0.001 * seed for seed in seeds},
        )
    )
    assert len(found) == 3
    assert [pair.p_value for pair in found] == pytest.approx([3 * 2 / 2**10] * 3)
    assert all(pair.difference and pair.difference.interval for pair in found)


def test_the_picture(made: Callable[..., Results]) -> None:
    found = made(prm={0: 0.9}, other={0: 0.1})
    with pytest.raises(TsbenchError, match="no learning curves"):
        comparison.picture(found)
    steps = np.array([0.0, 50.0, 100.0])
    for words in found.rows:
        found.curves[words] = (Curve("task", steps, steps / 100.0, steps / 200.0),)
    assert comparison.picture(found).startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["old", "new"], "prm, in new less prm, in old"),
        (["old/seed0", "old/seed1", "new/seed0", "new/seed1"], "prm, in new less prm, in old"),
        (["old/seed0", "old/copy"], "prm, in old/copy less prm, in old/seed0"),
        (["old", "new", "new"], "prm, in new less prm, in old"),
    ],
)
def test_runs_by_one_command_are_told_apart_by_their_places(
    words: list[str],
    names: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Those before a change of the code and those after it. One folder has a seed more."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    kept = sorted((ROOT / "leaderboards/v1/rocket_navigation/prm").glob("seed*"))
    for place, one in {"old/seed0": 0, "old/seed1": 1, "new/seed0": 0, "new/seed1": 1}.items():
        shutil.copytree(kept[one], place)
    shutil.copytree(kept[0] if "old/copy" in words else kept[2], "old/copy")
    assert cli.main(["compare", *words, "--json", "found.json"]) == 0
    text = capsys.readouterr().out
    assert names.replace("prm,", "prm, shortcut=false,") in re.sub(r"\s+", " ", text)
    runs = json.loads(Path("found.json").read_text())["runs"]
    assert not any(word.startswith("in ") for run in runs for word in run["words"])


def test_compare_kept_entries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    words = ["compare", "rocket_navigation/twostage", "rocket_navigation/prm"]
    assert cli.main([*words, "--json", "found.json"]) == 0
    text = capsys.readouterr().out
    assert "rocket_navigation, seed by seed" in text
    assert "twostage less prm" in text
    assert (tmp_path / "found.json").exists()
    assert "are not compared" not in text
    monkeypatch.setenv("COLUMNS", "120")
    assert cli.main(["compare", str(ROOT / "results" / "paper")]) == 0
    text = capsys.readouterr().out
    rows = [line for line in text.partition("seed by seed")[0].splitlines() if ", seed " in line]
    assert any("prm, shortcut=true, seed 3" in row for row in rows)
    assert any("twostage, distance=24" in row for row in text.splitlines())
    assert "versions or constants of a task are not compared" in text
    kept = ROOT / "leaderboards" / "v1" / "rocket_navigation" / "prm"
    bare = [shutil.copytree(one, tmp_path / one.name) for one in sorted(kept.glob("seed*"))[:2]]
    for folder in bare:
        (folder / "metrics.jsonl").unlink()
    assert cli.main(["compare", *map(str, bare), "--png", "x.png"]) == 2
    assert "none of these has its metrics.jsonl" in capsys.readouterr().err
    assert not (tmp_path / "x.png").exists()
    assert cli.main(["compare", str(kept), "--png", "x.pdf"]) == 2
    assert capsys.readouterr().err == "tsbench: x.pdf must end in .png\n"
