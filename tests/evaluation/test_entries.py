"""The entries that are kept in leaderboards/, whichever there are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsbench import record, tasks
from tsbench.evaluation.evaluate import check_fit, evaluate, perturbed_starts
from tsbench.evaluation.protocol import PROTOCOLS
from tsbench.evaluation.replay import compare, episode_starts, replay
from tsbench.motion import Plan, ReferenceMotion

BOARDS = Path(__file__).parents[2] / "leaderboards"
ENTRIES = sorted(path.parent for path in BOARDS.glob("v1/*/*/*/policy.json"))
NAMES = [str(entry.relative_to(BOARDS)) for entry in ENTRIES]


def test_entries_are_of_tasks() -> None:
    assert {entry.parts[-3] for entry in ENTRIES} == set(tasks.names())
    assert ENTRIES


@pytest.mark.parametrize("entry", ENTRIES, ids=NAMES)
def test_an_entry_holds_together(entry: Path) -> None:
    assert {path.name for path in entry.iterdir()} == {*record.KEPT, record.ACTIONS}
    policy, task = record.read_policy(entry)
    check_fit(policy, task)
    assert tasks.standard(task)
    content = record.read_score(entry)
    assert (content["task"], content["method"]) == entry.parts[-3:-1] == (
        policy.info.task, policy.info.method,
    )  # fmt: skip
    score = content["score"]
    assert PROTOCOLS[score["protocol"]].ranked
    assert score["origin"]["policy"] == policy.info.sha256
    assert (entry / record.CONFIG).read_text().startswith("# tsbench run ")
    assert Plan.load(entry / record.PLAN).task == task.name
    assert ReferenceMotion.load(entry / record.REFERENCE).task == task.name
    assert score["success"] == 1.0


@pytest.mark.parametrize("entry", ENTRIES, ids=NAMES)
def test_an_entry_repeats(entry: Path) -> None:
    """The physics from the action log, and the policy's own episode."""
    policy, task = record.read_policy(entry)
    score: dict[str, Any] = record.read_score(entry)["score"]
    protocol = PROTOCOLS[score["protocol"]]
    log = record.read_actions(entry)
    assert log is not None
    starts = episode_starts(task, perturbed_starts(task, protocol))
    again = evaluate(policy, task, protocol=PROTOCOLS["smoke"], threads=1).as_dict()
    same_machine = again["origin"]["packages"] == score["origin"]["packages"] and (
        again["origin"]["machine"] == score["origin"]["machine"]
    )
    for name in ("task_version", "constants", "model"):  # else it is never compared again
        assert again["origin"][name] == score["origin"][name]
    if again["origin"]["packages"]["mujoco"] == score["origin"]["packages"]["mujoco"]:
        assert replay(task, starts, log)
    if same_machine:
        assert again["nominal"] == score["nominal"]
    assert again["nominal"]["normalized_reward"] == pytest.approx(
        score["normalized_reward"], abs=protocol.tolerance
    )
    assert compare(score, again, protocol, task, starts, log).kind == "none"  # other protocols


@pytest.mark.parametrize("entry", ENTRIES, ids=NAMES)
def test_the_surface_fits_its_summary(entry: Path) -> None:
    robustness = record.read_score(entry)["score"]["robustness"]
    surface = robustness["surface"]
    survived = np.array(surface["survived"])
    assert survived.shape == tuple(
        len(surface[name]) for name in ("forces_N", "headings_rad", "phases")
    )
    at_claim = np.isclose(surface["forces_N"], 100.0 * robustness["mass_scale"])
    assert survived[at_claim].mean() == robustness["survival_100N"]
