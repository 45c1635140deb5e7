"""The report: its figures are those of the score and the recording."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from tsbench import cli, tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.motion import Plan
from tsbench.evaluation.protocol import V1
from tsbench.runs.directory import Record, RunDirectory, Stage
from tsbench.viewer import charts, curves, report
from tsbench.viewer.show import PLAN_COLOUR

MakeRun = Callable[..., Path]
BOARD = Path(__file__).parents[2] / "leaderboards" / "v1"


def words_of(text: str) -> str:
    """The report's own text, without the embedded view."""
    return re.sub(r'srcdoc="[^"]*"', "", text)


def test_a_report_says_what_was_planned_and_done_and_how_good_it_is(make_run: MakeRun) -> None:
    run = make_run("laikago_trot")
    text = report.render(RunDirectory(run))
    assert len(text) < 3e6
    own = words_of(text)
    for words in (
        "laikago_trot, twostage, seed 0, budget smoke",
        "The plan starts 3.00 m from the goal",
        "In full physics the policy ends 3.01 m from the goal after 6.0 s, which does not solve",
        '<p class="verdict">SOLVED 40 of 100</p><p>Not ranked: protocol smoke plays too few',
        "episodes. The policy solves the task from 40 of 100",
        "perturbed starts. Spoiled by a fall: 25 of 100. Footfall agreement: 0.5 (1 for",
        "feet that stand",
        "Time to the goal, s: 0.5 (of the episodes that arrived).",
        "The policy earns 1.0% of the largest possible reward, which is 0.125 times the reward",
        "of the best plan. Of all pushes of 100 N for 0.1 s it survives 25.0% and solves the task",
        "after 12.5%.",
        "Contacts and schedule agree",
        "Foot contacts",
        "feet do not slip",
        "FR_thigh_joint, rad (typical error",
        "share of pushes survived",
        "share of pushes recovered",
        "reference motion",
        "<td>impulse at 50 % survived, task solved</td><td>over 60 N s</td>",
        "environment steps",
        "<td>1:01</td>",
        "<td>pushes of 100 N survived</td><td>25%</td>",
        "mean distance of CoM from support",
        "How it learned",
    ):
        assert words in own, words
    assert not re.search(r"https?://(?!www\.w3\.org)|\bsrc=|@import", own.replace("xlink:href", ""))


def test_what_a_run_lacks_is_left_out(make_run: MakeRun) -> None:
    run = make_run("rocket_navigation", 0.7)
    for name in ("plan.npz", "reference.npz", "metrics.jsonl"):
        (run / name).unlink()
    own = words_of(report.render(RunDirectory(run)))
    assert "without a plan" in own
    for words in ("Foot contacts", "Joints", "How it learned", "physics follow", "Blue", "audit"):
        assert words not in own


def test_a_plan_that_fails_its_audit_is_said_first(make_run: MakeRun) -> None:
    run = make_run("rocket_navigation", 0.7)
    assert "fails its audit" not in words_of(report.render(RunDirectory(run)))
    plan = Plan.load(run / "plan.npz")
    replace(plan, states=0.0 * plan.states).save(run / "plan.npz")
    words = (
        r"<h2>What was planned</h2><p>The plan fails its audit: "
        r"distance of the plan&#x27;s end from the goal 60 m, allowed 1 m.* The plan starts"
    )
    assert re.search(words, words_of(report.render(RunDirectory(run))))


def test_why_a_score_is_not_ranked_is_said_first(
    invented_record: Callable[[str], Record],
) -> None:
    record = invented_record("rocket_navigation")
    task = tasks.make("rocket_navigation")
    smoke = record.score
    v1 = replace(smoke, protocol="v1", origin=replace(smoke.origin, protocol=V1))
    changed, few = "the task's constants were changed", "protocol smoke plays too few episodes"
    for score, standard, reasons in (
        (v1, False, changed),
        (smoke, True, few),
        (smoke, False, f"{changed} and {few}"),
    ):
        one = replace(record, score=score, standard=standard)
        words = report.worth_in_words(one, task)
        assert words.startswith(f"Not ranked: {reasons}. The policy solves")
    assert report.worth_in_words(replace(record, score=v1), task).startswith("The policy solves")


