"""The score of a policy on a task."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from tsbench.core.motion import ActionLog
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.robustness import Robustness


@dataclass(frozen=True)
class Summary:
    """Means over episodes.

    Attributes:
        episodes: how many.
        normalized_reward: return over the largest conceivable one.
        success: share of episodes solved, as judged at their end.
        violations: share spoiled on the way: a fall, a collision.
        steps: mean length in control steps.
        goal_distance: mean at the end, in metres.
    """

    episodes: int
    normalized_reward: float
    success: float
    violations: float
    steps: float
    goal_distance: float

    def __post_init__(self) -> None:
        if not 1 <= self.episodes < 2**31:
            raise ValueError(f"episodes must be a count, not {self.episodes}")
        for name in ("success", "violations"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1], not {getattr(self, name)}")


@dataclass(frozen=True)
class Score:
    """Attributes:
    protocol: its name.
    normalized_reward: of the episode from the task's own start.
    optimality: its return over that of the best motion known (`Task.ideal`).
    success: whether that episode was solved, 0 or 1.
    nominal: that episode.
    perturbed: episodes from perturbed starts.
    changes: episodes in changed physics, by the name of the condition.
    robustness: survival under pushes.
    origin: what it depends on.
    log: actions to replay the physics from; it is kept in a file of its own.
    """

    protocol: str
    normalized_reward: float
    optimality: float
    success: float
    nominal: Summary
    perturbed: Summary
    changes: dict[str, Summary]
    robustness: Robustness
    origin: Origin
    log: ActionLog | None = field(default=None, compare=False, repr=False)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, all but the log."""
        values = asdict(replace(self, log=None))
        del values["log"]
        return values
