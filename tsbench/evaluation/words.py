"""A score in words that need no explanation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tsbench.core.task import Task
from tsbench.core.words import number
from tsbench.evaluation.references import beside, comparable
from tsbench.evaluation.score import Score, Summary

FIGURES = {  # the meaning of each figure
    "solved_reward": "reward as a share of the largest possible, 0 if unsolved",
    "normalized_reward": "the same share, solved or not",
    "against_plan": "reward over the reward of the best plan; a policy may pass 1",
    "success": "share of solved episodes",
}


def verdict(summary: Summary) -> str:
    """The number of solved episodes, after SOLVED in capitals."""
    return f"SOLVED {counts(summary)[0]} of {summary.episodes}"


def unranked(score: Score, *, standard: bool) -> str:
    """Why a score is never ranked, however its policy was trained; "" for another.

    Args:
        score: of a policy.
        standard: whether the task had its standard constants.
    """
    reasons = [] if standard else ["the task's constants were changed"]
    if not score.origin.protocol.ranked:
        reasons.append(f"protocol {score.protocol} plays too few episodes")
    return " and ".join(reasons)


def episode_rows(score: Score, task: Task[Any]) -> Iterator[tuple[str, str, str]]:
    """Rows of a label, the value from perturbed starts, and the value from the task's own start."""
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


REFERENCES = {  # rows of `evaluation.references` in words
    "oracle": "oracle, the best plan",
    "random": "policy random",
    "zero": "policy zero",
}


def reference_rows(score: Score) -> Iterator[tuple[str, str, str]]:
    """Rows of a reference, its `solved_reward` and its `success`, to compare a score with; none for
    a task without stored references, or with other constants."""
    for name, row in comparable(score).items():
        yield REFERENCES.get(name, name), number(row["solved_reward"]), number(row["success"])


def push_rows(score: Score) -> Iterator[tuple[str, str, str]]:
    """Rows of a label, the value of survival, and the value of recovery."""
    robustness = score.robustness
    yield (
        f"of {claim_force(score):.3g} N (survival_100N, recovery_100N)",
        f"{robustness.survival_100N:.1%}",
        f"{robustness.recovery_100N:.1%}",
    )
    for name, row in beside(score).items():
        share, solved = row["survival_100N"], row["recovery_100N"]
        yield f"  the same with the policy {name}", f"{share:.1%}", f"{solved:.1%}"
    yield "impulse at 50 % (impulse_50)", *_impulses(score)


def _impulses(score: Score) -> tuple[str, str]:
    """The impulses at which half of the pushes are survived and recovered from, in words."""
    robustness = score.robustness
    return (
        _impulse(robustness.survival_impulse_50, robustness.survival_impulse_50_is_lower_bound),
        _impulse(robustness.recovery_impulse_50, robustness.recovery_impulse_50_is_lower_bound),
    )


def _impulse(value: float, is_lower_bound: bool) -> str:
    return f"{'over ' if is_lower_bound else ''}{number(value)} N s"


def summary(score: Score, task: Task[Any]) -> list[tuple[str, str]]:
    """Labels and values of the main figures of a score."""
    perturbed = score.perturbed
    solved, spoiled = counts(perturbed)
    return [
        ("solved from perturbed starts", f"{solved} of {perturbed.episodes}"),
        *((name, number(value)) for name, value in perturbed.measures.items()),
        (f"spoiled by {task.mishap}", f"{spoiled} of {perturbed.episodes}"),
        ("reward, of the largest possible", f"{score.normalized_reward:.1%}"),
        ("the same, unsolved episodes as 0", f"{score.solved_reward:.1%}"),
        ("reward over the best plan's", number(score.against_plan)),
        *pushes(score),
    ]


def pushes(score: Score) -> list[tuple[str, str]]:
    """Labels and values of the main figures of robustness."""
    robustness = score.robustness
    survival, recovery = _impulses(score)
    force = f"{claim_force(score):.3g} N"
    return [
        (f"pushes of {force} survived", f"{robustness.survival_100N:.0%}"),
        *(
            (f"  the same with the policy {name}", f"{row['survival_100N']:.0%}")
            for name, row in beside(score).items()
        ),
        (f"pushes of {force} survived, task solved", f"{robustness.recovery_100N:.0%}"),
        ("impulse at 50 % survived", survival),
        ("impulse at 50 % survived, task solved", recovery),
    ]


def claim_force(score: Score) -> float:
    """Newtons of the pushes of `survival_100N`, on this task's body."""
    return score.origin.protocol.claim * score.robustness.mass_scale


def counts(summary: Summary) -> tuple[int, int]:
    """Numbers of solved episodes and of episodes with a violation."""
    return round(summary.success * summary.episodes), round(summary.violations * summary.episodes)
