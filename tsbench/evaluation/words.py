"""What a score says, in words that need no explanation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tsbench.core.task import Task
from tsbench.core.words import number
from tsbench.evaluation.references import beside
from tsbench.evaluation.score import Score, Summary

FIGURES = {  # what each says, in words
    "solved_reward": "the reward as a share of the largest possible, 0 where not solved",
    "normalized_reward": "the same, solved or not",
    "against_plan": "the reward over that of the best plan; a policy may pass 1",
    "success": "share of the episodes that were solved",
}


def verdict(summary: Summary) -> str:
    """In capitals: how many episodes were solved."""
    return f"SOLVED {counts(summary)[0]} of {summary.episodes}"


def episode_rows(score: Score, task: Task[Any]) -> Iterator[tuple[str, str, str]]:
    """Labels, and values from perturbed starts and from the task's own."""
    own, other = score.nominal, score.perturbed
    yield "solved_reward", number(score.solved_reward), number(own.solved_reward)
    yield "normalized_reward", number(score.normalized_reward), number(own.normalized_reward)
    yield "against_plan", number(score.against_plan), ""
    yield "success", number(other.success), number(own.success)
    for name, value in other.measures.items():
        yield name, number(value), number(own.measures[name])
    yield f"spoiled by {task.mishap}", number(other.violations), number(own.violations)
    yield "steps", number(other.steps), number(own.steps)
    yield "distance at the end, m", number(other.goal_distance), number(own.goal_distance)


def push_rows(score: Score) -> Iterator[tuple[str, str, str]]:
    """Labels, and values of survival and of recovery."""
    robustness = score.robustness
    yield (
        f"of {claim_force(score):.3g} N (survival_100N, recovery_100N)",
        f"{robustness.survival_100N:.1%}",
        f"{robustness.recovery_100N:.1%}",
    )
    for name, row in beside(score).items():
        share, solved = row["survival_100N"], row["recovery_100N"]
        yield f"  by the policy {name}", f"{share:.1%}", f"{solved:.1%}"
    yield "withstood by half (impulse_50)", *_impulses(score)


def _impulses(score: Score) -> tuple[str, str]:
    """The impulses that half of the pushes survive and recover from, in words."""
    robustness = score.robustness
    return (
        _impulse(robustness.survival_impulse_50, robustness.survival_impulse_50_is_lower_bound),
        _impulse(robustness.recovery_impulse_50, robustness.recovery_impulse_50_is_lower_bound),
    )


def _impulse(value: float, is_lower_bound: bool) -> str:
    return f"{'over ' if is_lower_bound else ''}{number(value)} N s"


def summary(score: Score, task: Task[Any]) -> list[tuple[str, str]]:
    """Labels and values of a score in short, in words that need no explanation."""
    perturbed = score.perturbed
    solved, spoiled = counts(perturbed)
    return [
        ("solved from other starts", f"{solved} of {perturbed.episodes}"),
        *((name, number(value)) for name, value in perturbed.measures.items()),
        (f"spoiled by {task.mishap}", f"{spoiled} of {perturbed.episodes}"),
        ("share of the largest possible reward", f"{score.normalized_reward:.1%}"),
        ("the same, only where it was solved", f"{score.solved_reward:.1%}"),
        ("reward over that of the best plan", number(score.against_plan)),
        *pushes(score),
    ]


def pushes(score: Score) -> list[tuple[str, str]]:
    """Labels and values of its robustness in short."""
    robustness = score.robustness
    survival, recovery = _impulses(score)
    force = f"{claim_force(score):.3g} N"
    return [
        (f"pushes of {force} survived", f"{robustness.survival_100N:.0%}"),
        *(
            (f"  the same by the policy {name}", f"{row['survival_100N']:.0%}")
            for name, row in beside(score).items()
        ),
        (f"pushes of {force} survived and solved", f"{robustness.recovery_100N:.0%}"),
        ("impulse that half of the pushes survive", survival),
        ("impulse at which half survive and solve", recovery),
    ]


def claim_force(score: Score) -> float:
    """Newtons of the pushes of `survival_100N` on this task's body."""
    return score.origin.protocol.claim * score.robustness.mass_scale


def counts(summary: Summary) -> tuple[int, int]:
    """Episodes solved, and spoiled on the way."""
    return round(summary.success * summary.episodes), round(summary.violations * summary.episodes)
