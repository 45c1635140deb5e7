"""What a score says, in words that need no explanation."""

from __future__ import annotations

from tsbench.core.words import number
from tsbench.evaluation.score import Score, Summary


def summary(score: Score) -> list[tuple[str, str]]:
    """Labels and values of a score in short, in words that need no explanation."""
    perturbed = score.perturbed
    solved, spoiled = counts(perturbed)
    return [
        ("of the largest possible reward", f"{score.normalized_reward:.1%}"),
        ("of the best motion at the planner's speed", f"{score.optimality:.1%}"),
        ("solved from other starts", f"{solved} of {perturbed.episodes}"),
        ("falls and collisions there", f"{spoiled} of {perturbed.episodes}"),
        *pushes(score),
    ]


def pushes(score: Score) -> list[tuple[str, str]]:
    """Labels and values of its robustness in short."""
    robustness = score.robustness
    bound = "over " if robustness.impulse_50_is_lower_bound else ""
    return [
        (f"pushes of {claim_force(score):.3g} N survived", f"{robustness.survival_100N:.0%}"),
        ("impulse that half survive", f"{bound}{number(robustness.impulse_50)} N s"),
    ]


def claim_force(score: Score) -> float:
    """Newtons of the pushes of `survival_100N` on this task's body."""
    return score.origin.protocol.claim * score.robustness.mass_scale


def counts(summary: Summary) -> tuple[int, int]:
    """Episodes solved, and spoiled on the way."""
    return round(summary.success * summary.episodes), round(summary.violations * summary.episodes)