def test_a_training_beyond_its_budget_is_said_first(make_run: MakeRun) -> None:
    run = RunDirectory(make_run("rocket_navigation", 0.7))
    kept = min((BOARD / "rocket_navigation").glob("twostage/*/config.yaml"))
    run.config_file.write_text(kept.read_text())  # of 1,000,000 steps for each stage
    content = json.loads(run.score_file.read_text())
    for steps, said in ((1_000_000, False), (2_000_001, True)):
        content["stages"] = [asdict(Stage("imitate", steps, steps=steps))]
        run.score_file.write_text(json.dumps(content))
        more = "Over the budget, so no leaderboard takes this run: stages of 2,000,001 steps, where"
        assert (f"<p>{more} the budget paper has 2,000,000." in report.render(run)) == said


@pytest.mark.parametrize(
    ("survived", "recovered", "words"),
    [
        (0.0, 0.0, "it survives none."),
        (0.5, 0.0, "it survives 50.0% and solves the task after none."),
        (0.5, 1 / 256, "it survives 50.0% and solves the task after 0.4%."),
    ],
)
def test_pushes_that_nothing_survives_are_told_in_words(
    survived: float, recovered: float, words: str, invented_record: Callable[[str], Record]
) -> None:
    record = invented_record("laikago_trot")
    robustness = replace(record.score.robustness, survival_100N=survived, recovery_100N=recovered)
    record = replace(record, score=replace(record.score, robustness=robustness))
    text = report.worth_in_words(record, tasks.make("laikago_trot"))
    assert text.endswith(f" Of all pushes of 100 N for 0.1 s {words}")


def test_a_term_that_is_the_whole_reward_is_drawn_once(make_run: MakeRun) -> None:
    own = words_of(report.render(RunDirectory(make_run("rocket_navigation", 0.7))))
    assert re.findall(r">([^<]*) over time</title>", own)[0] == "near the goal = reward"
    assert "reward over time" not in own.replace("near the goal = reward over time", "")
    own = words_of(report.render(RunDirectory(make_run("rocket_obstacles", directory="other"))))
    for title in ("near the goal", "near obstacle 1", "reward"):
        assert f">{title} over time</title>" in own


def test_texts_hold_no_marks_of_another_language(make_run: MakeRun) -> None:
    own = words_of(report.render(RunDirectory(make_run("laikago_trot"))))
    assert "`" not in own.partition("<script>")[0]


def test_only_finished_runs_have_reports(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run("rocket_navigation", 0.7)
    (run / "score.json").unlink()
    with pytest.raises(TsbenchError, match=r"has no score\.json: only a finished run"):
        report.render(RunDirectory(run))
    with pytest.raises(TsbenchError, match="no run directory"):
        report.render(RunDirectory(tmp_path / "nowhere"))


def test_the_command_writes_it_beside_the_run(
    make_run: MakeRun, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run("rocket_navigation", 0.7)
    assert cli.main(["report", str(run)]) == 0
    assert capsys.readouterr().out == f"{run / 'report.html'}\n"
    assert (run / "report.html").read_text("utf-8").startswith("<!DOCTYPE html>")
    assert cli.main(["report", str(run)]) == 2
    assert "nothing is overwritten: give another by --html FILE" in capsys.readouterr().err
    assert cli.main(["report", str(run), "--html", "report.png"]) == 2
    assert capsys.readouterr().err == "tsbench: report.png must end in .html\n"


def test_names_are_no_formulas() -> None:
    line = ("plan", PLAN_COLOUR, np.arange(2.0), np.arange(2.0))
    assert "$\\no_such_word$" in charts._panel("x", "$\\no_such_word$", [line])


def test_what_does_not_belong_to_the_run_is_refused(
    make_run: MakeRun, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run("rocket_navigation", 0.7)
    plan = Plan.load(run / "plan.npz")
    replace(plan, task="laikago_trot").save(run / "plan.npz")
    assert cli.main(["report", str(run)]) == 2
    assert "the plan is for laikago_trot version 1, not for" in capsys.readouterr().err
    (run / "metrics.jsonl").write_text('{"stage": "plan", "st')
    with pytest.raises(TsbenchError, match="damaged metrics"):
        curves.figure(run / "metrics.jsonl")
