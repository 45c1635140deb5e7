"""Entries made from runs, what the verifier finds out about them, and pull requests."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console

from tsbench import cli, tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.files import encode_json
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.evaluation import protocol as protocols
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.protocol import PROTOCOLS, SMOKE, V1
from tsbench.evaluation.replay import contradictions, differences
from tsbench.leaderboard import page, recipe, submission, verify
from tsbench.leaderboard.submission import Described, Manifest
from tsbench.runs import config, execute
from tsbench.runs.directory import RunDirectory
from tsbench.runs.schema import identity_hash

BOARD = Path(__file__).parents[2] / "leaderboards"
KEPT = sorted(path.parent for path in BOARD.glob("v1/*/*/manifest.json"))
IDS = [f"{entry.parent.name}-{entry.name}" for entry in KEPT]
WORDS = ["task=rocket_navigation", "budget=smoke", "task.budgets.smoke.plan=512", "seed=3"]
WHO = ["--author", "A. Person", "--licence", "MIT", "--board", "board"]
TOLD = ["--seeds", "5", "--steps", "256", "--seconds", "1.5", "--command", "python train.py"]
QUICK = replace(SMOKE, name="quick", ranked=True)


@pytest.fixture(autouse=True)
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A protocol that takes seconds, and by whose scores entries are made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PROTOCOLS, "quick", QUICK)
    monkeypatch.setattr(protocols, "V1", QUICK)


def trained(directory: Path, words: list[str]) -> Path:
    """A finished run whose score is by the quick protocol."""
    chosen = replace(config.compose(words), directory=str(directory))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(execute, "SMOKE", replace(QUICK, name="quick"))
        patch.setattr(execute, "V1", QUICK)
        execute.execute(chosen, words, Console(quiet=True))
    return directory


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, which no test may change."""
    return trained(tmp_path_factory.mktemp("runs") / "one", WORDS)


@pytest.fixture
def finished(shown: Path) -> Path:
    """A copy of the finished run, which tests may change."""
    shutil.copytree(shown, "one")
    return Path("one")


