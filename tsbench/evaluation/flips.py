"""Counts the verdicts of a score that change when the protocol is played in other physics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tsbench.evaluation.score import Score


@dataclass(frozen=True)
class Flips:
    """Attributes:
    verdict: the kind of verdict and the judged episodes, such as "solved, perturbed starts".
    flipped: number of verdicts that differ between the two physics.
    verdicts: number of verdicts of this kind.
    share: flipped / verdicts.
    """

    verdict: str
    flipped: int
    verdicts: int
    share: float


def flips(certified: Score, other: Score) -> tuple[Flips, ...]:
    """Counts the verdicts that differ, episode by episode and push by push.

    Args:
        certified: the score of a policy by a protocol.
        other: the score of the same policy by the same protocol in other physics
            (`Protocol.elsewhere`).
    """
    first, second = _verdicts(certified), _verdicts(other)
    return tuple(
        Flips(
            name,
            flipped=int((first[name] != second[name]).sum()),
            verdicts=len(first[name]),
            share=float((first[name] != second[name]).mean()),
        )
        for name in first
        if len(first[name])
    )


def _verdicts(score: Score) -> dict[str, np.ndarray]:
    surface = score.robustness.surface
    changes = [one for name in sorted(score.changes) for one in score.changes[name].solved]
    return {
        "solved, task's own start": np.array(score.nominal.solved),
        "solved, perturbed starts": np.array(score.perturbed.solved),
        "solved, changed physics": np.array(changes),
        "survived, pushes": np.ravel(surface.survived),
        "recovered, pushes": np.ravel(surface.recovered),
    }
