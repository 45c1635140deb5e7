"""The entries that are kept in leaderboards/, whichever there are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tsbench import tasks
from tsbench.evaluation.evaluate import check_fit, evaluate
from tsbench.evaluation.protocol import PROTOCOLS, SMOKE
from tsbench.evaluation.replay import compare, replay
from tsbench.leaderboard import submission
from tsbench.runs.directory import RunDirectory

BOARDS = Path(__file__).parents[2] / "leaderboards"
ENTRIES = sorted(path.parent for path in BOARDS.glob("v1/*/*/*/policy.json"))
NAMES = [str(entry.relative_to(BOARDS)) for entry in ENTRIES]
# Changed physics and pushes are played as little as can be: nothing is asked of them here.
STARTS = replace(SMOKE, conditions=(), headings=1, phases=100, forces=(100.0,))
# A training of each entry.
FIRST = list({path.parent: path for path in reversed(ENTRIES)}.values())


def test_entries_are_of_tasks() -> None:
    assert ENTRIES
    assert {entry.parts[-3] for entry in ENTRIES} <= set(tasks.names())


@pytest.mark.parametrize("entry", ENTRIES, ids=NAMES)
def test_an_entry_holds_together(entry: Path) -> None:
    run = RunDirectory(entry)
    assert submission.NEEDED.keys() <= {path.name for path in entry.iterdir()}
    assert {path.name for path in entry.iterdir()} <= submission.LIMITS.keys()
    policy = run.policy()
    task = run.task(policy.info.task)
    check_fit(policy, task)
    assert tasks.standard(task)
    content = run.record()
    assert entry.parts[-3] == content.task == policy.info.task
    assert content.method == policy.info.method
    score = content.score
    assert content.standard
    assert score.origin.protocol == PROTOCOLS[entry.parts[-4]]
    assert score.origin.protocol.ranked
    assert score.origin.policy == policy.info.sha256
    assert run.config_file.read_text().startswith("# tsbench run ")
    for motion in (run.plan(task), run.reference(task)):
        assert motion is None or motion.task == task.name


@pytest.mark.parametrize("name", tasks.names())
def test_the_best_entry_of_a_task_solves_it(name: str) -> None:
    """Entries of baselines may fail, and are kept as they are."""
    scores = [RunDirectory(entry).record().score for entry in ENTRIES if entry.parts[-3] == name]
    best = max(scores, key=lambda score: score.solved_reward)
    assert best.success >= 0.95
    # The paper's claim. A faster policy may arrive before some of the pushes, which are then no
    # pushes that it survived.
    good = [score.robustness.survival_100N for score in scores if score.success >= 0.95]
    assert max(good) >= 0.99


@pytest.mark.parametrize("entry", FIRST, ids=lambda path: str(path.relative_to(BOARDS)))
def test_an_entry_repeats(entry: Path) -> None:
    """The physics from the action log, and the policy's own episode. `tsbench verify --all` does
    more for every training."""
    policy = RunDirectory(entry).policy()
    task = RunDirectory(entry).task(policy.info.task)
    score = RunDirectory(entry).record().score
    log = RunDirectory(entry).actions(task)
    assert log is not None
    again = evaluate(policy, task, protocol=STARTS, threads=1)
    then, now = score.origin, again.origin
    for name in ("task_version", "constants", "mjcf"):  # else it is never compared again
        assert getattr(now, name) == getattr(then, name)
    if now.packages["mujoco"] == then.packages["mujoco"]:
        assert now.model == then.model
        assert replay(task, score, log)
    if (now.packages, now.machine) == (then.packages, then.machine):
        assert again.nominal == score.nominal
    # Of ten starts, whose mean says little where some of them end in falls.
    near = 0.5 if score.perturbed.violations else 0.1
    assert again.against_plan == pytest.approx(score.against_plan, abs=near)
    assert compare(score, again, task, log).kind == "none"  # other protocols


@pytest.mark.parametrize("entry", ENTRIES, ids=NAMES)
def test_the_surface_fits_its_summary(entry: Path) -> None:
    robustness = RunDirectory(entry).record().score.robustness
    surface = robustness.surface
    at_claim = np.isclose(surface.forces_N, 100.0 * robustness.mass_scale)
    assert np.array(surface.survived)[at_claim].mean() == robustness.survival_100N
    assert np.array(surface.recovered)[at_claim].mean() == robustness.recovery_100N
