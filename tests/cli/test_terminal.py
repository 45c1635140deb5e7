"""Commands where the terminal is closed, narrow or strict, and where words are not the right ones.

Each kind of trouble has the case that was met first, and further ones of its kind.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from tsbench import cli, methods, tasks
from tsbench.cli import command, describe, doctor, hints, places, streams, tables, usage
from tsbench.cli.launch import directory
from tsbench.cli.verbs import run, tune
from tsbench.core.errors import TsbenchError
from tsbench.core.words import number, short
from tsbench.leaderboard import kept, page
from tsbench.leaderboard.submission import read_manifest
from tsbench.runs import config
from tsbench.runs.directory import Record, RunDirectory
from tsbench.runs.execute import _way_on
from tsbench.runs.results import _words

TASK = "task=rocket_navigation"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))


def shell(line: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """What a shell line does in which `tsbench` stands for the command."""
    command = f"{shlex.quote(sys.executable)} -m tsbench"
    return subprocess.run(
        ["sh", "-c", line.replace("tsbench", command, 1)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )


# Closed streams


def test_closed_output() -> None:
    done = shell("tsbench --help >&-")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_closed_error_stream_keeps_the_status() -> None:
    done = shell("tsbench veiw 2>&-")
    assert (done.returncode, done.stderr) == (2, "")


def test_a_file_does_not_get_the_number_of_a_closed_stream(tmp_path: Path) -> None:
    """The first file that a command opens would get number 0, 1 or 2, and the tables with it."""
    done = shell("tsbench list --json names.json <&- >&- 2>&-")
    assert done.returncode == 0
    assert tuple(json.loads((tmp_path / "names.json").read_text())["tasks"]) == tasks.names()


# Warnings, graphics, the way of starting


@pytest.mark.parametrize("words", ["--help", "list", f"run {TASK} --cfg job"])
def test_warnings_made_errors(words: str) -> None:
    done = shell(f"tsbench {words}", PYTHONWARNINGS="error")
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "status"), [("list", 0), ("evaluate nowhere", 2), ("describe rocket_navigation", 0)]
)
def test_no_opengl_is_needed_to_draw_nothing(words: str, status: int) -> None:
    """As with MUJOCO_GL=osmesa on a machine without the library."""
    done = shell(f"tsbench {words}", MUJOCO_GL="crayons")
    assert done.returncode == status, done.stderr
    assert "GL" not in done.stderr


def test_python_runs_the_package_anywhere() -> None:
    assert shell("tsbench").stdout.startswith("usage: tsbench COMMAND")
    assert shell("tsbench veiw").stderr.startswith("tsbench: unknown command 'veiw'")
    assert shell("tsbench list --hlp").stderr.startswith("tsbench: unrecognized arguments: --hlp")


# Paths


def test_home_in_paths(tmp_path: Path) -> None:
    assert places.path("~/x.html") == tmp_path / "x.html"
    assert places.path("a~/x") == Path("a~/x")
    assert places.path("~nobody-of-that-name/x") == Path("~nobody-of-that-name/x")
    words = hints.expanded(["directory=~/mine", "seed=1", "resume=~", "task.constants.x=~/y"])
    assert words == [f"directory={tmp_path}/mine", "seed=1", f"resume={tmp_path}",
                     "task.constants.x=~/y"]  # fmt: skip


def test_home_in_an_option(tmp_path: Path) -> None:
    assert cli.main(["list", "--json=~/names.json"]) == 0
    assert (tmp_path / "names.json").exists()


@pytest.mark.parametrize("name", ["policy.safetensors", "policy.json", "score.json"])
def test_a_file_of_a_run_stands_for_the_run(name: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    for one in ("policy.json", name, "plan.npz"):
        (run / one).touch()
    assert places.run(f"run/{name}") == Path("run")
    assert places.run("run/plan.npz") == Path("run/plan.npz")  # a plan is shown alone


# Hints


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["rocket_navigation"], "(did you mean task=rocket_navigation?)"),
        ([TASK, "two_stage"], "(did you mean method=twostage?)"),
        ([TASK, "Monolithic"], "(did you mean method=monolithic?)"),
        ([TASK, "--seed", "3"], "(did you mean seed=3?)"),
        ([TASK, "--seed=3"], "(did you mean seed=3?)"),
        ([TASK, "--bugdet", "smoke"], "(did you mean budget=smoke?)"),
        ([TASK, "--thread"], "(did you mean threads=...?)"),
        (["mine"], "(did you mean resume=mine?)"),
        ([TASK, "task=laikago_trot"], f"task is given twice: {TASK} and task=laikago_trot"),
        ([TASK, "seed=1", "seed=1"], "seed is given twice: seed=1 and seed=1"),
        (["-m", TASK, "seed=1,2", "seed=3"], "seed is given twice: seed=1,2 and seed=3"),
    ],
)
def test_words_of_run(
    words: list[str], hint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "config.yaml").touch()
    assert cli.main(["run", *words]) == 2
    captured = capsys.readouterr()
    assert hint in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        ([TASK], f"(did you mean 'tsbench run {TASK}'?)"),
        (["list", "--jsn", "x"], "(did you mean --json?)"),
        (["evaluate", "laikago_trot/twostag"], "the kept entry laikago_trot/twostage?)"),
        (["verify", "laikago_trot/twostag"], "the kept entry laikago_trot/twostage?)"),
        (["compare", "laikago_trt/prm"], "the kept entry laikago_trot/prm?)"),
        (["export", "laikago_trot/pr", "x"], "the kept entry laikago_trot/prm?)"),
        (["export", "one", "x"], "no model one: there is no such file or directory"),
        (["view", "laikago_trot"], "(did you mean the kept entry laikago_trot/"),
        (["report", "laikago_trt"], "(did you mean the kept entry laikago_trot/"),
        (["evaluate", "one", TASK], "no policy one; without a file there are random and zero"),
        (["evaluate", "x.zip", TASK, "--trust-sb3", "ppo"], "(did you mean 'PPO'?)"),
        (["describe", "Rocket_Navigation"], "(did you mean 'rocket_navigation'?)"),
        (["describe", "twostgae"], "(did you mean 'twostage'?)"),
    ],
)  # fmt: skip
def test_words_of_other_commands(
    words: list[str], hint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.zip").touch()
    assert cli.main(words) == 2
    assert hint in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["evaluate", "one", "--protocol", "smoke", TASK], "no policy one; without a file there"),
        (["export", "one", TASK, "--method", "x", "out"], "no model one: there is no such file"),
        (["verify", "one", "--threads", "1", "two"], "no entry one"),
        (["compare", "--json", "x", "one", "--png", "y.png", "two"], "there is no directory one"),
        (["evaluate", "--threads", "1", "--", "one", TASK], "no policy one; without a file there"),
    ],
)
def test_options_stand_between_positional_words(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    assert line in capsys.readouterr().err


@pytest.mark.parametrize("name", ["plain", "my run", "it's $HOME; *"])
def test_commands_in_messages_can_be_pasted(name: str, tmp_path: Path) -> None:
    run = RunDirectory(tmp_path / name)
    run.path.mkdir()
    run.plan_file.touch()
    command = _way_on(run).removeprefix("; to go on: ")
    assert shlex.split(command) == ["tsbench", "run", f"resume={run.path}"]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("'method.x=[6, 4]' seed=1", ["method.x=[6, 4]", "seed=1"]),
        ("seed=range(0,3) a=1", ["seed=range(0,3)", "a=1"]),
        ("directory=it's here", ["directory=it's", "here"]),  # as older runs have it
    ],
)  # fmt: skip
def test_recorded_commands_are_read_back(line: str, words: list[str]) -> None:
    assert _words(line) == words


# Widths


def shown(show: Callable[[Console], object], width: int) -> str:
    console = Console(width=width, force_terminal=False)
    with console.capture() as captured:
        show(console)
    return captured.get()


def check_width(text: str, width: int) -> None:
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text


@pytest.mark.parametrize("width", [40, 60, 80])
def test_list_cuts_no_name(
    width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    assert cli.main(["list"]) == 0
    text = capsys.readouterr().out
    check_width(text, width)
    for name in (*tasks.names(), *methods.names()):
        assert name in text


@pytest.mark.parametrize("width", [40, 80])
@pytest.mark.parametrize("name", tasks.names())
def test_cards_cut_no_name(name: str, width: int) -> None:
    found: dict[str, object] = {}
    text = shown(lambda console: found.update(describe.show(console, name)), width)
    lines = [line for line in text.splitlines() if not line.startswith("Try it")]
    check_width("\n".join(lines), width)
    constants = found["constants"]
    assert isinstance(constants, list)
    assert all(one["name"] in text for one in constants)
    assert f"{tasks.make(name).observation_size} numbers" in text


def test_a_card_has_two_names(capsys: pytest.CaptureFixture[str]) -> None:
    """`list` says what there is, so a newcomer asks it about a task too."""
    cards = []
    for verb in ("list", "describe"):
        assert cli.main([verb, "rocket_navigation"]) == 0
        cards.append(capsys.readouterr().out)
    assert cards[0] == cards[1] != ""


@pytest.mark.parametrize("name", methods.names())
def test_a_method_has_a_card(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["describe", f"method={name}", "--json", "card.json"]) == 0
    text = capsys.readouterr().out
    card = json.loads(Path("card.json").read_text())
    options = dict(config.compose([TASK, f"method={name}"]).method)
    assert options.pop("name") == card["method"] == name
    assert [one["name"] for one in card["options"]] == [f"method.{key}" for key in options]
    assert all(one["name"] in text and one["meaning"] for one in card["options"])
    for entry in card["kept"]:
        assert read_manifest(kept.entries()[entry]).method == name


@pytest.mark.parametrize("width", [40, 80])
def test_scores_cut_no_name(width: int, invented_record: Callable[[str], Record]) -> None:
    record = invented_record("laikago_trot")
    task = tasks.make("laikago_trot")
    text = shown(lambda console: tables.show_run(console, record, task), width)
    check_width(text, width)
    assert "SOLVED 40 of 100" in text
    for words in ("solved_reward", "normalized_reward", "oracle, the best plan", "policy zero"):
        assert words in text


@pytest.mark.parametrize("width", [40, 72, 100])
@pytest.mark.parametrize("text", [run.HELP, tune.HELP, command._help()])
def test_help_follows_the_width(text: str, width: int) -> None:
    fitted = usage.fitted(text, width)
    examples = [line for line in text.splitlines() if line.startswith("  tsbench ")]
    lines = [line for line in fitted.splitlines() if line not in examples]
    assert max(map(len, lines)) <= width
    assert fitted.split() == text.split()  # no word is lost


@pytest.mark.parametrize(
    ("steps", "text"),
    [(0, "0"), (999, "999"), (999.7, "1k"), (5_016, "5.02k"), (999_936, "1M"), (9.27e6, "9.27M"),
     (2e9, "2G")],
)  # fmt: skip
def test_counts_of_steps_in_three_digits(steps: float, text: str) -> None:
    assert short(steps) == text


def test_wide_help_is_the_text_itself() -> None:
    assert usage.fitted(run.HELP, 200) == run.HELP


# Kept entries


def test_kept_entries_have_short_names() -> None:
    entries = kept.entries()
    assert {name.partition("/")[0] for name in entries} == set(tasks.names())
    for name, entry in entries.items():
        first, *_ = kept.trainings(entry)
        assert places.entry(name) == entry
        for word in (name, f"v1/{name}", f"{name}/{first.name}", str(entry), str(first)):
            assert places.run(word) == first, word
            assert RunDirectory(first).policy().info.task == entry.parent.name


@pytest.mark.parametrize("name", ["seeded_prm", "seed7", "prm"])
def test_the_name_of_a_kept_entry_may_begin_with_seed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "FOLDERS", (tmp_path,))
    entry = tmp_path / "v1" / "laikago_trot" / name
    (entry / "seed3").mkdir(parents=True)
    assert kept.find(f"laikago_trot/{name}") is None  # runs that are no entry yet
    (entry / "manifest.json").touch()
    assert kept.find(f"laikago_trot/{name}") == entry
    assert kept.find(f"laikago_trot/{name}/seed3") == entry / "seed3"
    assert kept.find(f"laikago_trot/{name}/seed4") is None


def test_a_score_is_compared_with_the_figures_of_the_board() -> None:
    board = next(folder for folder in kept.FOLDERS if folder.is_dir())
    for table in page.tables(board)[0]:
        rows = {label.split()[1]: figures for label, *figures in
                tables.kept_rows(tasks.make(table.task))}  # fmt: skip
        assert rows == {
            f"{table.task}/{row.name}": [number(row.reward.iqm), number(row.figures["success"])]
            for row in table.rows
        }


def test_what_exists_here_comes_before_a_kept_entry(tmp_path: Path) -> None:
    name = next(iter(kept.entries()))
    (tmp_path / name).mkdir(parents=True)
    assert places.run(name) == Path(name)
    assert places.entry(name) == Path(name)


def test_missing_trainings_and_entries_are_left_as_they_are() -> None:
    name = next(iter(kept.entries()))
    assert kept.find(f"{name}/seed999") is None
    assert places.run("nowhere") == Path("nowhere")
    with pytest.raises(TsbenchError, match=re.escape(f"did you mean the kept entry {name}?")):
        places.run(f"{name}x")


def test_the_board_of_the_kept_entries_is_shown_anywhere(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """It is only read: a file is written to a board that is here or that is named."""
    (tmp_path / "leaderboards").mkdir()  # with no entry in it: not a board
    assert cli.main(["leaderboard"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("## ")
    (tmp_path / "leaderboards").rmdir()
    for name in kept.entries():
        task, _, entry = name.partition("/")
        assert re.search(rf"^## {task}$(?:(?!^## ).)*^\| {entry} \|", text, re.M | re.S)
    for words in (["leaderboard", "--readme"], ["verify", "--all", "--record"]):
        assert cli.main(words) == 2
        assert "no board leaderboards: --board names its directory" in capsys.readouterr().err
    assert cli.main(["leaderboard", "--board", "nowhere"]) == 2
    assert "no board nowhere" in capsys.readouterr().err
    assert not list(tmp_path.glob("[!.]*"))


# Directories of runs


def test_short_names_of_run_directories() -> None:
    def name(*words: str) -> str:
        return directory(config.compose([TASK, *words]), [TASK, *words]).name

    assert name("seed=3") == "seed3-fast"
    one = name("task.training.plan.clip=0.3")
    assert re.fullmatch(r"seed0-fast,clip=0\.3-[0-9a-f]{8}", one)
    many = [f"task.training.{kind}.clip=0.{n}" for n, kind in enumerate(("plan", "imitate"), 1)]
    many += ["task.training.imitate.disturb={interval: 1.0, duration: 0.1, push: 50.0}"]
    assert len(name(*many)) <= 60
    assert name(*many) == name(*reversed(many))
    assert name(*many) != name(*many[:-1], many[-1].replace("50.0", "51.0"))
    assert name("task.training.plan.clip=0.3") != name("task.training.imitate.clip=0.3")


@pytest.mark.parametrize("verb", ["evaluate", "view", "report", "export", "submit"])
@pytest.mark.parametrize("failed", [False, True])
def test_a_run_without_a_policy_says_how_to_go_on(
    verb: str, failed: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RunDirectory(Path("one"))
    run.path.mkdir()
    run.config_file.write_text("# tsbench run task=rocket_navigation\n")
    if failed:
        run.failure_file.write_text("the plan fails its audit\n")
    more = {
        "export": ["out"],
        "submit": ["--name", "mine", "--author", "A", "--licence", "MIT"],
    }
    assert cli.main([verb, "one", *more.get(verb, [])]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    said = "not finished: tsbench run resume=one"
    assert ("the run in one has failed: the plan fails" if failed else said) in line


# The doctor


def test_the_doctor_says_what_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_gpu", lambda: "none")
    monkeypatch.setattr("tsbench.gl.find_working_backend", lambda: None)
    assert cli.main(["doctor", "--json", "found.json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 12
    found = json.loads(Path("found.json").read_text())
    assert found.pop("refused") == []
    assert len(found) == len(lines)
    assert {"tsbench", "packages", "threads", "OpenGL", "GPU", "tasks"} <= found.keys()
    extras = " ".join(text for subject, text in found.items() if subject.startswith("extras"))
    assert all(name in extras for name in ("gpu", "onnx", "sb3", "tune", "video"))


def test_the_doctor_names_every_plug_in_that_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_gpu", lambda: "none")
    monkeypatch.setattr("tsbench.gl.find_working_backend", lambda: None)
    monkeypatch.setattr(tasks, "refused", lambda: ("both broken", "no task"))
    monkeypatch.setattr(methods, "refused", lambda: ("both broken", "no method"))
    assert cli.main(["doctor", "--json", "found.json"]) == 0
    assert capsys.readouterr().out.count("both broken") == 1
    found = json.loads(Path("found.json").read_text())
    assert found["refused"] == ["both broken", "no task", "no method"]


def test_the_doctor_finds_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise TsbenchError("no OpenGL draws pictures here")

    monkeypatch.setattr("tsbench.gl.find_working_backend", refuse)
    monkeypatch.setattr(doctor, "_version", lambda name: doctor.MISSING)
    monkeypatch.setattr(doctor, "GPU", "import nothing_of_that_name")
    found = dict(doctor.findings())
    assert found["OpenGL"] == "no OpenGL draws pictures here; all else works without"
    assert "nothing_of_that_name" in found["GPU"]
    assert "pip install 'tsbench[" in found["extras missing"]


# What loads


def loaded(program: str) -> set[str]:
    program += "\nimport sys; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize(
    ("words", "unneeded"),
    [
        ("--help", {"numpy", "rich", "yaml", "mujoco", "importlib.metadata"}),
        ("list", {"torch", "hydra", "omegaconf", "mink", "scipy.interpolate", "OpenGL"}),
        ("run task=rocket_navigatoin", {"torch", "mink", "matplotlib", "tensorboard"}),
        ("evaluate nowhere", {"torch", "hydra", "matplotlib", "mink", "OpenGL"}),
    ],
)  # fmt: skip
def test_commands_load_only_what_they_use(words: str, unneeded: set[str]) -> None:
    """That makes them start fast, and a count of modules is the same on every machine."""
    program = f"from tsbench import cli; cli.main({words.split()!r})"
    assert not unneeded & loaded(program)


def test_loading_is_said_on_a_terminal_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with streams.loading():
        pass
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with streams.loading():
        assert capsys.readouterr().err == "loading ..."
    assert capsys.readouterr().err.endswith("\r")
