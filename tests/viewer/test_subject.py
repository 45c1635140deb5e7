"""What pages say of a pushed episode, of two runs, and of a robot that is a rocket."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from tsbench import tasks
from tsbench.core.words import number
from tsbench.runs.directory import RunDirectory
from tsbench.viewer import page, report
from tsbench.viewer.pushes import parse_push
from tsbench.viewer.recording import record_episode
from tsbench.viewer.show import Figures, Show
from tsbench.viewer.subject import pair, run_subject, subject

MakeRun = Callable[..., Path]

BOARD = Path(__file__).parents[2] / "leaderboards" / "v1"


def column(table: Figures, head: str) -> dict[str, str]:
    place = table.heads.index(head)
    return {row[0]: row[place] for row in table.rows}


def of_seed(run: Path, seed: int) -> None:
    score = json.loads((run / "score.json").read_text())
    (run / "score.json").write_text(json.dumps({**score, "seed": seed}))


def words_of(text: str) -> str:
    """What readers see of a page: neither scripts and styles nor the page within it."""
    text = re.sub(r'srcdoc="[^"]*"', "", text)
    text = re.sub(r"<(script|style)\b.*?</\1>", "", text, flags=re.DOTALL)
    return re.sub(r"<[^>]*>", " ", text)


# Pushes


@pytest.mark.parametrize(
    ("name", "action", "push", "words"),
    [
        ("laikago_trot", 0.0, "400N@0.5s:+y", "400 N left (+y) at 0.5 s"),
        ("laikago_walk", 0.0, "1N@0.2s:45", "1 N at 45 degrees at 0.2 s"),  # changes little
        ("rocket_navigation", 0.7, "90N@1s:-z", "90 N down (-z) at 1 s"),
    ],
)
def test_a_pushed_episode_has_its_own_figures(
    make_run: MakeRun, name: str, action: float, push: str, words: str
) -> None:
    run = make_run(name, action)
    subject_ = run_subject(RunDirectory(run))
    shown = subject_.show(push)
    assert shown.title == f"{subject_.title}, pushed by {words}"
    assert words in shown.verdict
    (table,) = shown.tables
    task, policy = subject_.task, subject_.policy
    assert policy is not None
    pushed = record_episode(task, policy, parse_push(push, task))
    plain = record_episode(task, policy)
    for head, recording in (("pushed", pushed), ("not pushed", plain)):
        found = column(table, head)
        assert found["ends"] == recording.ending
        assert found["after, s"] == f"{recording.duration:.2f}"
        assert found["distance to the goal, m"] == f"{recording.goal_distance[-1]:.2f}"
        for measure, value in recording.measures.items():
            assert found[measure] == number(value)
    assert shown.actors[0].ending == f"{pushed.ending} at {pushed.duration:.2f} s"
    assert "of 100" not in page.render(shown)  # the score is that of other episodes


def test_endings_in_words(make_run: MakeRun) -> None:
    """A robot that stands until the time is up, one that is thrown over, a rocket that leaves."""
    stands = run_subject(RunDirectory(make_run("laikago_trot"))).show()
    assert stands.actors[0].ending == "unsolved, time is up at 6.00 s"
    thrown = subject(str(make_run("laikago_walk", directory="b"))).show("400N@0.5s:-y")
    assert re.fullmatch(r"a fall at [01]\.\d\d s", thrown.actors[0].ending)
    falls = subject(str(make_run("rocket_obstacles", directory="c"))).show()
    assert falls.actors[0].ending.startswith("a collision or leaving the world at 3.")


# Two runs


def test_two_runs_are_called_by_what_distinguishes_them(make_run: MakeRun) -> None:
    one, other = (make_run("rocket_navigation", 0.7, directory=word) for word in ("one", "other"))

    def called(*runs: Path) -> list[str]:
        return [actor.name for actor in pair([str(run) for run in runs]).actors]

    assert called(one, other) == ["A: one", "B: other"]
    of_seed(other, 3)
    assert called(one, other) == ["A: seed 0", "B: seed 3"]
    assert called(other, other) == ["A: other", "B: other"]
    (other / "score.json").unlink()
    assert called(one, other) == ["A: one", "B: other"]


def test_two_runs_are_shown_with_their_scores(make_run: MakeRun) -> None:
    runs = [str(make_run("laikago_walk", directory=word)) for word in ("one", "other")]
    shown = pair(runs)
    episode, score = shown.tables
    assert column(episode, "A") == column(episode, "B")
    assert column(score, "A")["solved from perturbed starts"] == "40 of 100"
    assert column(score, "B")["pushes of 100 N survived"] == "25%"
    (Path(runs[1]) / "score.json").unlink()
    score = pair(runs).tables[1]
    assert column(score, "A")["solved from perturbed starts"] == "40 of 100"
    assert set(column(score, "B").values()) == {"-"}
    pushed = pair(runs, "400N@0.5s:-y")
    assert pushed.title.endswith(", pushed by 400 N right (-y) at 0.5 s")
    (episode,) = pushed.tables  # a score says nothing of a pushed episode
    assert column(episode, "A")["ends"] == "a fall"
    assert "footfall agreement" in column(episode, "A")


# Words of a task's own robot


@pytest.mark.parametrize("name", tasks.names())
def test_a_rocket_is_called_a_rocket(make_run: MakeRun, name: str) -> None:
    run = make_run(name, 0.7)
    drawing = tasks.make(name).drawing()
    texts = words_of(report.render(RunDirectory(run))) + words_of(
        page.render(subject(str(run)).show(), served=True)
    )
    assert f"follow the {drawing.robot}" in texts
    if drawing.robot != "robot":
        assert not re.search(r"\b(robot|joints?|falls?|feet|foot|legs?)\b", texts)


@pytest.mark.parametrize("name", tasks.names())
def test_the_form_offers_the_pushes_that_the_task_takes(make_run: MakeRun, name: str) -> None:
    task = tasks.make(name)
    text = page.render(subject(str(make_run(name, 0.7))).show(), served=True)
    form = text[text.index('name="heading"') :].partition("</select>")[0]
    offered = re.findall(r'value="([+-][xyz])">\w+', form)
    assert len(offered) == 4
    for heading in offered:
        parse_push(f"1N@0s:{heading}", task)


@pytest.mark.parametrize("name", tasks.names())
def test_the_border_of_a_world_is_explained(make_run: MakeRun, name: str) -> None:
    def explained(show: Show) -> bool:
        return any(entry.name == "border" for entry in show.legend)

    bounded = tasks.make(name).drawing().bounds is not None
    run = str(make_run(name, 0.7))
    for show in (subject(run).show(), subject(f"task={name}").show(), pair([run, run])):
        assert explained(show) == bounded


# How a run was made


def test_a_report_tells_the_command_and_whether_there_are_curves(make_run: MakeRun) -> None:
    run = make_run("rocket_navigation", 0.7)
    assert "How it was made" not in report.render(RunDirectory(run))
    kept = min((BOARD / "rocket_navigation").glob("*/*/config.yaml"))
    (run / "config.yaml").write_text(kept.read_text())
    command = RunDirectory(kept.parent).command
    assert command.startswith("tsbench run task=rocket_navigation")
    text = words_of(report.render(RunDirectory(run)))
    assert command in text
    assert "How it learned" in text
    (run / "metrics.jsonl").unlink()
    text = words_of(report.render(RunDirectory(run)))
    assert command in text
    assert "no metrics, so there are no curves" in text
