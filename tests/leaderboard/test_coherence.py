"""Whether the files in which a run tells of its own training contradict each other."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tsbench.core.errors import TsbenchError
from tsbench.core.files import encode_json
from tsbench.leaderboard import coherence
from tsbench.runs import config
from tsbench.runs.directory import RunDirectory, Stage, overspent
from tsbench.runs.schema import encode, identity_hash

BOARD = Path(__file__).parents[2] / "leaderboards"
KEPT = sorted(path.parent for path in BOARD.glob("v1/*/*/seed*/config.yaml"))
ROCKET = min((BOARD / "v1" / "rocket_obstacles" / "twostage").glob("seed*"))
SEED = ROCKET.name.removeprefix("seed")
Change = Callable[[RunDirectory], object]


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    shutil.copytree(ROCKET, tmp_path / "run")
    return RunDirectory(tmp_path / "run")


def check(run: RunDirectory) -> None:
    record = run.record()
    coherence.check(run, record, run.task(record.task))


def text(name: str, before: str, after: str) -> Change:
    def change(run: RunDirectory) -> None:
        file = run.path / name
        assert before in file.read_text()
        file.write_text(file.read_text().replace(before, after, 1))

    return change


def versions(**changes: Any) -> Change:
    """Other values of versions.json, or none for a value of None."""

    def change(run: RunDirectory) -> None:
        values = {**run.versions(), **changes}
        for name in [name for name, value in changes.items() if value is ...]:
            del values[name]
        run.versions_file.write_bytes(encode_json(values))

    return change


def hashed(change: Change) -> Change:
    """Another configuration, for which versions.json is then written."""

    def changed(run: RunDirectory) -> None:
        change(run)
        versions(configuration=identity_hash(run.settings()))(run)

    return changed


def command(words: str) -> Change:
    return lambda run: run.config_file.write_bytes(encode(run.settings(), words))


def stage(**changes: Any) -> Change:
    def change(run: RunDirectory) -> None:
        content = json.loads(run.score_file.read_text())
        content["stages"][1] |= changes
        run.score_file.write_bytes(encode_json(content))

    return change


@pytest.mark.parametrize("path", KEPT, ids=lambda path: "-".join(path.parts[-3:]))
def test_what_tsbench_has_written_is_coherent(path: Path) -> None:
    check(RunDirectory(path))


@pytest.mark.parametrize(
    ("change", "file", "fault"),
    [
        # One file changed alone.
        (
            text("config.yaml", "act: 4000000", "act: 4000001"),
            "versions.json",
            "the hash of another",
        ),
        (
            text("config.yaml", "discount: 0.9", "discount: 0.8"),
            "versions.json",
            "the hash of another",
        ),
        (versions(configuration="0" * 64), "versions.json", "the hash of another"),
        (text("config.yaml", "rollout: 16", "rollout: 2026-01-01"), "versions.json", "of another"),
        (versions(code="0" * 63), "versions.json", "code cannot be '0000"),
        (versions(code=None), "versions.json", "code cannot be None"),
        (versions(commit="main"), "versions.json", "commit cannot be 'main'"),
        (versions(python="three"), "versions.json", "python cannot be 'three'"),
        (versions(platform=""), "versions.json", "platform cannot be ''"),
        (versions(platform="\x1b[2J"), "versions.json", "platform cannot be"),
        (versions(packages={"mujoco": 3}), "versions.json", "packages cannot be"),
        (versions(physics={"rocket_obstacles": "0" * 64}), "versions.json", "not the model of"),
        (versions(physics={}), "versions.json", "not the model of rocket_obstacles"),
        (versions(device={"gpu": "H100"}), "versions.json", "names a device"),
        (versions(processes=1), "versions.json", "processes cannot be 1"),
        (versions(platform=...), "versions.json", "it has no platform"),
        (versions(note="hello"), "versions.json", "a key 'note'"),
        (stage(physics_substeps=5), "score.json", "5 physics steps in 4,001,792 steps"),
        (stage(seconds=-1.0), "score.json", "negative"),
        (stage(warnings={"x": -1}), "score.json", "negative"),
        # Text that no reader sees.
        (text("config.yaml", "\ntask:", "\n# tuned on the test\ntask:"), "config.yaml", "written"),
        (text("config.yaml", "constants: {}", "constants: { }"), "config.yaml", "written"),
        (text("versions.json", '"code": ', '"code":  '), "versions.json", "not written as"),
        (text("policy.json", '"task": ', '"task":  '), "policy.json", "not written as"),
        (text("score.json", '"standard": ', '"standard":\t'), "score.json", "not written as"),
        # Two files that fit, and a command that asks for something else.
        (
            hashed(text("config.yaml", f"seed: {SEED}", "seed: 77")),
            "config.yaml",
            f"says 'seed={SEED}', the",
        ),
        (hashed(text("config.yaml", "discount: 0.999", "discount: 0.9")), "", ""),
        (command("tsbench run method=prm"), "config.yaml", "'method=prm', the value is 'twostage'"),
        (command("tsbench run task.budgets.paper.act=5_000_000"), "config.yaml", "is 4000000"),
        (command("tsbench run method.plans=3"), "config.yaml", "there is no such value"),
        (command("rm -rf /"), "config.yaml", "no command of tsbench run: 'rm -rf /'"),
        (command(f"tsbench run 'seed={SEED}"), "config.yaml", "its first line is no command"),
        # Words that cannot be judged, or that change no result.
        (command("tsbench run 'method.plans=[1, 2]' threads=7 hydra.verbose=true"), "", ""),
        (command(f"tsbench run seed={SEED} task.budgets.paper.act=4e6 +seed={SEED}"), "", ""),
    ],
)
def test_a_contradiction_is_told(run: RunDirectory, change: Change, file: str, fault: str) -> None:
    change(run)
    if not fault:
        check(run)
        return
    with pytest.raises(TsbenchError) as error:
        check(run)
    assert str(error.value).startswith(str(run.path / file))
    assert fault in str(error.value)


def test_a_run_without_a_configuration_is_coherent(run: RunDirectory) -> None:
    run.config_file.unlink()
    run.versions_file.unlink()
    check(run)


def spent(run: RunDirectory, more: int) -> None:
    """Lets the stage in physics have taken so many steps more than the budget has for both."""
    stages = json.loads(run.score_file.read_text())["stages"]
    budget = run.config().task.budgets["paper"]
    steps = budget.plan + budget.act + more - stages[0]["steps"]
    substeps = stages[1]["physics_substeps"] // stages[1]["steps"] * steps
    stage(steps=steps, physics_substeps=substeps)(run)


def test_the_processes_of_a_run_are_those_that_it_names(run: RunDirectory) -> None:
    """512 * 24 steps for each of two stages, and of two processes twice as many."""
    spent(run, 2 * 512 * 24)
    check(run)
    spent(run, 2 * 512 * 24 + 1)
    with pytest.raises(TsbenchError, match=r"score\.json: 5,024,577 steps used, where the budget"):
        check(run)
    versions(processes=2)(run)
    check(run)


@pytest.mark.parametrize("rollout", ["true", "x", "[1]", "-5", "1e3", "null"])
def test_a_rollout_that_is_no_count_allows_nothing(run: RunDirectory, rollout: str) -> None:
    """It is another configuration than the one that versions.json names, which is told."""
    hashed(text("config.yaml", "rollout: 16", f"rollout: {rollout}"))(run)
    spent(run, 10**6)
    with pytest.raises(TsbenchError, match="6,000,000 steps used, where the budget paper has"):
        check(run)


@pytest.mark.parametrize(
    ("words", "budgets", "processes", "most"),
    [
        # A kind without settings has the defaults, 512 * 24; the others have 4,096 or fewer.
        ("budget=paper method=monolithic", [2_000_000], 1, 2_000_000 + 512 * 24),
        ("budget=paper method=monolithic", [2_000_000], 3, 2_000_000 + 3 * 512 * 24),
        (
            "budget=paper method=monolithic task.training.task.repeat=8",
            [2 * 10**6],
            1,
            2 * 10**6 + 32 * 128 * 8,
        ),
        # Fine-tuning has the environments of the imitation, 32, and its repeated actions, 4.
        (
            "budget=paper method=prm task.training.finetune.rollout=100",
            [10**6],
            1,
            2 * 10**6 + 32 * 100 * 4,
        ),
        # The smoke budget has 16 environments: 16 * 32 * 4 of the imitation are most.
        ("method=twostage budget=smoke", [4096, 8192], 1, 12_288 + 2 * 16 * 32 * 4),
        # No stage doubles its budget, however large an iteration may be that it may not even have.
        ("budget=paper method=prm", [999_900, 100], 1, 2_000_000 + 512 * 24 + 100),
        (
            "budget=paper method=monolithic task.training.plan.rollout=1000000000",
            [2 * 10**6],
            1,
            4 * 10**6,
        ),
    ],
)
def test_what_a_budget_allows(words: str, budgets: list[int], processes: int, most: int) -> None:
    chosen = config.compose(["task=rocket_navigation", *words.split()])

    def stages(steps: int) -> list[Stage]:
        first = [Stage(f"stage{i}", budget) for i, budget in enumerate(budgets[1:])]
        return [*first, Stage("last", budgets[0], steps=steps)]

    assert overspent(stages(most), chosen, processes) == ""
    assert f"{most + 1:,} steps used, where the budget" in overspent(
        stages(most + 1), chosen, processes
    )
    more = [*stages(0), Stage("another", 2_000_001)]
    assert overspent(more, chosen, processes).startswith("stages of ")
