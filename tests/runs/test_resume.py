"""Interrupted runs: they end with the same bits as a run that was never interrupted."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.util.tensor_util import make_ndarray

from tsbench import cli, tasks
from tsbench.core.errors import Stopped, TsbenchError
from tsbench.core.motion import ReferenceMotion
from tsbench.core.policy import Policy
from tsbench.rl.ppo import Learner
from tsbench.rl.settings import PPOSettings
from tsbench.runs import config, execute
from tsbench.runs.checkpoint import Checkpoints, decode, encode
from tsbench.runs.directory import MOST_STAGES, RunDirectory
from tsbench.runs.workspace import RunMonitor, RunWorkspace
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.disturbed import Disturbances, DisturbedPhysics
from tsbench.sim.kinematic import Planning
from tsbench.sim.physics import Physics
from tsbench.sim.tracking import Imitation

# Three stages of 3, 2 and 2 iterations.
WORDS = [
    "task=rocket_navigation",
    "budget=smoke",
    "task.budgets.smoke.plan=96",
    "task.budgets.smoke.act=128",
    "task.budgets.smoke.environments=4",
    "task.training.plan.rollout=8",
    "task.training.imitate.rollout=2",  # of four steps each
    "task.training.imitate.minibatches=2",
    "task.constants.distance=8.0",
    "method.finetune=0.5",
    "seed=5",
    "checkpoint=0",
]
ITERATIONS = 3 + 2 + 2
PAGES = {"learning_curves.png", "view.html", "report.html"}


class Crash(BaseException):
    """An exception that the program never catches, as it cannot catch kill -9."""


def begin(directory: Path) -> None:
    chosen = replace(config.compose(WORDS), directory=str(directory))
    execute.execute(chosen, WORDS, Console(file=io.StringIO()))


def resume(directory: Path) -> None:
    execute.resume(directory, Console(file=io.StringIO()))


@pytest.fixture
def crash(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, bool], None]:
    """A function that lets a run crash in a given iteration, before or after its checkpoint."""
    update, keep = RunMonitor.update, RunWorkspace.keep
    left: list[Any] = [-1, True]  # iterations left, and whether to crash before the checkpoint

    def counted(self: RunMonitor, *arguments: Any) -> None:
        left[0] -= 1
        update(self, *arguments)

    def kept(self: RunWorkspace, *arguments: Any) -> None:
        if not left[0] and left[1]:
            raise Crash
        keep(self, *arguments)
        if not left[0]:
            raise Crash

    def dies(iteration: int, unsaved: bool) -> None:
        left[:] = [iteration, unsaved]

    monkeypatch.setattr(RunMonitor, "update", counted)
    monkeypatch.setattr(RunWorkspace, "keep", kept)
    return dies


def result(directory: Path) -> dict[str, Any]:
    """A run's results, without times and without the pages of the command line."""
    rows = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    content = RunDirectory(directory).record()
    recordings = [dict(np.load(directory / f"{name}.npz")) for name in ("plan", "reference")]
    events = EventAccumulator(str(directory / "tensorboard"))
    events.Reload()
    scalars = {
        tag: [
            (event.step, make_ndarray(event.tensor_proto).item()) for event in events.Tensors(tag)
        ]
        for tag in events.Tags()["tensors"]
        if not tag.endswith("seconds")
    }
    return {
        "policy": [
            (directory / name).read_bytes() for name in ("policy.safetensors", "policy.json")
        ],
        "recordings": [
            {name: array.tobytes() for name, array in each.items()} for each in recordings
        ],
        "metrics": [
            {name: value for name, value in row.items() if not name.endswith("seconds")}
            for row in rows
        ],
        "events": scalars,
        "score": content.score,
        "stages": [(stage.name, stage.steps, stage.physics_substeps) for stage in content.stages],
        "files": sorted({path.name for path in directory.iterdir()} - PAGES),
    }


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, which no test may change."""
    directory = tmp_path_factory.mktemp("runs") / "whole"
    begin(directory)
    return directory


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that crashed in the middle of its second stage, which no test may change."""
    directory = tmp_path_factory.mktemp("runs") / "broken"
    with pytest.MonkeyPatch.context() as monkeypatch:
        keep = RunWorkspace.keep

        def kept(self: RunWorkspace, *arguments: Any) -> None:
            keep(self, *arguments)
            if len(self.stages) == 2:
                raise Crash

        monkeypatch.setattr(RunWorkspace, "keep", kept)
        with pytest.raises(Crash):
            begin(directory)
    return directory