@pytest.fixture(scope="module")
def board(shown: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A board with the finished run as its entry, which no test may change."""
    path = tmp_path_factory.mktemp("boards") / "board"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PROTOCOLS, "quick", QUICK)
        patch.setattr(protocols, "V1", QUICK)
        assert cli.main(["submit", str(shown), "--name", "mine", *WHO[:-1], str(path)]) == 0
    return path


@pytest.fixture
def entered(board: Path) -> None:
    """A copy of the board, which tests may change: `ENTRY` lies in it."""
    shutil.copytree(board, "board")


def seeded(run: Path, seed: int) -> Path:
    """A copy of the run that says it is of another seed, wherever a run says it."""
    other = Path(f"seed{seed}")
    shutil.copytree(run, other)
    other_config(other, "seed=3", f"seed={seed}")
    other_config(other, "\nseed: 3", f"\nseed: {seed}")
    directory = RunDirectory(other)
    versions = directory.versions() | {"configuration": identity_hash(directory.settings())}
    directory.versions_file.write_bytes(encode_json(versions))
    other_score(other, "seed", value=seed)
    return other


def other_score(run: Path, *path: str, value: Any) -> None:
    content = json.loads((run / "score.json").read_text())
    inner = content
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    (run / "score.json").write_bytes(encode_json(content))


def other_config(run: Path, before: str, after: str) -> None:
    text = (run / "config.yaml").read_text()
    assert before in text
    (run / "config.yaml").write_text(text.replace(before, after))


def submit(*words: str) -> int:
    return cli.main(["submit", *words, "--name", "mine", *WHO])


ENTRY = Path("board/quick/rocket_navigation/mine")


def test_runs_become_an_entry(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    second = seeded(finished, 4)
    assert submit("one", str(second), "--trained", "3-5", "--hardware", "two cores") == 0
    shown = capsys.readouterr().out
    assert str(ENTRY) in shown
    assert "not said: tuning trials" in shown
    assert "not said: hardware" not in shown
    assert "not kept: the trainings with seeds 5" in shown
    entry = submission.read_entry(ENTRY)
    assert [kept.training.seed for kept in entry.kept] == [3, 4]
    files = {"actions.npz", "config.yaml", "metrics.jsonl", "plan.npz", "policy.json",
             "policy.safetensors", "reference.npz", "score.json", "versions.json"}  # fmt: skip
    assert {path.name for path in (ENTRY / "seed3").iterdir()} == files
    for name in files - {"metrics.jsonl"}:
        assert (ENTRY / "seed3" / name).read_bytes() == (finished / name).read_bytes()
    training = entry.kept[0].training
    record = RunDirectory(finished).record()
    assert training.command == f"tsbench run {' '.join(WORDS)}"
    assert training.steps == sum(stage.steps for stage in record.stages)
    assert training.claimed.solved_reward == record.score.solved_reward
    assert training.versions["mujoco"] == RunDirectory(finished).versions()["packages"]["mujoco"]
    manifest = entry.manifest
    assert Manifest.decode((ENTRY / "manifest.json").read_bytes()) == manifest
    digest = hashlib.sha256((finished / "plan.npz").read_bytes()).hexdigest()
    assert manifest.files["seed3/plan.npz"].sha256 == digest
    assert [path.name for path in Path("board").iterdir()] == ["quick"]  # nothing half-made
    assert submit("one") == 2
    told = capsys.readouterr()
    assert "exists and nothing is overwritten" in told.err
    assert "replayed" not in told.out + told.err  # it is refused before it is verified


def test_an_entry_is_verified_in_full_and_the_verdict_kept(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert submit("one") == 0
    assert cli.main(["verify", "--all", "--board", "board", "--record", "--json", "out.json"]) == 0
    assert "re-scored: seed3 was compared bit for bit: equal" in capsys.readouterr().out
    (verdict,) = json.loads(Path("out.json").read_text())["verdicts"]
    assert (verdict["entry"], verdict["state"]) == ("quick/rocket_navigation/mine", "re-scored")
    for figure in verdict["figures"]:
        assert figure["verified"] == figure["claimed"]
    kept = verify.recorded(Path("board"), ENTRY)
    assert kept is not None
    assert kept.state == "re-scored"
    assert cli.main(["verify", str(ENTRY), "--board", "board", "--retract", "a bug"]) == 0
    kept = verify.recorded(Path("board"), ENTRY)
    assert kept is not None
    assert (kept.state, kept.reasons) == ("retracted", ("retracted: a bug",))
    assert cli.main(["verify", "--all", "--board", "board", "--record"]) == 0
    assert f"{ENTRY} stays retracted" in capsys.readouterr().out
    assert verify.recorded(Path("board"), ENTRY) == kept
    # Another entry under that name has no verdict yet.
    shutil.rmtree(ENTRY)
    assert submit("one", "--hardware", "another") == 0
    assert verify.recorded(Path("board"), ENTRY) is None


def test_a_kept_verdict_is_replaced_by_a_higher_state_or_a_failure(entered: None) -> None:
    board = Path("board")
    first = verify.verify(ENTRY, verify.Asked(rescore=False))
    for state, passed, written in (
        ("re-scored", True, True),
        ("replayed", True, False),
        ("re-trained", True, True),
        ("hidden-seed", True, False),
        ("submitted", False, True),
        ("replayed", True, True),
        ("retracted", False, True),
        ("submitted", False, False),
        ("re-trained", True, False),
    ):
        before = verify.recorded(board, ENTRY)
        verdict = replace(first, state=state, passed=passed)
        assert (verify.record(board, ENTRY, verdict) is not None) is written, state
        assert verify.recorded(board, ENTRY) == (verdict if written else before)
    # On other files it says nothing.
    other = replace(first, digest="0" * 64)
    (board / "verdicts/quick/rocket_navigation/mine.json").write_text(
        json.dumps(asdict(replace(other, state="re-trained")))
    )
    assert verify.record(board, ENTRY, first) is not None


def test_a_failure_is_replaced_by_what_passes_the_step_that_failed(entered: None) -> None:
    board, first = Path("board"), verify.verify(ENTRY, verify.Asked(rescore=False))
    failed = ("FAILED: not hidden-seed: seed3 earns less",)
    verify.record(board, ENTRY, replace(first, state="re-scored", passed=False, reasons=failed))
    again = replace(first, state="re-trained", reasons=("re-trained: seed3 was trained again",))
    assert verify.record(board, ENTRY, again) is None
    both = replace(again, reasons=("hidden-seed: seed3 earns as much", *again.reasons))
    assert verify.record(board, ENTRY, both) is not None


def test_names_of_packages_are_nothing_but_names(entered: None) -> None:
    """Though a package may be called as an argument of a function is."""
    training = submission.read_manifest(ENTRY).trainings[0]
    versions = {"command": "1", "code": None, "self": "2", "texts": "3"}
    assert replace(training, versions=versions).versions == versions


def test_the_seconds_of_no_stages_are_written_as_they_are_read(finished: Path) -> None:
    nothing = replace(RunDirectory(finished).record(), stages=())
    assert json.dumps(submission.cost_of(nothing)) == "[0, 0, 0.0]"


def test_folders_that_are_no_entries_yet_are_in_nobodys_way(
    entered: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Runs that lie where their entry will be, and a manifest that is damaged."""
    place = Path("kept/v1/rocket_navigation")
    shutil.copytree(ENTRY, place / "mine")
    shutil.copytree(ENTRY / "seed3", place / "begun" / "seed3")
    shutil.copytree(ENTRY, place / "damaged")
    (place / "damaged" / "manifest.json").write_text("{")
    monkeypatch.setattr("tsbench.leaderboard.kept.FOLDERS", (Path("kept"),))
    assert list(submission.kept_manifests()) == ["rocket_navigation/mine"]
    assert cli.main(["describe", "rocket_navigation"]) == 0
    assert cli.main(["describe", "twostage"]) == 0


def test_a_board_keeps_verdicts_on_its_own_entries_alone(
    entered: None, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree("board", "elsewhere")
    other = str("elsewhere" / ENTRY.relative_to("board"))
    for words in (["--record", "--quick"], ["--retract", "a bug"]):
        assert cli.main(["verify", other, "--board", "board", *words]) == 2
        assert f"{other} does not lie in board/v1/TASK" in capsys.readouterr().err
    assert not Path("board/verdicts").exists()
    linked = f"board/../{ENTRY}"  # the same place by another path
    assert cli.main(["verify", linked, "--board", "board", "--record", "--quick"]) == 0
    assert verify.recorded(Path("board"), ENTRY) is not None


def test_a_check_keeps_nothing(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert submit("one", "--check") == 0
    assert "re-scored: seed3 was compared bit for bit" in capsys.readouterr().out
    assert not Path("board").exists()
    assert not list(Path().glob(".submit-*"))


def test_an_entry_keeps_the_learning_curves(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a long training few rows; what the training did not learn by is left out."""
    row = {"stage": "plan", "seconds": 0.5, "episode_return": 2.0, "normalized_return": 0.1}
    rows = [{**row, "steps": 10 * step, "kl": 0.01} for step in range(1, 1001)]
    rows.append({"stage": "search", "steps": 9, "seconds": 1.0})
    (finished / "metrics.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in rows))
    assert submit("one") == 0
    kept = [json.loads(line) for line in (ENTRY / "seed3/metrics.jsonl").read_text().splitlines()]
    assert len(kept) == 200
    assert (kept[0], kept[-1]) == ({**row, "steps": 10}, {**row, "steps": 10_000})
    capsys.readouterr()
    assert cli.main(["report", str(ENTRY / "seed3"), "--html", "report.html"]) == 0
    assert "How it learned" in Path("report.html").read_text()
    assert cli.main(["compare", str(ENTRY), "--png", "curves.png"]) == 0
    assert submission.read_entry(ENTRY)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"entropy": 1.0}, "holds more than the learning curves"),
        ({"episode_return": 1e300}, "a row lacks its stage, steps, seconds or return"),
        ({"steps": "many"}, "a row lacks its stage, steps, seconds or return"),
        ({"stage": "x" * 65}, "a row lacks its stage, steps, seconds or return"),
    ],
)
def test_an_entry_keeps_nothing_but_curves(
    change: dict[str, Any], line: str, entered: None
) -> None:
    metrics = ENTRY / "seed3" / "metrics.jsonl"
    first, *others = metrics.read_text().splitlines()
    text = "\n".join([json.dumps({**json.loads(first), **change}), *others, ""])
    metrics.write_text(text)
    manifest = submission.read_manifest(ENTRY)
    files = {**manifest.files, "seed3/metrics.jsonl": submission.hash_of(text.encode())}
    (ENTRY / "manifest.json").write_bytes(replace(manifest, files=files).encode())
    with pytest.raises(TsbenchError, match=line):
        submission.read_entry(ENTRY)


def test_kept_runs_get_a_manifest_where_they_are(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ENTRY.mkdir(parents=True)
    for path in finished.iterdir():
        if path.name in submission.LIMITS:
            (ENTRY / "seed3").mkdir(exist_ok=True)
            shutil.copy(path, ENTRY / "seed3")
    before = {path: path.stat().st_mtime_ns for path in (ENTRY / "seed3").iterdir()}
    assert submit(str(ENTRY / "seed3")) == 2
    assert "metrics.jsonl is not what an entry keeps of it" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in (ENTRY / "seed3").iterdir()} == before
    (ENTRY / "seed3" / "metrics.jsonl").unlink()
    del before[ENTRY / "seed3" / "metrics.jsonl"]
    assert submit(str(ENTRY / "seed3")) == 0
    assert {path: path.stat().st_mtime_ns for path in (ENTRY / "seed3").iterdir()} == before
    assert submission.read_entry(ENTRY).manifest.method == "twostage"


def test_a_score_by_another_protocol_is_made_again(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And so is every score, if asked."""
    content = json.loads((finished / "score.json").read_text())
    content["score"]["protocol"] = content["score"]["origin"]["protocol"]["name"] = "smoke"
    content["score"]["nominal"]["normalized_reward"] = 0.99
    (finished / "score.json").write_bytes(encode_json(content))
    assert submit("one") == 0
    said = "one: its score is by the protocol smoke, so it is scored again by quick"
    assert said in capsys.readouterr().err
    score = submission.read_entry(ENTRY).kept[0].record.score
    assert score.protocol == "quick"
    assert score.nominal.normalized_reward != 0.99
    shutil.rmtree("board")
    other_score(finished, "score", "nominal", "normalized_reward", value=0.99)
    assert submit("one", "--rescore") == 0
    assert submission.read_entry(ENTRY).kept[0].record.score == score


def bare(name: str) -> Callable[[Path], object]:
    """Leaves what another library's training might: no configuration, and not the file."""

    def spoil(run: Path) -> None:
        for one in ("config.yaml", "versions.json", name):
            (run / one).unlink()

    return spoil


def other_stage(run: Path, **changes: int) -> None:
    """Changes the stage in physics."""
    stages = json.loads((run / "score.json").read_text())["stages"]
    other_score(run, "stages", value=[stages[0], stages[1] | changes])


def spend(run: Path, steps: int) -> None:
    """Lets the run have taken so many steps in all, most of them in physics."""
    stages = json.loads((run / "score.json").read_text())["stages"]
    acted = steps - stages[0]["steps"]
    substeps = stages[1]["physics_substeps"] // stages[1]["steps"] * acted
    other_stage(run, steps=acted, physics_substeps=substeps)


def plan_of_another_task(run: Path) -> None:
    plan = Plan.load(run / "plan.npz")
    replace(plan, task="rocket_obstacles").save(run / "plan.npz")


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (lambda run: (run / "reference.npz").write_bytes(b"PK"), "damaged"),
        (plan_of_another_task, "rocket_obstacles"),
        (lambda run: other_score(run, "task", value="laikago_trot"), "disagree on the task"),
        (lambda run: other_score(run, "method", value="mine"), "disagree on the method"),
        (
            lambda run: other_config(run, "name: twostage", "name: monolithic"),
            "disagree on the method",
        ),
        (
            lambda run: other_score(run, "task_version", value=7),
            "disagree on the version of the task",
        ),
        (lambda run: other_config(run, "seed: 3", "seed: 4"), "disagree on the seed"),
        (lambda run: other_score(run, "budget", value="fast"), "disagree on the budget"),
        (
            lambda run: other_score(run, "score", "origin", "policy", value="0" * 64),
            "mixes several runs: its files disagree on the policy",
        ),
        (lambda run: other_score(run, "standard", value=False), "changed constants"),
        (lambda run: spend(run, 4 * 5000), "20,000 steps used, where the budget smoke has"),
        (lambda run: other_stage(run, budget=10**7), "stages of 10,000,512 steps, where the"),
        (lambda run: (run / "versions.json").write_text("hi"), "damaged versions"),
        (
            lambda run: other_score(run, "score", "origin", "protocol", "seed", value=1),
            "another seed or other numbers than protocol quick",
        ),
        (
            lambda run: other_score(run, "score", "origin", "protocol", "perturbed", value=9),
            "another seed or other numbers than protocol quick",
        ),
        (
            lambda run: other_score(run, "score", "robustness", "survival_100N", value=0.123),
            "contradicts itself: survival_100N is not that of the surface",
        ),
        (lambda run: (run / "actions.npz").unlink(), "one has no actions.npz: --rescore makes it"),
        (lambda run: (run / "policy.json").unlink(), "one holds no policy (no policy.json)"),
        (lambda run: (run / "score.json").unlink(), "is not finished: tsbench run resume=one"),
        (bare("policy.json"), "an action log alone is no entry"),
        (bare("score.json"), "of a policy that tsbench did not train say --seeds, --steps"),
    ],
)
def test_what_does_not_belong_together_is_no_entry(
    finished: Path,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[Path], object],
    line: str,
) -> None:
    spoil(finished)
    assert submit("one") == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1
    assert ".submit-" not in error
    assert not Path("board").exists()
    assert not list(Path().glob(".submit-*"))


def test_files_that_are_swapped_while_they_are_scored(finished: Path) -> None:
    """An entry holds what was read at the beginning, and the score is of that."""
    other_score(finished, "score", "protocol", value="smoke")
    other_score(finished, "score", "origin", "protocol", "name", value="smoke")
    before = (finished / "policy.safetensors").read_bytes()
    scored = []

    def swapping(policy: Any, task: Any) -> Any:
        for path in finished.iterdir():
            path.write_bytes(b"something else") if path.is_file() else None
        scored.append(policy.sha256)
        return evaluate(policy, task, protocol=QUICK)

    described = Described("mine", ("A. Person",), "MIT")
    packed = submission.pack([finished], described, Path("board"), QUICK, score=swapping)
    assert (packed / "seed3" / "policy.safetensors").read_bytes() == before
    assert [kept.policy.sha256 for kept in submission.read_entry(packed).kept] == scored


def test_a_full_disk_leaves_no_part_of_an_entry(
    finished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wherever the disk is full, another try then finds nothing in its way."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for owner, name in ((Path, "write_bytes"), (submission, "write_new"), (Path, "rename")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, full)
            assert submit("one") == 2
        assert capsys.readouterr().err.endswith("No space left on device\n")
        assert not [path for path in Path("board").rglob("*") if path.is_file()], name
    assert submit("one") == 0


def test_a_plan_that_no_physics_follows_is_told(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A policy is judged by what it does, so this is no fault of the score, but readers see it."""
    plan = Plan.load(finished / "plan.npz")
    far = plan.states.copy()
    far[1::2] += 1e6
    replace(plan, states=far).save(finished / "plan.npz")
    assert submit("one") == 0
    assert "seed3: the plan fails its audit (" in capsys.readouterr().out


def test_a_reference_motion_that_never_moves_is_told(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By each verb that reads it. To evaluate a policy nobody reads it."""
    motion = ReferenceMotion.load(finished / "reference.npz")
    frozen = np.repeat(motion.qpos[:1], len(motion.qpos), axis=0)
    replace(motion, qpos=frozen, qvel=0.0 * motion.qvel).save(finished / "reference.npz")
    assert submit("one") == 0
    line = "distance of the reference motion from the plan: "
    assert line in capsys.readouterr().out
    assert cli.main(["verify", str(ENTRY), "--quick"]) == 0
    assert line in capsys.readouterr().out
    distance = tasks.make("rocket_navigation").goal_distance
    start = float(distance(tasks.make("rocket_navigation").ideal())[0])
    told = f"The plan starts {start:.2f} m from the goal and ends {start:.2f} m from it"
    for verb in ("view", "report"):
        assert cli.main([verb, str(ENTRY / "seed3"), "--html", f"{verb}.html"]) == 0
        assert told in Path(f"{verb}.html").read_text()
    assert line.rstrip(": ") in Path("report.html").read_text()
    shutil.rmtree(ENTRY)
    (finished / "plan.npz").unlink()
    assert submit("one") == 0
    assert "nobody can audit the reference motion without plan.npz" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--name", "../up"], "entry must be a name of"),
        (["--name", "mine", "--url", "javascript:x"], "url must begin with https://"),
        (["--name", "mine", "--author", "x\ny"], "authors must be one line"),
        (["--name", "mine", "--trained", "4"], "seeds_trained lacks the kept seed 3"),
        (["--name", "mine", "--trained", "4-2"], "must be a whole number from 4"),
    ],
)
def test_what_authors_say_is_checked(
    finished: Path, capsys: pytest.CaptureFixture[str], words: list[str], line: str
) -> None:
    assert cli.main(["submit", "one", *WHO, *words]) == 2
    assert line in capsys.readouterr().err


def test_runs_of_several_kinds_are_no_entry(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert submit("one", "one") == 2
    assert "two of the runs have the same seed, 3: an entry keeps" in capsys.readouterr().err
    second = seeded(finished, 4)
    other_score(second, "budget", value="fast")
    assert submit("one", str(second)) == 2
    assert "more than one budget: fast, smoke" in capsys.readouterr().err


MADE = "an entry is what tsbench submit has made of runs, unchanged"
OTHERS = "move it there, or submit its runs by another name"


@pytest.mark.parametrize(
    ("place", "change", "line"),
    [
        ("rocket_navigation/yours", None, f"holds the entry rocket_navigation/mine: {OTHERS}"),
        ("rocket_obstacles/mine", None, f"holds the entry rocket_navigation/mine: {OTHERS}"),
        ("rocket_navigation/mine", "seed3/plan.npz", f"seed3/plan.npz is missing: {MADE}"),
        (
            "rocket_navigation/mine",
            "manifest.json",
            f"is no entry, it has no manifest.json: {MADE}",
        ),
        ("rocket_navigation/mine", "seed3/report.html", "is no file of an entry: remove it"),
        ("rocket_navigation/mine", "README.md", "is no file of an entry: remove it"),
    ],
)
def test_an_entry_that_was_moved_or_changed(
    board: Path, capsys: pytest.CaptureFixture[str], place: str, change: str | None, line: str
) -> None:
    """By hand. A file that is there is removed, another is added."""
    entry = Path("copy") / place
    shutil.copytree(board / ENTRY.relative_to("board"), entry)
    if change is not None:
        file = entry / change
        file.unlink() if file.exists() else file.write_text("mine")
    assert cli.main(["verify", str(entry), "--quick"]) == 1
    refused = capsys.readouterr().out.splitlines()
    assert refused[1:] == [next(one for one in refused[1:] if one.endswith(line))]


def test_directories_that_are_no_entry_or_no_run(
    finished: Path, entered: None, capsys: pytest.CaptureFixture[str]
) -> None:
    for place in ("one", str(ENTRY / "seed3"), str(ENTRY.parent)):
        assert cli.main(["verify", place, "--quick"]) == 1
        assert f"{place} is no entry, it has no manifest.json: {MADE}" in capsys.readouterr().out
    assert submit(str(ENTRY), "--check") == 2
    assert f"name the trainings in it, {ENTRY / 'seed*'}" in capsys.readouterr().err
    assert cli.main(["verify", "nothing"]) == 2
    assert capsys.readouterr().err == "tsbench: no entry nothing\n"
    assert cli.main(["verify", str(ENTRY), "--retract", " ", "--board", "board"]) == 2
    assert "needs a reason" in capsys.readouterr().err
    assert not Path("board/verdicts").exists()
    assert submit("one/score.json", "--check") == 2
    assert "no run directory one/score.json" in capsys.readouterr().err
    assert submit("one", "--check") == 2
    assert "mine exists and nothing is overwritten: give another --name" in capsys.readouterr().err


@pytest.mark.parametrize("words", [TOLD[:2], TOLD[2:4], TOLD[4:6], TOLD[6:], TOLD])
def test_what_a_run_says_itself_is_not_told_again(
    finished: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    assert submit("one", *words) == 2
    assert "one is a run of tsbench, which says its own seed" in capsys.readouterr().err
    bare("metrics.jsonl")(finished)  # with a score, but no configuration
    assert submit("one", *words) == 2
    line = "one/score.json says seed 3, --seeds says 5" if words == TOLD else "given together or"
    assert line in capsys.readouterr().err
    assert not Path("board").exists()


def test_a_training_of_a_kept_entry_of_others_keeps_its_recipe(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare("metrics.jsonl")(finished)
    assert submit("one") == 2
    assert "one has no config.yaml, so nothing says what trained it" in capsys.readouterr().err
    assert submit("one", "--seeds", "3", *TOLD[2:], "--code", "c0de") == 0
    second = Path("second")
    shutil.copytree(finished, second)
    other_score(second, "seed", value=4)
    more = ["--seeds", "3,4", *TOLD[2:6], "--command", "python other.py"]
    again = str(ENTRY / "seed3")
    assert cli.main(["submit", again, str(second), *more, *WHO, "--name", "both"]) == 0
    first, other = submission.read_manifest(ENTRY.with_name("both")).trainings
    assert (first.command, first.code) == ("python train.py", "c0de")
    assert (other.command, other.code) == ("python other.py", None)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["one"], "mine exists and nothing is overwritten: give another --name"),
        (["one", "one"], "two of the runs have the same seed, 3"),
        (["one", "other"], "more than one method: mine, twostage"),
        (["one", "--trained", "4"], "seeds_trained lacks the kept seed 3"),
        (["bare", *TOLD[:4], "--seconds", "-1", *TOLD[6:]], "seconds must lie between 0 and"),
        (["bare", *TOLD[:6], "--command", ""], "command must be one line of 1 to"),
    ],
)
def test_what_cannot_be_submitted_is_told_before_a_score_is_made(
    words: list[str],
    line: str,
    finished: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def score(*_: object, **__: object) -> None:
        raise AssertionError("minutes are spent")

    monkeypatch.setattr("tsbench.evaluation.evaluate.evaluate", score)
    other_score(finished, "score", "protocol", value="smoke")
    shutil.copytree("one", "other")
    other_score(Path("other"), "method", value="mine")
    other_score(Path("other"), "seed", value=4)
    shutil.copytree("one", "bare")
    bare("score.json")(Path("bare"))
    if words == ["one"]:
        ENTRY.mkdir(parents=True)
    assert submit(*words) == 2
    assert line in capsys.readouterr().err


def test_a_board_that_cannot_be_made(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("board").write_text("a file")
    assert submit("one") == 2
    assert "board is no folder, so no board can be made there" in capsys.readouterr().err
    assert Path("board").read_text() == "a file"


def test_a_claim_that_the_policy_does_not_earn(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Figures that fit each other pass the first tiers, and not the second."""
    content = json.loads((finished / "score.json").read_text())
    score = content["score"]
    task = tasks.make(content["task"])
    perturbed = score["perturbed"]
    for name in ("normalized_reward", "solved_reward"):
        factor = 1.25 if perturbed[name] else 0.0
        score[name] = perturbed[name] = perturbed[name] * factor
    score["against_plan"] *= 1.25
    (finished / "score.json").write_bytes(encode_json(content))
    assert not contradictions(RunDirectory(finished).record().score, task)
    assert submit("one") == 0
    assert cli.main(["verify", str(ENTRY), "--quick"]) == 0
    assert cli.main(["verify", str(ENTRY), "--comment", "comment.md"]) == 1
    said = capsys.readouterr().out
    assert "FAILED: not re-scored: seed3 was compared bit for bit: DIFFERENT" in said
    assert "normalized_reward: claimed" in said
    assert "replayed, **failed**" in Path("comment.md").read_text()


def test_on_another_machine_every_field_is_compared(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A submitter who names another machine gets no laxer comparison than its tolerance."""
    record = RunDirectory(finished).record()
    task, score = tasks.make(record.task), record.score
    surface = score.robustness.surface
    most = tuple(tuple(tuple(1 for _ in row) for row in plane) for plane in surface.survived)
    forged = replace(
        score, robustness=replace(score.robustness, surface=replace(surface, survived=most))
    )
    assert contradictions(forged, task)
    assert any("of the pushes" in line for line in differences(forged, score, task))
    longer = replace(score, perturbed=replace(score.perturbed, steps=score.perturbed.steps * 2))
    assert any("perturbed: steps" in line for line in differences(longer, score, task))
    other_score(finished, "score", "origin", "machine", "extensions", value="X86_V9")
    assert submit("one") == 0
    assert cli.main(["verify", str(ENTRY)]) == 0
    assert "compared within 0.05 (extensions X86_V9 there" in capsys.readouterr().out


def test_another_mujoco_is_not_verified(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other_score(finished, "score", "origin", "packages", "mujoco", value="2.0")
    assert submit("one") == 1
    assert "FAILED: not replayed: seed3 was made with another mujoco" in capsys.readouterr().out
    assert not ENTRY.exists()


def test_the_hidden_seed(entered: None, capsys: pytest.CaptureFixture[str]) -> None:
    Path("seed.txt").write_text("0123456789abcdef" * 4 + "\n")
    words = ["verify", str(ENTRY), "--board", "board", "--seed-file", "seed.txt"]
    assert cli.main(words) == 2
    assert "no published hash of a seed board/hidden-seed.sha256" in capsys.readouterr().err
    digest = hashlib.sha256(Path("seed.txt").read_bytes()).hexdigest()
    Path("board/hidden-seed.sha256").write_text(f"{digest}  seed.txt\n")
    assert cli.main([*words, "--json", "out.json"]) == 0
    (verdict,) = json.loads(Path("out.json").read_text())["verdicts"]
    assert verdict["state"] == "hidden-seed"
    assert "0123456789abcdef" not in Path("out.json").read_text()
    hidden = [one for one in verdict["figures"] if "hidden" in one["name"]]
    assert len(hidden) == 1
    Path("seed.txt").write_text("ffffffffffffffff" * 4)
    assert cli.main(words) == 2
    assert "seed.txt is not the seed whose hash is published" in capsys.readouterr().err


def test_a_score_that_hangs_on_a_lucky_seed_shows(
    entered: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two standard errors and a half of the difference are chance, more is not: by hand, 100
    episodes of variance 0.04 each, so 2.576 x sqrt(0.08 / 100) = 0.0729."""
    entry = submission.read_entry(ENTRY)
    deviations = np.resize([0.2, -0.2], 100) * np.sqrt(0.99)  # of variance 0.04 with ddof=1
    for drop, holds in ((0.07, True), (0.075, False)):
        claimed = entry.kept[0].training.claimed.solved_reward
        rewards = iter([claimed + deviations, claimed - drop + deviations])
        monkeypatch.setattr(verify, "solved_rewards", lambda *_, of=rewards: next(of))
        verdict = verify.verify(ENTRY, verify.Asked(rescore=False, hidden=1))
        assert verdict.passed is holds, verdict.reasons


def test_training_again(entered: None, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(execute, "SMOKE", QUICK)
        assert cli.main(["verify", str(ENTRY), "--retrain"]) == 0
    assert "re-trained: seed3 was trained again to the same bits" in capsys.readouterr().out


def test_training_again_uses_nothing_of_its_author_s_machine(finished: Path) -> None:
    """A logger would write into the verifier's account, or fail without its package."""
    other_config(finished, "- tensorboard", "- wandb")
    other_config(finished, "checkpoint: 30.0", "checkpoint: 0.0")
    assert submit("one") == 0
    asked = []

    def train(chosen: config.RunConfig) -> None:
        asked.append(chosen)
        raise TsbenchError("enough")

    verify.verify(ENTRY, verify.Asked(rescore=False, train=train))
    assert [(one.loggers, one.checkpoint) for one in asked] == [((), 30.0)]


def test_a_command_that_makes_other_settings_today_is_told(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As after a change of a default, or when an option is gone."""
    assert recipe.remark(RunDirectory(finished)) == ""
    for before, after, said in (
        ("  explore: 0.75", "  explore: 0.5", "makes its settings with method.explore=0.5 added"),
        ("\n", " method.old=1\n", "this version of tsbench refuses its command: "),
    ):
        text = (finished / "config.yaml").read_text()
        (finished / "config.yaml").write_text(text.replace(before, after, 1))
        if "old" in after:
            other_config(finished, "  explore:", "  old: 1\n  explore:")
        run = RunDirectory(finished)
        run.versions_file.write_bytes(
            encode_json(run.versions() | {"configuration": identity_hash(run.settings())})
        )
        assert submit("one", "--hardware", "mine") == 0
        assert said in capsys.readouterr().out
        page.write_site(Path("board"), Path("site"), None, lambda line: None)
        assert said in Path("site/rocket_navigation/mine/index.html").read_text()
        shutil.rmtree("board")


def test_a_run_of_any_method_becomes_an_entry(capsys: pytest.CaptureFixture[str]) -> None:
    """A method without a plan gives an entry, and the pages can be made from that entry."""
    words = ["task=rocket_navigation", "method=monolithic", "budget=smoke"]
    trained(Path("one").absolute(), [*words, "task.budgets.smoke.act=512"])
    assert submit("one") == 0
    assert {path.name for path in (ENTRY / "seed0").iterdir()} == {
        "actions.npz", "config.yaml", "metrics.jsonl", "policy.json", "policy.safetensors",
        "score.json", "versions.json",
    }  # fmt: skip
    run = str(ENTRY / "seed0")
    assert cli.main(["view", run, "--html", "entry.html"]) == 0
    assert cli.main(["report", run, "--html", "report.html"]) == 0
    assert "without a plan" in Path("report.html").read_text()


@pytest.mark.parametrize("entry", KEPT, ids=IDS)
def test_every_flipped_byte_is_noticed(entry: Path, tmp_path: Path) -> None:
    """40 random bytes, over all files of an entry. The message names the file."""
    rng = np.random.default_rng(0)
    copy = tmp_path / entry.parent.name / entry.name
    shutil.copytree(entry, copy)
    files = sorted(path for path in copy.rglob("*") if path.is_file())
    submission.read_entry(copy)
    noticed = 0
    for number in range(40):
        file = files[number % len(files)]
        content = file.read_bytes()
        changed = bytearray(content)
        changed[int(rng.integers(len(content)))] ^= int(rng.integers(1, 256))
        file.write_bytes(changed)
        with pytest.raises(TsbenchError, match=str(file.relative_to(copy))):
            submission.read_entry(copy)
        noticed += 1
        file.write_bytes(content)
    assert noticed == 40


@pytest.mark.parametrize(
    "entry",
    [entry for entry in KEPT if entry.name == "twostage"],
    ids=lambda entry: entry.parent.name,
)
def test_an_entry_of_each_task_is_verified(entry: Path) -> None:
    """One training of every other entry is replayed in tests/evaluation/test_entries.py, and
    `tsbench verify --all` verifies all of them."""
    verdict = verify.verify(entry, verify.Asked(rescore=False, threads=1))
    assert verdict.passed, verdict.reasons


# Pull requests


def git(*words: str) -> str:
    identity = ["-c", "user.name=A", "-c", "user.email=a@example.org"]
    done = subprocess.run(["git", "-C", "repo", *identity, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def repository(finished: Path) -> str:
    """A repository with one file in main, a submission in HEAD; the commit of main."""
    Path("repo").mkdir()
    git("init", "-q", "-b", "main")
    Path("repo/README.md").write_text("hello\n")
    git("add", "-A")
    git("commit", "-q", "-m", "main")
    base = git("rev-parse", "HEAD")
    git("checkout", "-q", "-b", "entry")
    board = "repo/leaderboards"
    who = [word.replace("board", board) if word == "board" else word for word in WHO]
    assert cli.main(["submit", "one", "--name", "mine", *who]) == 0
    shutil.move("repo/leaderboards/quick", "repo/leaderboards/v1")
    git("add", "-A")
    git("commit", "-q", "-m", "entry")
    return base


def link(path: Path) -> None:
    path.unlink()
    path.symlink_to("/etc/hostname")


def check(base: str) -> int:
    Path("comment.md").unlink(missing_ok=True)
    return cli.main(["verify", "--pull-request", base, "--in", "repo", "--comment", "comment.md"])


def test_a_pull_request_that_is_a_submission(
    repository: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check(repository) == 0
    comment = Path("comment.md").read_text()
    assert "| seed | figure | claimed | verified | difference |" in comment
    assert "| 3 | solved_reward |" in comment
    assert "re-scored, passed" in comment


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda: Path("repo/README.md").write_text("bye\n"), "'README.md' is changed"),
        (lambda: Path("repo/README.md").unlink(), "'README.md' is changed"),
        (lambda: Path("repo/setup.py").write_text("x"), "'setup.py' is no file of an entry"),
        (
            lambda: Path("repo/leaderboards/v1/rocket_navigation/mine/seed3/run.py").touch(),
            "run.py' is no file of an entry",
        ),
        (
            lambda: Path("repo/leaderboards/v1/rocket_navigation/mine/.gitattributes").touch(),
            ".gitattributes' is no file of an entry",
        ),
        (
            lambda: shutil.copytree("repo/leaderboards/v1", "repo/leaderboards/v2"),
            "v2/rocket_navigation/mine/manifest.json' is no file of an entry",
        ),
        (
            lambda: link(Path("repo/leaderboards/v1/rocket_navigation/mine/manifest.json")),
            "has mode 120000",
        ),
        (
            lambda: Path("repo/leaderboards/v1/rocket_navigation/mine/manifest.json").chmod(0o755),
            "has mode 100755",
        ),
    ],
)
def test_a_pull_request_that_changes_something_else(
    repository: str, change: Callable[[], object], fault: str
) -> None:
    change()
    git("add", "-A")
    git("commit", "-q", "-m", "more")
    assert check(repository) == 1
    comment = Path("comment.md").read_text()
    assert "Not verified" in comment
    assert fault.replace("'", "&#39;") in comment


def test_the_script_of_the_workflow(repository: str) -> None:
    """As the workflow calls it, on an entry of the repository's own."""
    run = min(BOARD.glob("v1/*/*/seed*"), key=lambda run: (run / "actions.npz").stat().st_size)
    described = Described("theirs", ("A. Person",), "MIT")
    board = Path("repo/leaderboards").absolute()
    submission.place(submission.pack([run], described, board, V1, score=evaluate), board, V1, [])
    git("checkout", "-q", "-b", "theirs", repository)
    git("add", str(board / "v1" / RunDirectory(run).record().task / "theirs"))
    git("commit", "-q", "-m", "theirs")
    script = BOARD.parent / ".ci" / "verify_submission"
    done = subprocess.run(
        [script, "repo", repository, "comment.md", "--quick", "--threads", "1"],
        env={**os.environ, "PYTHON": sys.executable, "PYTHONPATH": str(BOARD.parent)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr + done.stdout
    assert "theirs: replayed, passed" in Path("comment.md").read_text()


def test_the_workflow_that_sees_a_submission_has_no_rights() -> None:
    folder = BOARD.parent / ".github" / "workflows"
    verifies = yaml.safe_load((folder / "submission.yml").read_text())
    assert verifies["permissions"] == {"contents": "read"}
    assert "pull_request" in verifies[True]  # YAML reads the key `on` as true
    text = (folder / "submission.yml").read_text()
    assert "${{ secrets" not in text
    assert "pull_request_target" not in text
    comments = yaml.safe_load((folder / "submission-comment.yml").read_text())
    assert comments[True]["workflow_run"]["workflows"] == [verifies["name"]]
    assert not any("uses" in step for step in comments["jobs"]["comment"]["steps"])


GH = """#!/bin/sh
echo "$@" >> calls
case "$*" in
  *pulls/7/files*) test -z "$BROKEN" || exit 1; cat files ;;
  *pulls/7\\ *|*pulls/7) cat count ;;
  *repos/a/b/pulls*) echo 7 ;;
  *comments*) cp comment.md posted ;;
esac
"""


@pytest.mark.parametrize(
    ("files", "count", "found", "posted"),
    [
        ("", "8", "verified", "verified"),
        ("", "8", None, "Not verified: the verifier did not finish, see URL\n"),
        ("setup.py\n", "8", "evil", "Not verified: a submission only adds files"),
        ("", "2001", "evil", "Not verified: a submission only adds files"),
        ("", "", "of another head", None),
        (None, "8", "evil", None),
    ],
)
def test_the_steps_of_the_comment(
    tmp_path: Path, files: str | None, count: str, found: str | None, posted: str | None
) -> None:
    """Run by bash as GitHub runs them, with a program in the place of `gh` whose filters have
    been applied. Without `files` it fails to list them."""
    path = BOARD.parent / ".github" / "workflows" / "submission-comment.yml"
    find, _, comment = yaml.safe_load(path.read_text())["jobs"]["comment"]["steps"]
    Path("bin").mkdir()
    Path("bin/gh").write_text(GH)
    Path("bin/gh").chmod(0o755)
    Path("files").write_text(files or "")
    Path("count").write_text(count)
    if found is not None:
        Path("found").mkdir()
        Path("found/comment.md").write_text(found)
    given = {"REPOSITORY": "a/b", "HEAD": "c:d", "HEAD_SHA": "e", "RUN_URL": "URL"}
    paths = {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "GITHUB_OUTPUT": "output"}
    broken = {"BROKEN": "yes"} if files is None else {}
    bash = ["bash", "-e", "-c"]
    done = subprocess.run([*bash, find["run"]], env=given | paths | broken)
    assert (done.returncode == 0) == (files is not None)
    output = Path("output").read_text() if Path("output").exists() else ""
    said = dict(line.split("=") for line in output.splitlines())
    if "number" in said:
        values = {"NUMBER": said["number"], "CLEAN": said["clean"]}
        subprocess.run([*bash, comment["run"]], env=given | paths | values, check=True)
    assert Path("posted").exists() == (posted is not None)
    if posted is not None:
        assert Path("posted").read_text().startswith(posted)


def test_a_comment_is_nothing_but_text() -> None:
    reason = "@everyone <img src=x> [a](javascript:b) | `c` **d**\n# e"
    verdict = verify.Verdict("v1/a/b", "", "", False, (reason,), (), 1.0)
    last = verify.comment([verdict], []).splitlines()[-1]
    assert last.startswith("- ")
    assert not set(last[2:]) & set("@<>[]|`*!")
