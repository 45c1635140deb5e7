"""One run, end to end: the content of its directory, and checks of it later."""

from __future__ import annotations

import importlib
import io
import json
import math
import os
import re
import resource
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.util.tensor_util import make_ndarray

from tsbench import cli, tasks
from tsbench.cli import launch
from tsbench.core import words
from tsbench.core.errors import PlanError, TsbenchError
from tsbench.core.motion import ActionLog, Plan, ReferenceMotion
from tsbench.core.policy import Policy
from tsbench.evaluation.protocol import PROTOCOLS
from tsbench.runs import config
from tsbench.runs import directory as record
from tsbench.runs import execute as run
from tsbench.runs.directory import RunDirectory, Stage
from tsbench.runs.progress import Output
from tsbench.runs.workspace import RunWorkspace
from tsbench.sim.model import compiled_hash, fingerprint

WORDS = ["task=rocket_navigation", "budget=smoke", "task.budgets.smoke.plan=512", "seed=3"]


def plain(content: Any) -> Any:
    """The content as JSON gives it back."""
    return json.loads(json.dumps(content))


def execute(directory: Path, words: list[str] = WORDS) -> str:
    """Makes a run with its pages and returns its output."""
    chosen = replace(config.compose(words), directory=str(directory))
    with (directory.parent / "out").open("w+") as file:
        console = Console(file=file, width=100)
        run.execute(chosen, words, console)
        launch.finish(directory, console)
        file.seek(0)
        return file.read()


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A finished run's directory, which no test may change, and the run's output."""
    directory = tmp_path_factory.mktemp("runs") / "one"
    return directory, execute(directory)


@pytest.fixture
def finished(shown: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the finished run below the current directory, which tests may change."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(shown[0], "one")
    return Path("one")


EVERYTHING = {
    "actions.npz",
    "config.yaml",
    "learning_curves.png",
    "log.txt",
    "metrics.jsonl",
    "plan.npz",
    "policy.json",
    "policy.safetensors",
    "reference.npz",
    "report.html",
    "score.json",
    "tensorboard",
    "versions.json",
    "view.html",
}


def names(directory: Path) -> set[str]:
    return {path.name for path in directory.iterdir()}


def test_the_directory_holds_everything(shown: tuple[Path, str]) -> None:
    assert names(shown[0]) == EVERYTHING


def test_the_config_repeats_the_run(shown: tuple[Path, str]) -> None:
    directory, _ = shown
    text = (directory / "config.yaml").read_text()
    assert text.startswith(f"# tsbench run {' '.join(WORDS)}\n")
    composed = replace(config.compose(WORDS), directory=str(directory))
    assert RunDirectory(directory).config() == composed
    assert yaml.safe_load(text)["seed"] == 3


def test_versions_and_hashes(shown: tuple[Path, str]) -> None:
    content = json.loads((shown[0] / "versions.json").read_text())
    assert content["packages"]["mujoco"] == version("mujoco")
    assert content["packages"]["rsl-rl-lib"] == version("rsl-rl-lib")
    spec = tasks.make("rocket_navigation").spec()
    assert content["physics"] == {"rocket_navigation": compiled_hash(spec)}
    assert content["plug-ins"] == {}
    assert Policy.load(shown[0]).info.physics == fingerprint(spec)


def test_the_score_says_what_each_stage_used(shown: tuple[Path, str]) -> None:
    content = RunDirectory(shown[0]).record()
    assert (content.task, content.method) == ("rocket_navigation", "twostage")
    assert content.standard is True
    assert 0.0 <= content.score.normalized_reward <= 1.0
    plan, imitate = content.stages
    assert (plan.name, imitate.name) == ("plan", "imitate")
    assert plan.budget == 512 <= plan.steps
    assert imitate.budget <= imitate.steps
    assert plan.physics_substeps == 0
    substeps = tasks.make("rocket_navigation").substeps
    assert imitate.physics_substeps >= imitate.steps * substeps
    assert plan.seconds > 0.0


def test_metrics_are_the_same_in_both_places(shown: tuple[Path, str]) -> None:
    lines = (shown[0] / "metrics.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    assert {row["stage"] for row in rows} == {"plan", "imitate"}
    events = EventAccumulator(str(shown[0] / "tensorboard"))
    events.Reload()
    for stage in ("plan", "imitate"):
        steps = [row["steps"] for row in rows if row["stage"] == stage]
        assert steps == sorted(set(steps))
        losses = [row["value_loss"] for row in rows if row["stage"] == stage]
        shown_there = events.Tensors(f"{stage}/value_loss")
        assert [event.step for event in shown_there] == steps
        assert np.allclose([make_ndarray(event.tensor_proto) for event in shown_there], losses)


def test_the_learning_curves_are_a_picture(shown: tuple[Path, str]) -> None:
    assert (shown[0] / "learning_curves.png").read_bytes().startswith(b"\x89PNG\r\n")


def test_the_table_tells_the_score_the_cost_and_where_to_look(shown: tuple[Path, str]) -> None:
    directory, text = shown
    for line in (
        "rocket_navigation, twostage, seed 3, budget smoke",
        "normalized_reward",
        "SOLVED",
        "against_plan",
        "solved_reward",
        "success",
        "10 perturbed starts",
        "survival_100N",
        f"tsbench evaluate {directory}",
        f"{directory / 'report.html'}",
    ):
        assert line in text
    assert "plan:" in (directory / "log.txt").read_text()


def test_nothing_but_what_is_ours_is_shown(shown: tuple[Path, str]) -> None:
    assert "rsl" not in shown[1].lower()
    assert len(shown[1].splitlines()) < 60


def test_the_same_seed_gives_the_same_bits(finished: Path, tmp_path: Path) -> None:
    execute(tmp_path / "two")
    for name in ("policy.safetensors", "policy.json"):
        assert (finished / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    first, second = RunDirectory(finished).record(), RunDirectory(tmp_path / "two").record()
    assert first.score == second.score
    one, two = Plan.load(finished / "plan.npz"), Plan.load(tmp_path / "two" / "plan.npz")
    np.testing.assert_array_equal(one.states, two.states)


def test_a_used_directory_is_refused_and_stays(finished: Path) -> None:
    before = (finished / "score.json").read_bytes()
    with pytest.raises(TsbenchError, match="one holds a finished run and nothing is overwritten"):
        execute(finished)
    assert (finished / "score.json").read_bytes() == before


def test_evaluate_repeats_the_score(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["evaluate", "one", "--json", "again.json"]) == 0
    assert "one/score.json: compared bit for bit: equal" in capsys.readouterr().out
    shown = json.loads(Path("again.json").read_text())
    comparison = shown.pop("comparison")
    assert comparison == {
        "kind": "exact", "agrees": True, "words": "compared bit for bit: equal",
    }  # fmt: skip
    assert shown == plain(record.shown(RunDirectory(finished).record()))
    assert {"normalized_reward", "robustness", "stages"} <= shown.keys()


def test_evaluate_needs_the_policy_file_alone(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("bare").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(finished / name, "bare")
    words = ["evaluate", "bare", "--protocol", "smoke", "--threads", "1", "--json", "bare.json"]
    assert cli.main(words) == 0
    assert "score.json" not in capsys.readouterr().out
    score = plain(RunDirectory(finished).record().score.as_dict())
    assert json.loads(Path("bare.json").read_text()) == {**score, "standard": True}


def test_evaluate_says_when_a_score_is_not_what_the_policy_earns(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads((finished / "score.json").read_text())
    content["score"]["nominal"]["normalized_reward"] = 0.99
    (finished / "score.json").write_text(json.dumps(content))
    assert cli.main(["evaluate", "one"]) == 1
    assert "one/score.json: compared bit for bit: DIFFERENT" in capsys.readouterr().out
    content["score"]["solved_reward"] = 0.99  # a headline that its own summary belies
    (finished / "score.json").write_text(json.dumps(content))
    assert cli.main(["evaluate", "one"]) == 2
    assert "solved_reward must be that of the perturbed starts" in capsys.readouterr().err


def test_another_physics_is_played_beside(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", "one", "--physics", "half_step", "--json", "two.json"]
    assert cli.main(words) == 0
    shown = capsys.readouterr().out
    assert "verdicts that change in physics half_step" in shown
    assert "compared bit for bit: equal" in shown  # the certified score
    content = json.loads(Path("two.json").read_text())
    score = plain(RunDirectory(finished).record().score.as_dict())
    assert {name: content[name] for name in score} == score
    other = content["physics"]["score"]
    assert other["protocol"] == "smoke in half_step"
    assert other["origin"]["protocol"]["ranked"] is False
    assert other["normalized_reward"] != content["normalized_reward"]
    counts = {one["verdict"]: one["verdicts"] for one in content["physics"]["flips"]}
    assert counts == {
        "solved, task's own start": 1,
        "solved, perturbed starts": 10,
        "solved, changed physics": 2,
        "survived, pushes": 2 * 4 * 2,
        "recovered, pushes": 2 * 4 * 2,
    }
    assert cli.main(["evaluate", "one", "--physics", "round"]) == 2
    assert "unknown physics 'round'; allowed: elliptic, half_step, warp" in capsys.readouterr().err


def test_evaluate_replays_where_the_machine_differs(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads((finished / "score.json").read_text())
    content["score"]["origin"]["machine"]["extensions"] = "X86_V9"
    (finished / "score.json").write_text(json.dumps(content))
    assert cli.main(["evaluate", "one"]) == 0
    shown = capsys.readouterr().out
    assert "compared within 0.05 (extensions X86_V9 there, " in shown
    assert "physics replayed from the action log: equal" in shown


def test_a_score_that_nothing_is_compared_with_is_not_confirmed(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    score = finished / "score.json"
    content = json.loads(score.read_text())
    content["score"]["origin"]["packages"]["mujoco"] = "3.16.0"
    score.write_text(json.dumps(content))
    assert cli.main(["evaluate", "one", "--json", "again.json"]) == 1
    assert "one/score.json: not compared: made with another mujoco" in capsys.readouterr().out
    assert json.loads(Path("again.json").read_text())["comparison"]["agrees"] is None


@pytest.mark.usefixtures("finished")
def test_another_protocol_asks_for_a_new_score(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PROTOCOLS, "other", replace(PROTOCOLS["smoke"], name="other"))
    assert cli.main(["evaluate", "one", "--protocol", "other"]) == 0
    assert "not compared: made with another protocol (smoke, not other)" in capsys.readouterr().out


@pytest.mark.usefixtures("finished")
def test_view_writes_a_page_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", "one", "--html", "page.html"]) == 0
    page = Path("page.html").read_text()
    assert "rocket_navigation, twostage, seed 3, budget smoke" in page
    capsys.readouterr()
    assert cli.main(["view", "one", "--html", "page.html"]) == 2
    assert "page.html exists" in capsys.readouterr().err


@pytest.mark.usefixtures("finished")
def test_view_refuses_a_plan_that_does_not_fit(capsys: pytest.CaptureFixture[str]) -> None:
    plan = Plan.load("one/plan.npz")
    replace(plan, states=plan.states[:, :2]).save("narrow.npz")
    replace(plan, task_version=7).save("later.npz")
    assert cli.main(["view", "narrow.npz", "--html", "x.html"]) == 2
    assert "the plan has 2 states a step, not 3" in capsys.readouterr().err
    assert cli.main(["view", "later.npz", "--html", "x.html"]) == 2
    assert "for rocket_navigation version 7, not for" in capsys.readouterr().err


@pytest.mark.usefixtures("finished")
def test_a_table_in_json_is_written_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["evaluate", "one", "--json", "one/score.json"]) == 2
    line = "tsbench: one/score.json exists and nothing is overwritten\n"
    assert capsys.readouterr().err == line


def test_a_run_that_cannot_begin_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["run", "task=rocket_navigation", "budget=smoke", "directory=mine"]
    (tmp_path / "mine").mkdir()
    assert cli.main([*words, "method.imitation=foo"]) == 2
    assert "unknown imitation reward" in capsys.readouterr().err
    assert list((tmp_path / "mine").iterdir()) == []
    (tmp_path / "mine" / "movie.part").touch()
    assert cli.main([*words, "method.imitation=foo"]) == 2
    assert "mine holds other files" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["movie.part"]


@pytest.mark.parametrize("what", ["full", "nothing", "itself", "file"])
def test_a_run_begins_in_no_place_that_a_link_makes_unusable(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Files where the link leads stay as they are."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "itself").symlink_to("itself")
    (tmp_path / "mine").symlink_to(what)
    words = ["run", "task=rocket_navigation", "budget=smoke", "directory=mine"]
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("tsbench: mine")
    assert error.count("\n") == 1
    found = {path.name for path in tmp_path.rglob("*")}
    assert found == {"full", "thesis.tex", "file", "itself", "mine"}
    assert (tmp_path / "full" / "thesis.tex").read_text() == "mine"
    assert (tmp_path / "file").read_text() == "mine"


def test_a_run_begins_beside_links_without_following_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a run left before it began may be replaced, and not what a link in its place is to."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "elsewhere" / "versions.json").write_text("mine")
    (tmp_path / "mine" / "versions.json").symlink_to(tmp_path / "elsewhere" / "versions.json")
    (tmp_path / "mine" / "config.yaml").symlink_to(tmp_path / "elsewhere" / "config.yaml")
    words = ["run", "task=rocket_navigation", "budget=smoke", "directory=mine", "threads=1"]
    tiny = ["task.budgets.smoke.plan=96", "task.budgets.smoke.act=128"]
    assert cli.main([*words, *tiny, "task.constants.distance=6.0"]) == 0
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["versions.json"]
    assert (tmp_path / "elsewhere" / "versions.json").read_text() == "mine"
    assert not (tmp_path / "mine" / "config.yaml").is_symlink()


def test_a_run_in_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["run", "task=rocket_navigation", "budget=smoke", "threads=1", "directory=r"]
    tiny = ["task.budgets.smoke.act=512", "task.constants.distance=6.0"]
    assert cli.main([*words, "-m", "--json", "sweep.json", *tiny]) == 2
    assert "--json is for one run" in capsys.readouterr().err
    Path("there.json").touch()
    assert cli.main([*words, "--json", "there.json", *tiny]) == 2
    assert "there.json exists and nothing is overwritten" in capsys.readouterr().err
    assert not Path("r").exists()
    arguments = list(sys.argv)
    assert cli.main([*words, "--json=r.json", *tiny]) == 0
    assert sys.argv == arguments
    assert names(Path("r")) == EVERYTHING
    shown = plain(record.shown(RunDirectory(Path("r")).record()))
    assert json.loads(Path("r.json").read_text()) == shown


@pytest.mark.parametrize("content", [b"", b"rubbish", b"\x00" * 100, b"{}", b"[1]", b"{"])
@pytest.mark.parametrize(
    ("verb", "name"),
    [
        ("evaluate", "policy.json"),
        ("evaluate", "policy.safetensors"),
        ("evaluate", "config.yaml"),
        ("evaluate", "score.json"),
        ("view", "policy.json"),
        ("view", "reference.npz"),
        ("view", "score.json"),
    ],
)
@pytest.mark.usefixtures("finished")
def test_a_damaged_file_is_named(
    verb: str, name: str, content: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    (Path("one") / name).write_bytes(content)
    words = {"evaluate": ["--protocol", "smoke"], "view": ["--html", "page.html"]}
    if name == "score.json" and verb == "evaluate":
        words = {"evaluate": []}
    assert cli.main([verb, "one", *words[verb]]) == 2
    error = capsys.readouterr().err
    assert error.startswith("tsbench: ")
    assert f"one/{name}" in error
    assert error.count("\n") == 1
    assert not Path("page.html").exists()


def test_truncated_recordings_are_named(finished: Path) -> None:
    for kind, name in ((Plan, "plan.npz"), (ReferenceMotion, "reference.npz")):
        path = finished / name
        path.write_bytes(path.read_bytes()[:-200])
        with pytest.raises(TsbenchError, match=f"one/{name}"):
            kind.load(path)


def test_a_policy_is_refused_where_it_does_not_belong(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info = json.loads((finished / "policy.json").read_text())
    info["task"] = "laikago_trot"
    (finished / "policy.json").write_text(json.dumps(info))
    assert cli.main(["evaluate", "one"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@contextmanager
def no_file_beyond(size: int) -> Iterator[None]:
    """Has the system refuse every write with which a file would have more bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [600, 30_000, 300_000])