@pytest.fixture
def unfinished(broken: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the broken run below the current directory, which tests may change."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(broken, "run")
    return Path("run")


@pytest.mark.parametrize("unsaved", [True, False])
def test_the_same_bits_after_a_crash_in_every_iteration(
    unsaved: bool, uninterrupted: Path, tmp_path: Path, crash: Callable[[int, bool], None]
) -> None:
    """Each process saves one iteration, and crashes then or in the next before its checkpoint."""
    directory = tmp_path / "run"
    deaths = 0
    go_on: Callable[[Path], None] = begin
    while not (directory / "score.json").exists():
        crash(2 if unsaved else 1, unsaved)
        try:
            go_on(directory)
        except Crash:
            deaths, go_on = deaths + 1, resume
    assert deaths == (ITERATIONS - 1 if unsaved else ITERATIONS)
    assert result(directory) == result(uninterrupted)


def test_a_crash_before_the_first_checkpoint(
    uninterrupted: Path, tmp_path: Path, crash: Callable[[int, bool], None]
) -> None:
    crash(1, True)
    with pytest.raises(Crash):
        begin(tmp_path / "run")
    assert (tmp_path / "run" / "metrics.jsonl").read_text().count("\n") == 1
    crash(-1, False)
    resume(tmp_path / "run")
    assert result(tmp_path / "run") == result(uninterrupted)


@pytest.mark.parametrize("update", ["numpy", "rsl_rl"])
def test_the_learner_goes_on_to_the_last_bit(
    update: str,
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    """In every kind of stage, a new learner of another seed continues from the loaded snapshot."""
    trot, rocket = tasks.make("laikago_trot"), tasks.make("rocket_obstacles")
    subjects: dict[str, Any] = {
        "kinematics": Planning(rocket, explore=0.5),
        "legs in kinematics": Planning(trot, explore=0.5),
        "flight": rocket,
        "imitation": Imitation(trot, naive_reference("laikago_trot")),
        "disturbances": trot,
    }
    disturb = Disturbances(
        push=80.0, rise=400, calm=0.2, interval=0.3, mass=0.2, friction=0.3, strength=0.1, latency=2
    )
    chosen = PPOSettings(
        environments=8, rollout=16, epochs=2, minibatches=2, hidden=(16,), entropy=0.01,
        desired_kl=0.001, final_std=0.1, update=update,
    )  # fmt: skip

    def learner(name: str, seed: int) -> Learner:
        subject = dynamics = subjects[name]
        if name == "disturbances":  # the variations of the physics belong to the problem
            dynamics = DisturbedPhysics(subject, chosen.environments, disturb, 0, threads=1)
        elif not isinstance(subject, Planning):
            dynamics = Physics(subject, chosen.environments, threads=1)
        return Learner(BatchedEnvironment(subject, dynamics, 8, seed), chosen, seed)

    def snapshots(learner: Learner) -> list[bytes]:
        taken: list[bytes] = []
        learner.learn(5 * 128, lambda *_: taken.append(encode(learner.snapshot())))
        return taken

    for name in subjects:
        whole = snapshots(learner(name, 1))
        rates = {decode(each)["update"]["learning_rate"] for each in whole}
        assert len(rates) > 1, "the adaptive learning rate has to take part"
        second = learner(name, 2)
        second.restore(decode(whole[1]))
        assert second.steps == 2 * 128
        assert snapshots(second) == whole[2:], name


def test_a_torn_checkpoint_is_told_and_the_one_before_is_used(
    unfinished: Path, uninterrupted: Path
) -> None:
    """This holds for the last checkpoint of a finished stage too."""
    for stage in ("00", "01"):
        newest = sorted((unfinished / "checkpoints").glob(f"{stage}-*"))[-1]
        newest.write_bytes(newest.read_bytes()[:-100])
    resume(unfinished)
    log = (unfinished / "log.txt").read_text()
    assert log.count("damaged checkpoint run/checkpoints/0") == 2
    assert "going back to the one before" in log
    assert result(unfinished) == result(uninterrupted)


def test_nothing_is_left_of_what_was_half_written(unfinished: Path) -> None:
    """And a file of the user's with a similar name stays."""
    ours = ".policy.json." + "0" * 32 + ".part"
    for name in (ours, f"checkpoints/{ours}", "movie.part"):
        (unfinished / name).write_text("half")
    resume(unfinished)
    assert [path.name for path in unfinished.rglob("*.part")] == ["movie.part"]
    assert not (unfinished / "checkpoints").exists()


def outside(name: str, content: bytes | None = None) -> Path:
    """A file of the user's in another directory, or with no content a folder of such files, among
    them what a run would remove from its own folder."""
    place = Path("elsewhere") / name
    place.parent.mkdir(exist_ok=True)
    if content is not None:
        place.write_bytes(content)
        return place.absolute()
    place.mkdir()
    half = f".policy.json.{'0' * 32}.part"
    for inner in ("events.out.tfevents.1.mine", half, "thesis.tex"):
        (place / inner).write_text("mine")
    (place / "photos").mkdir()
    (place / "photos" / "cat.jpg").write_text("mine")
    return place.absolute()


def contents(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize(
    ("name", "kind", "line"),
    [
        *((name, "link", "is a link") for name in (
            "log.txt", "metrics.jsonl", "versions.json", "config.yaml", "score.json",
            "failure.txt",
        )),
        *((name, "hard link", "has a second name") for name in ("log.txt", "metrics.jsonl")),
        *((name, "folder", "is a link") for name in (
            "tensorboard", "checkpoints", "mlflow", "wandb",
        )),
    ],
)  # fmt: skip
def test_no_run_goes_on_through_links(
    name: str,
    kind: str,
    line: str,
    unfinished: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Whoever sends a run could else let files be changed or removed that lie elsewhere."""
    place = unfinished / name
    if kind == "folder":
        theirs = outside(name)
        if place.exists():
            shutil.copytree(place, theirs, dirs_exist_ok=True)
            shutil.rmtree(place)
    else:
        theirs = outside(name, place.read_bytes() if place.exists() else b"mine")
        place.unlink(missing_ok=True)
    if kind == "hard link":
        os.link(theirs, place)
    else:
        place.symlink_to(theirs)
    before = contents(Path("elsewhere"))
    assert cli.main(["run", "resume=run"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("tsbench: ")
    assert f"run/{name} {line}" in error
    assert error.count("\n") == 1
    assert contents(Path("elsewhere")) == before


def test_what_a_resumed_run_replaces_is_not_followed(
    unfinished: Path, uninterrupted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Links in the places of files that it writes anew, and under the names that temporary files
    once had, to files of the user's."""
    names = ["plan.npz", "reference.npz", "policy.json", "policy.safetensors", "actions.npz"]
    parts = [f"{name}.part" for name in [*names, "report.html", "config.yaml", "score.json"]]
    for name in [*names, *parts]:
        (unfinished / name).unlink(missing_ok=True)
        (unfinished / name).symlink_to(outside(name, b"mine"))
    before = contents(Path("elsewhere"))
    assert cli.main(["run", "resume=run"]) == 0
    assert contents(Path("elsewhere")) == before
    assert all((unfinished / name).is_symlink() for name in parts)
    for name in parts:
        (unfinished / name).unlink()
    assert result(unfinished) == result(uninterrupted)
    # A link in the place of a page is refused, once the run is finished.
    (unfinished / "report.html").unlink()
    (unfinished / "report.html").symlink_to(Path("elsewhere/report.html").absolute())
    capsys.readouterr()
    assert cli.main(["run", "resume=run"]) == 2
    error = capsys.readouterr().err
    assert "report.html exists and nothing is overwritten" in error
    assert error.count("\n") == 1
    assert contents(Path("elsewhere")) == before


def test_the_log_and_the_score_tell_of_the_interruption(unfinished: Path) -> None:
    before = json.loads((unfinished / "metrics.jsonl").read_text().splitlines()[-1])
    with (unfinished / "metrics.jsonl").open("a") as file:
        file.write('{"lost": 1}\n{"lost": 2}\n{"lo')
    resume(unfinished)
    log = (unfinished / "log.txt").read_text()
    assert "resumed: imitate goes on at 32 steps" in log
    assert "2 iterations after the last checkpoint are done again" in log
    stages = RunDirectory(unfinished).record().stages
    assert [stage.interruptions for stage in stages] == [0, 1, 0]
    assert stages[1].seconds > before["seconds"]


@pytest.mark.parametrize(
    ("name", "change", "line"),
    [
        ("config.yaml", ("seed: 5", "seed: 6"), "run was begun with another configuration"),
        ("versions.json", ('"torch": "', '"torch": "9'), "another version of a package"),
        ("versions.json", ('"python": "', '"python": "9'), "another version of Python"),
        ("versions.json", ('"code": "', '"code": "9'), "another version of tsbench's own code"),
        ("versions.json", ('"rocket_navigation": "', '"rocket_navigation": "9'), "another model"),
        ("versions.json", ("{", "["), "damaged versions run/versions.json"),
        ("config.yaml", ("seed: 5", "seed: x"), "damaged configuration run/config.yaml"),
        ("config.yaml", ("name: rocket_navigation", "name: rocket"), "unknown task 'rocket'"),
        ("metrics.jsonl", ("{", ""), "run/metrics.jsonl has been cut since the last checkpoint"),
    ],
)
def test_another_configuration_version_or_task_is_refused(
    name: str,
    change: tuple[str, str],
    line: str,
    unfinished: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = unfinished / name
    path.write_text(path.read_text().replace(*change, 1))
    before = {path: path.read_bytes() for path in unfinished.rglob("*.*")}
    assert cli.main(["run", "resume=run"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("tsbench: ")
    assert line in error
    assert error.count("\n") == 1
    after = {path: path.read_bytes() for path in unfinished.rglob("*.*") if path.name != "log.txt"}
    assert after == {path: content for path, content in before.items() if path.name != "log.txt"}


def test_another_runs_checkpoint_is_refused(
    unfinished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoints = Checkpoints(unfinished / "checkpoints", pytest.fail)
    newest = checkpoints.newest()
    assert newest is not None
    checkpoints.save(1, "imitate", newest.steps + 32, {**newest.content, "run": "another"})
    assert cli.main(["run", "resume=run"]) == 2
    assert "is a checkpoint of another run" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["stages", "sizes", "learner"])
def test_a_checkpoint_with_something_else_in_it_is_refused(
    part: str, unfinished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    checkpoints = Checkpoints(unfinished / "checkpoints", pytest.fail)
    newest = checkpoints.newest()
    assert newest is not None
    checkpoints.save(1, "imitate", newest.steps + 32, {**newest.content, part: {"steps": 3}})
    assert cli.main(["run", "resume=run"]) == 2
    error = capsys.readouterr().err
    assert "checkpoint" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["resume=nowhere"], "there is no run in nowhere"),
        (["resume=run", "seed=1"], "give it alone"),
        (["-m", "resume=run"], "give it alone"),
    ],
)
def test_what_cannot_be_resumed(
    words: list[str], line: str, unfinished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["run", *words]) == 2
    assert line in capsys.readouterr().err


def test_a_finished_run_is_not_resumed(
    uninterrupted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(uninterrupted, tmp_path / "run")
    for page in ("view.html", "report.html"):
        (tmp_path / "run" / page).touch()
    assert cli.main(["run", f"resume={tmp_path / 'run'}"]) == 2
    assert capsys.readouterr().err.endswith("a finished run: there is nothing to resume\n")


def test_two_at_once_in_a_directory(unfinished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second process is refused; the lock is free once the first has been killed."""
    program = (
        "import sys, time; from pathlib import Path; from tsbench.runs import execute\n"
        "with execute._locked(Path('run')): print('locked', flush=True); time.sleep(60)"
    )
    holder = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "locked\n"
    assert cli.main(["run", "resume=run"]) == 2
    assert capsys.readouterr().err == "tsbench: another process is at work in run\n"
    holder.kill()
    holder.wait()
    holder.stdout.close()
    resume(unfinished)


def test_an_unfinished_run_is_not_begun_again(unfinished: Path) -> None:
    with pytest.raises(TsbenchError, match=r"run holds an unfinished run .* resume=run"):
        begin(unfinished)


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"]
)
def test_a_signal_saves_the_iteration_and_says_how_to_go_on(
    number: signal.Signals, status: int, uninterrupted: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """The signal arrives in the middle of the fifth iteration, with no other checkpoint due."""
    monkeypatch.chdir(tmp_path)
    words = [*WORDS[:-1], "checkpoint=1000"]
    step, steps = BatchedEnvironment.step, [0]

    def counted(self: BatchedEnvironment[Any], action: np.ndarray) -> Any:
        steps[0] += 1
        if steps[0] == 4 * 8 + 3:
            os.kill(os.getpid(), number)
        return step(self, action)

    monkeypatch.setattr(BatchedEnvironment, "step", counted)
    assert cli.main(["run", *words, "directory=run"]) == status
    line = "tsbench: interrupted; to go on: tsbench run resume=run\n"
    assert capsys.readouterr().err == line
    assert (tmp_path / "run" / "metrics.jsonl").read_text().count("\n") == 5
    names = sorted(path.name for path in (tmp_path / "run" / "checkpoints").iterdir())
    assert names[-1].startswith("01-imitate-000000000064-")
    assert cli.main(["run", "resume=run"]) == 0
    assert result(tmp_path / "run") == result(uninterrupted)
    assert {path.name for path in (tmp_path / "run").iterdir()} >= PAGES


def test_a_signal_before_the_first_iteration_ends_says_how_to_go_on_too(
    uninterrupted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as changed:
        changed.setattr(
            BatchedEnvironment, "step", lambda self, action: os.kill(os.getpid(), signal.SIGINT)
        )
        assert cli.main(["run", *WORDS, "directory=run"]) == 130
    line = "tsbench: interrupted; to go on: tsbench run resume=run\n"
    assert capsys.readouterr().err == line
    assert cli.main(["run", "resume=run"]) == 0
    assert result(tmp_path / "run") == result(uninterrupted)


def test_a_second_signal_does_not_wait(tmp_path: Path) -> None:
    workspace = RunWorkspace(tmp_path, Console(file=io.StringIO()))
    with workspace.stage("plan", 100) as monitor:
        monitor.update(10, {}, lambda: {"value": 1})
        workspace.stop(signal.SIGINT)
        with pytest.raises(Stopped):
            workspace.stop(signal.SIGINT)
    workspace.close()


def test_between_iterations_a_signal_stops_at_once(tmp_path: Path) -> None:
    workspace = RunWorkspace(tmp_path, Console(file=io.StringIO()))
    with pytest.raises(Stopped) as stopped:
        workspace.stop(signal.SIGTERM)
    assert stopped.value.signal == signal.SIGTERM
    workspace.close()


def test_a_stage_without_snapshots_is_done_again(tmp_path: Path) -> None:
    """Its reports are not counted twice, and the other stages keep theirs."""

    names = ("roadmap", "train", "smooth", "polish")

    def method(workspace: RunWorkspace, until: str) -> list[int]:
        begun = []
        for name in names:
            with workspace.stage(name, 20) as monitor:
                begun.append(monitor.saved["steps"] if monitor.saved else 0)
                for steps in range(begun[-1] + 10, 21, 10):
                    snapshot = {"steps": steps}.copy
                    monitor.update(steps, {}, None if name in ("roadmap", "smooth") else snapshot)
                    if name == until:
                        raise Crash
        return begun

    def rows() -> list[tuple[str, int]]:
        lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
        return [(row["stage"], row["steps"]) for row in map(json.loads, lines)]

    everything = []
    for name in names:
        everything += [(name, 10), (name, 20)]
        workspace = RunWorkspace(tmp_path, Console(file=io.StringIO()), interval=0.0)
        with pytest.raises(Crash):
            method(workspace, name)
        workspace.close()
        assert rows() == everything[:-1]
    workspace = RunWorkspace(tmp_path, Console(file=io.StringIO()), interval=0.0)
    assert method(workspace, "") == [0, 20, 0, 10]
    workspace.close()
    assert rows() == everything


def test_a_stage_that_ends_below_its_budget_is_recorded_once(tmp_path: Path) -> None:
    def method(workspace: RunWorkspace, last: int) -> None:
        with workspace.stage("roadmap", 20) as monitor:
            monitor.update(6, {})
        with workspace.stage("train", 20) as monitor:
            for steps in range(10, last + 1, 10):
                monitor.update(steps, {}, {"steps": steps}.copy)

    for last in (10, 20):
        workspace = RunWorkspace(tmp_path, Console(file=io.StringIO()), interval=0.0)
        method(workspace, last)
        workspace.close()
    rows = map(json.loads, (tmp_path / "metrics.jsonl").read_text().splitlines())
    stages = [row["stage"] for row in rows]
    assert stages.count("roadmap") == 1
    assert [(stage.name, stage.steps) for stage in workspace.stages] == [
        ("roadmap", 6),
        ("train", 20),
    ]


def test_a_stage_whose_checkpoints_would_be_lost_is_refused(tmp_path: Path) -> None:
    workspace = RunWorkspace(tmp_path, Console(file=io.StringIO()))
    for name in ("fine-tune", "", "a/b"):
        with pytest.raises(TsbenchError, match="a stage has a name of letters, digits and _"):
            workspace.stage(name, 10).__enter__()
    for number in range(MOST_STAGES):
        with workspace.stage(f"stage{number}", 10):
            pass
    with pytest.raises(TsbenchError, match=f"a run has at most {MOST_STAGES} stages"):
        workspace.stage("another", 10).__enter__()
    workspace.close()


def test_the_policy_can_be_read_back(uninterrupted: Path) -> None:
    """Equal bytes in the tests above therefore mean equal policies."""
    assert Policy.load(uninterrupted).info.task == "rocket_navigation"
