"""How many verdicts of a score hang on the physics: the same protocol, played in another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tsbench.evaluation.score import Score


@dataclass(frozen=True)
class Flips:
    """Attributes:
    verdict: what was judged, and of what: "solved, perturbed starts".
    flipped: how many of the verdicts are another in the other physics.
    verdicts: how many there are.
    share: flipped of them.
    """

    verdict: str
    flipped: int
    verdicts: int
    share: float


def flips(certified: Score, other: Score) -> tuple[Flips, ...]:
    """The verdicts that differ, episode by episode and push by push.

    Args:
        certified: a score by a protocol.
        other: the same policy's by that protocol in another physics (`Protocol.elsewhere`).
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