def test_a_full_disk_stops_a_run_in_one_line(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """At some point of the run."""
    monkeypatch.chdir(tmp_path)
    with no_file_beyond(size):
        assert cli.main(["run", *WORDS, "directory=mine"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("tsbench: ")
    assert "mine" in error
    assert "File too large" in error
    assert error.count("\n") == 1
    run = RunDirectory(tmp_path / "mine")
    assert run.finished == (size == 300_000)  # with this size only the pages are too large
    if run.finished:
        assert error.endswith("its pages are not: tsbench report mine\n")
        assert not run.report_file.exists()


def test_a_reader_that_leaves_ends_a_run_with_a_hint(tmp_path: Path) -> None:
    """As in `tsbench run ... | head -1`."""
    directory = tmp_path / "mine"

    class Left(io.StringIO):
        def write(self, text: str) -> int:
            if RunDirectory(directory).trained:
                raise BrokenPipeError
            return super().write(text)

    chosen = replace(config.compose(WORDS), directory=str(directory))
    with pytest.raises(TsbenchError) as error:
        run.execute(chosen, WORDS, Output(file=Left()))
    hint = f"{directory}: Broken pipe; to go on: tsbench run resume={directory}"
    assert str(error.value) == hint


def test_a_run_that_cannot_begin_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise TsbenchError("this method cannot do this task")

    monkeypatch.setattr("tsbench.methods.twostage.train", refuse)
    with pytest.raises(TsbenchError, match="cannot do this task"):
        execute(tmp_path / "mine")
    assert not (tmp_path / "mine").exists()


def test_each_part_of_a_run_is_told_before_its_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a reader waits for stands in the output, also in a file: the run's directory before the
    first step of training, each stage while it goes on, the evaluation before its first episode."""
    out, seen = io.StringIO(), dict[str, str]()

    def spied(module: str, name: str) -> None:
        function = getattr(importlib.import_module(module), name)

        def spy(*given: Any, **named: Any) -> Any:
            seen.setdefault(name, out.getvalue())
            return function(*given, **named)

        monkeypatch.setattr(f"{module}.{name}", spy)

    spied("tsbench.methods.twostage", "train")
    spied("tsbench.runs.execute", "evaluate")
    words = [*WORDS, "threads=1", "task.budgets.smoke.act=512", "task.constants.distance=6.0"]
    chosen = replace(config.compose(words), directory=str(tmp_path / "mine"))
    run.execute(chosen, words, Console(file=out, width=200))
    first = f" -> {tmp_path / 'mine'}\n"
    assert seen["train"].startswith("tsbench run ")
    assert seen["train"].endswith(first)
    lines = seen["evaluate"].partition(first)[2].splitlines()
    assert [line for line in lines if re.match(r"(plan|imitate) +\d+%", line)]
    assert lines[-1] == "evaluation by protocol smoke"


def test_a_run_that_fails_later_keeps_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ActionLog, "save", fail)
    with pytest.raises(TsbenchError, match=r"mine: No space left on device"):
        execute(tmp_path / "mine")
    assert (tmp_path / "mine" / "policy.safetensors").exists()
    assert not (tmp_path / "mine" / "score.json").exists()


def test_a_plan_that_fails_its_audit_ends_the_run(tmp_path: Path) -> None:
    """It is no fault that resuming could mend, so the message does not offer that."""
    with pytest.raises(PlanError, match=r"fails its audit: .*; the plan is in .*mine") as caught:
        execute(tmp_path / "mine", [*WORDS, "method.audit=stop"])
    assert "resume" not in str(caught.value)
    with pytest.raises(PlanError, match=r"mine cannot go on: the plan fails its audit"):
        run.resume(tmp_path / "mine")
    with pytest.raises(
        TsbenchError, match=r"mine holds a run whose plan has failed .* choose anoth"
    ):
        execute(tmp_path / "mine")
    assert (tmp_path / "mine" / "plan.npz").exists()
    assert not (tmp_path / "mine" / "policy.safetensors").exists()


def test_a_plan_alone_is_not_removed(tmp_path: Path, naive_plan: Callable[[str], Plan]) -> None:
    """A roadmap's plan may fail its audit before anything is learned; the error names its place."""
    place = RunDirectory(tmp_path)
    assert not place.trained
    naive_plan("rocket_navigation").save(place.plan_file)
    assert place.trained


# A goal so near that an episode takes 1.5 s.
SHORT = [
    *WORDS[:3],
    "task.budgets.smoke.act=512",
    "task.training.imitate.epochs=1",
    "task.constants.distance=6.0",
]


PAGES = {"learning_curves.png", "view.html", "report.html"}


@pytest.mark.parametrize(
    ("words", "page"),
    [(["report", "one"], "view.html"), (["run", "resume=one"], "report.html")],
)
def test_pages_that_a_finished_run_lacks_are_made(
    words: list[str], page: str, finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They are made from the run's directory alone, and existing pages stay."""
    before = {name: (finished / name).read_bytes() for name in PAGES}
    for name in PAGES - {page}:
        (finished / name).unlink()
    (finished / page).write_text("mine")
    assert cli.main(words) == 0
    assert names(finished) == EVERYTHING
    after = {name: (finished / name).read_bytes() for name in PAGES}
    assert after == before | {page: b"mine"}
    capsys.readouterr()
    assert cli.main(words) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_run_whose_pages_fail_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def interrupt(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as broken:
        broken.setattr("tsbench.viewer.report.write_pages", interrupt)
        assert cli.main(["run", *SHORT, "directory=one"]) == 143
    line = "tsbench: interrupted; the run is finished, its pages are not: tsbench report one\n"
    assert capsys.readouterr().err == line
    assert names(Path("one")) == EVERYTHING - PAGES
    assert cli.main(["evaluate", "one"]) == 0
    assert cli.main(["report", "one"]) == 0
    assert names(Path("one")) == EVERYTHING


def test_changed_constants_are_recorded(tmp_path: Path) -> None:
    words = [*WORDS, "task.constants.distance=20.0", "method=monolithic"]
    execute(tmp_path / "near", words)
    content = RunDirectory(tmp_path / "near").record()
    assert content.standard is False
    assert [stage.name for stage in content.stages] == ["train"]
    policy = RunDirectory(tmp_path / "near").policy()
    task = RunDirectory(tmp_path / "near").task(policy.info.task)
    assert task == tasks.make("rocket_navigation", distance=20.0)
    assert policy.info.method == "monolithic"


def test_a_sweep_goes_on_after_failures_and_lists_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One directory is taken and one run meets a bug. After the bug is fixed, the sweep does only
    that run."""
    monkeypatch.chdir(tmp_path)
    words = ["run", "-m", *SHORT, "seed=0,1,2"]
    places = [
        launch.directory(config.compose([*SHORT, f"seed={seed}"]), SHORT) for seed in (0, 1, 2)
    ]
    places[0].mkdir(parents=True)
    (places[0] / "notes.txt").write_text("precious")

    save = ActionLog.save

    def fail(self: ActionLog, path: Path) -> None:
        if path.parent == places[1]:
            raise ZeroDivisionError("a bug")
        save(self, path)

    with monkeypatch.context() as broken:
        broken.setattr(ActionLog, "save", fail)
        assert cli.main(words) == 2
    first, second, last = capsys.readouterr().err.splitlines()
    assert first.startswith("tsbench: failed: task=rocket_navigation")
    assert "nothing is overwritten" in first
    assert "seed=1: ZeroDivisionError('a bug')" in second
    assert second.endswith(f"(log: {places[1] / 'log.txt'})")
    assert "ZeroDivisionError: a bug" in (places[1] / "log.txt").read_text()
    assert last == "tsbench: 2 of the sweep's runs failed (see above)"
    assert RunDirectory(places[2]).record().seed == 2

    (places[0] / "notes.txt").unlink()
    (places[2] / "view.html").unlink()
    before = (places[2] / "score.json").stat().st_mtime_ns
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    assert f"finished already: {places[2]}" in out
    assert "resumed: imitate goes on at " in (places[1] / "log.txt").read_text()
    assert (places[2] / "score.json").stat().st_mtime_ns == before
    assert [RunDirectory(place).record().seed for place in places] == [0, 1, 2]
    assert [names(place) for place in places] == 3 * [EVERYTHING]


def test_a_sweep_does_not_take_another_run_for_its_own(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (finished / "score.json").read_bytes()
    assert cli.main(["run", "-m", *WORDS[:3], "seed=4", "directory=one"]) == 2
    assert "one holds a run with another configuration" in capsys.readouterr().err
    assert (finished / "score.json").read_bytes() == before


def test_the_standard_directory() -> None:
    chosen = config.compose(WORDS)
    assert launch.directory(chosen, ["task=rocket_navigation", "seed=3", "budget=smoke"]) == Path(
        "runs/rocket_navigation/twostage/seed3-smoke"
    )
    words = ["++task.training.plan.hidden=[64, 64]", "method.finetune=0.2", "threads=1"]
    name = launch.directory(chosen, words).name
    assert name.startswith("seed3-smoke,finetune=0.2,hidden=_64,_64_-")
    assert launch.directory(chosen, words[::-1]).name == name
    assert launch.directory(chosen, [words[0], "method.finetune=0.3"]).name != name
    assert len(launch.directory(chosen, 20 * words).name) < 64


def test_a_stage_on_a_terminal_and_elsewhere(tmp_path: Path) -> None:
    shown = {}
    for terminal in (True, False):
        with (tmp_path / "out").open("w+") as file:
            workspace = RunWorkspace(tmp_path, Console(file=file, force_terminal=terminal))
            with workspace.stage("plan", 100) as monitor:
                for steps in range(10, 101, 10):
                    monitor.update(steps, {"episode_return": 2.5, "value_loss": math.nan})
            workspace.close()
            file.seek(0)
            shown[terminal] = file.read()
    assert "━" in shown[True]
    assert "\x1b" not in shown[False]
    assert "plan        50%  reward 2.5, " in shown[False]
    for text in shown.values():
        assert "plan: 100 steps in 0:00, reward 2.5, " in text
    row = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[0])
    assert row.keys() == {"stage", "steps", "seconds", "episode_return"}


def test_mujocos_warnings_are_told(tmp_path: Path) -> None:
    workspace = RunWorkspace(tmp_path, Console(file=(tmp_path / "out").open("w")))
    with workspace.stage("imitate", 10) as monitor:
        monitor.warnings = {"mjWARN_BADQACC": 1234}
        monitor.update(10, {})
    workspace.close()
    assert workspace.stages[0].warnings == {"mjWARN_BADQACC": 1234}
    log = (tmp_path / "log.txt").read_text()
    assert "imitate: mujoco warned 1,234 times of mjWARN_BADQACC" in log


def test_numbers_as_people_read_them() -> None:
    assert words.duration(59.6) == "1:00"
    assert words.duration(3725.0) == "1:02:05"
    assert words.number(None) == words.number(math.inf) == "-"
    assert words.number(0.123456) == "0.1235"
    assert words.number(12) == "12"


def test_stages_are_plain_values() -> None:
    assert set(asdict(Stage("plan", 1))) == {
        "name",
        "budget",
        "steps",
        "physics_substeps",
        "seconds",
        "interruptions",
        "warnings",
    }
