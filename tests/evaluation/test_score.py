"""What Python shows of results: one short line each, not their whole content."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import tsbench
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.evaluation.words import reference_rows
from tsbench.leaderboard import kept
from tsbench.runs import progress
from tsbench.runs.directory import Record, RunDirectory

TASK = "rocket_navigation"


def test_a_score_is_one_line(invented_record: Callable[[str], Record]) -> None:
    score = invented_record(TASK).score
    assert str(score) == (
        "<Score of rocket_navigation, protocol smoke: SOLVED 40 of 100, solved_reward 0.004, "
        "normalized_reward 0.01, against_plan 0.125, survival_100N 25.0%>"
    )


def test_parts_of_a_score_leave_out_their_lists(invented_record: Callable[[str], Record]) -> None:
    score = invented_record(TASK).score
    for part in (score.perturbed, score.robustness, score.robustness.surface):
        assert len(repr(part)) < 500
        assert "((" not in repr(part)


def test_motions_and_policies_are_one_line(
    naive_plan: Callable[[str], Plan], naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    assert repr(naive_plan(TASK)).startswith(f"<Plan of {TASK}: states (")
    assert repr(naive_reference(TASK)).startswith(f"<ReferenceMotion of {TASK}: qpos (")
    entry = kept.trainings(kept.entries()["laikago_trot/twostage"])[0]
    policy = RunDirectory(entry).policy()
    assert repr(policy).startswith("<Policy of twostage for laikago_trot: 43 to ")
    for one in (naive_plan(TASK), naive_reference(TASK), policy):
        assert "\n" not in repr(one)
        assert len(repr(one)) < 200


def test_references_stand_beside_a_score_of_the_same_constants(
    invented_record: Callable[[str], Record],
) -> None:
    rows = {name: (reward, success) for name, reward, success in
            reference_rows(invented_record(TASK).score)}  # fmt: skip
    assert rows.keys() == {"oracle, the best plan", "policy random", "policy zero"}
    assert rows["policy zero"][1] == "0"
    assert float(rows["oracle, the best plan"][0]) > 0.1


@pytest.mark.parametrize("shown", [True, False])
def test_python_sees_the_progress(shown: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    shares: list[float] = []

    @contextmanager
    def bar(console: Any, what: str, shown: bool = True) -> Iterator[Callable[[float], None]]:
        yield shares.append if shown else lambda share: None

    monkeypatch.setattr(progress, "progress_bar", bar)
    score = tsbench.evaluate("zero", TASK, protocol="smoke", threads=1, progress=shown)
    assert score.perturbed.episodes == 10
    assert bool(shares) == shown
    assert shares == sorted(shares)
    assert not shares or 0.1 < shares[-1] <= 1.0
