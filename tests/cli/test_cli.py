"""The command line: verbs, help, exit statuses, and an error of one line for every mistake."""

from __future__ import annotations

import json
import pkgutil
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from tsbench import cli, methods, tasks
from tsbench.cli import verbs
from tsbench.core.errors import TsbenchError
from tsbench.leaderboard import kept
from tsbench.runs.directory import RunDirectory

TASK = "task=rocket_navigation"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command runs in an empty directory, so that what it writes can be seen."""
    monkeypatch.chdir(tmp_path)


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The line of the error with which a command is refused."""
    assert cli.main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("tsbench: ")
    assert captured.err.count("\n") == 1
    return captured.err.removeprefix("tsbench: ").rstrip("\n")


def test_each_verb_is_a_module_of_its_name() -> None:
    assert {module.name for module in pkgutil.iter_modules(verbs.__path__)} == set(verbs.VERBS)


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"]])
def test_help_names_every_command(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    for verb in verbs.VERBS:
        assert f"\n  {verb} " in out


def test_help_of_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in verbs.VERBS:
        try:
            status = cli.main([verb, "--help"])
        except SystemExit as exit_:  # argparse's way
            status = int(exit_.code or 0)
        assert status == 0
        assert f"usage: tsbench {verb}" in capsys.readouterr().out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("tsbench 0.")


def test_list_is_the_same_in_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list", "--json", "names.json"]) == 0
    shown = capsys.readouterr().out
    content = json.loads((tmp_path / "names.json").read_text())
    assert tuple(content["tasks"]) == tasks.names()
    assert tuple(content["methods"]) == methods.names()
    for name, row in content["tasks"].items():
        assert name in shown
        assert set(row) == {"version", "steps", "seconds", "budgets"}
    for name, summary in content["methods"].items():
        assert name in shown
        assert summary


def test_list_shows_tasks_without_a_configuration(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A new task may lack its configuration file while its author writes it."""
    assert tasks.names()  # registers all, so that they are still there after this test
    monkeypatch.setattr(tasks, "_factories", dict(tasks._factories))

    @tasks.register("stroll")
    def stroll() -> Any:
        return tasks.make(tasks.names()[0])

    assert cli.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    row = next(line for line in lines if "stroll" in line)
    assert row.count("-") == 3
    lack = "the task 'stroll' cannot be run: its package lacks conf/task/stroll.yaml"
    assert f"Incomplete: {lack}" in lines


def test_list_is_quick_because_it_leaves_learning_alone() -> None:
    program = (
        "import sys; from tsbench import cli; cli.main(['list']); print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "False"


def test_unknown_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert "(did you mean 'view'?)" in refusal(capsys, "veiw")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["list", "more"], "unknown task or method 'more'"),
        (["list", "one", "two"], "unrecognized arguments: two (see tsbench list --help)"),
        (["list", "--jsn", "x"], "unrecognized arguments: --jsn (did you mean --json?)"),
        (["list", "--json", "/proc/none/x"], "/proc/none/x: No such file or directory"),
        (["list", "--json", "/dev/full"], "/dev/full exists and nothing is overwritten"),
        (["evaluate"], "the following arguments are required: POLICY_OR_RUN"),
        (["evaluate", "nowhere"], "no run directory nowhere"),
        (["evaluate", "."], "no policy file policy.json"),
        (["evaluate", ".", "--threads", "0"], "--threads: must be a whole number from 1 to 1024"),
        (["evaluate", ".", "--protocol", "v9"], "no policy file policy.json"),
        (["view"], "one of RUN|PLAN|task=NAME and --compare RUN RUN is needed"),
        (["view", "x", "--compare", "a", "b"], "one of RUN|PLAN|task=NAME and --compare RUN RUN"),
        (["view", "nowhere"], "no run directory nowhere"),
        (["view", "nowhere", "--html", "x.html"], "no run directory nowhere"),
        (["view", "task=rocket_navigatoin"], "(did you mean 'rocket_navigation'?)"),
        (["view", TASK, "--push", "100N"], "cannot read the push '100N'"),
        (["view", TASK, "--push", "9N@1s:+x"], "a plan cannot be pushed"),
        (["view", TASK, "--port", "70000"], "must be a whole number from 0 to 65535"),
        (["view", "/dev/null"], "/dev/null is not a regular file"),
        (["view", TASK, "--html", "/proc/none/x"], "/proc/none/x: No such file"),
        (["view", TASK, "--html", "x", "--strip", "/proc/none/x"], "/proc/none/x: No such file"),
        (["view", TASK, "--html", "x.png"], "x.png must end in .html"),
        (["view", TASK, "--html", "x.html", "--video", "x.html"], "x.html must end in .mp4"),
        (["view", TASK, "--html", "x.html", "--strip", "x.mp4"], "x.mp4 must end in .png"),
        (["view", "--compare", "a", "b"], "no run directory a"),
        (["report", "nowhere"], "no run directory nowhere"),
        (["report", "."], ". has no score.json: only a finished run has a report"),
        (["run"], "task=NAME is missing"),
        (["run", TASK, "--cfgg"], "unrecognized arguments: --cfgg (see tsbench run --help)"),
        (["run", TASK, "--cfg", "jobb"], "argument --cfg/-c: invalid choice: 'jobb'"),
        (["run", "task=rocket_navigatoin"], "(did you mean 'rocket_navigation'?)"),
        (["run", TASK, "method=towstage"], "(did you mean 'twostage'?)"),
        (["run", TASK, "sed=1"], "(did you mean 'seed'?)"),
        (["run", TASK, "seed=x"], "seed must be a whole number, not 'x'"),
        (["run", TASK, "seed=-1"], "seed must lie between 0 and 4294967295, not -1"),
        (["run", TASK, "budget=fats"], "(did you mean 'fast'?)"),
        (["run", TASK, "method.finetune=x"], "method.finetune must be a number, not 'x'"),
        (["run", TASK, "method.finetune=1.0"], "method.finetune must lie in [0, 1), not 1.0"),
        (["run", TASK, "task.name=laikago_walk"], "task.name comes with task=NAME"),
        (["run", TASK, "method.name=monolithic"], "method.name comes with method=NAME"),
        (
            ["run", TASK, "-m", "seed=0,1", "directory=d"],
            "directory=d would be the place of several",
        ),
        (
            ["run", TASK, "task.training.imitate.disturb.push=-1"],
            "task.training.imitate.disturb.push must not be negative",
        ),
        (
            ["run", TASK, "task.training.imitate.disturb={interval: 1e-9, duration: 1e-9}"],
            "task.training.imitate.disturb.interval must be at least a control step of 0.02 s",
        ),
        (["verify", "--all", "--quick", "--retrain"], "--quick makes no score again"),
        (["verify", "--all", "--quick", "--seed-file", "x"], "--quick makes no score again"),
        (["evaluate", ".", "--trust-sb3", "PPO"], "--trust-sb3 is for a stable-baselines3 .zip"),
        (["run", TASK, "task.constants.distanse=1"], "(did you mean 'distance'?)"),
        (["run", TASK, "task.training.plan.cilp=1"], "(did you mean 'clip'?)"),
        (["run", TASK, "task.training.pln.clip=1"], "task.training 'pln'; allowed: finetune,"),
        (["run", TASK, "task.training.imitat.clip=1"], "(did you mean 'imitate'?)"),
        (["run", "-m", TASK, "seed=1,-2"], "seed must lie between 0 and 4294967295, not -2"),
        (["run", TASK, "hydra/launcher=rocket"], "unknown hydra/launcher 'rocket'"),
        (["run", TASK, "hydra/launcher=ray"], "is missing: pip install 'tsbench[ray]'"),
        (["run", TASK, "directory=/etc/passwd"], "/etc/passwd: File exists"),
        (["run", TASK, "directory=/etc/passwd/x"], "/etc/passwd/x: Not a directory"),
        (["run", TASK, "directory=/proc/none"], "/proc/none: "),
    ],
)
def test_a_mistake_gets_one_line_and_leaves_nothing(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert line in refusal(capsys, *words)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_run_directory_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("precious")
    line = refusal(capsys, "run", TASK, "directory=mine")
    assert "mine holds other files and nothing is overwritten" in line
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_the_configuration_can_be_shown(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["run", TASK, "--cfg", "job", "seed=3", "task.training.plan.clip=0.3"]) == 0
    out = capsys.readouterr().out
    assert "seed: 3\n" in out
    assert "clip: 0.3\n" in out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("tsbench ", " ".join(verbs.VERBS)),
        ("tsbench run task=rocket_n", "task=rocket_navigation"),
        ("tsbench run task=rocket_navigation bud", "budget="),
    ],
)
def test_shell_completion(
    line: str,
    expected: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COMP_LINE", line)
    assert cli.main(["-sc", "query=bash"]) == 0
    assert capsys.readouterr().out.strip() == expected


def test_output_to_a_full_disk() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "tsbench"], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert (done.returncode, done.stderr) == (2, "tsbench: output: No space left on device\n")


def test_a_run_whose_pages_fail_still_writes_its_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(run: RunDirectory) -> None:
        raise TsbenchError("no room")

    monkeypatch.setattr("tsbench.viewer.report.write_pages", fail)
    entry = next(iter(kept.entries().values()))
    shutil.copytree(kept.trainings(entry)[0], tmp_path / "mine")
    assert cli.main(["run", "resume=mine", "--json", "score.json"]) == 2
    assert "no room; the run is finished, its pages are not" in capsys.readouterr().err
    score = RunDirectory(tmp_path / "mine").record().score
    assert json.loads((tmp_path / "score.json").read_text())["success"] == score.success


def test_interrupted(tmp_path: Path) -> None:
    words = ["run", TASK, "directory=mine"]
    metrics = tmp_path / "mine" / "metrics.jsonl"
    patience = 300.0  # s, on a busy machine
    with subprocess.Popen(
        [sys.executable, "-m", "tsbench", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            deadline = time.monotonic() + patience
            while not (metrics.exists() and metrics.stat().st_size) and time.monotonic() < deadline:
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=patience)
        finally:
            process.kill()  # otherwise the end of the context waits for it
    line = "tsbench: interrupted; to go on: tsbench run resume=mine\n"
    assert (process.returncode, errors) == (130, line)
    assert not (tmp_path / "mine" / "score.json").exists()
