"""Verdicts that depend on the physics engine, counted by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tsbench.evaluation.flips import Flips, flips
from tsbench.evaluation.score import Score
from tsbench.runs.directory import Record


def test_flips_by_hand(invented_record: Callable[[str], Record]) -> None:
    """Of 100 perturbed starts 40 are solved; of 16 pushes 10 survived and 7 recovered from."""
    score = invented_record("laikago_trot").score
    assert [one.flipped for one in flips(score, score)] == [0, 0, 0, 0, 0]
    surface = score.robustness.surface
    fewer = replace(surface, recovered=(((1, 1, 1, 0), (1, 1, 0, 0)), ((0, 0, 1, 0), (0,) * 4)))
    solved = (0,) + (1,) * 40 + (0,) * 59  # as many, but for two others
    other: Score = replace(
        score,
        perturbed=replace(score.perturbed, solved=solved),
        changes={"mass x 0.8": replace(score.nominal, solved=(1,), success=1.0)},
        robustness=replace(score.robustness, surface=fewer),
    )
    expected = (
        Flips("solved, task's own start", 0, 1, 0.0),
        Flips("solved, perturbed starts", 2, 100, 0.02),
        Flips("solved, changed physics", 1, 1, 1.0),
        Flips("survived, pushes", 0, 16, 0.0),
        Flips("recovered, pushes", 3, 16, 3 / 16),
    )
    assert flips(score, other) == flips(other, score) == expected


def test_without_changed_physics_there_is_nothing_to_flip(
    invented_record: Callable[[str], Record],
) -> None:
    score = replace(invented_record("rocket_navigation").score, changes={})
    assert "solved, changed physics" not in {one.verdict for one in flips(score, score)}
