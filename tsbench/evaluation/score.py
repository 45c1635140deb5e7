"""The score of a policy on a task."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from tsbench.core.motion import ActionLog
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.robustness import Robustness


@dataclass(frozen=True)
class Summary:
    """Means over episodes.

    Attributes:
        episodes: how many.
        normalized_reward: return over the largest conceivable one.
        solved_reward: the same with every episode that was not solved counted as zero.
        success: share of episodes solved.
        violations: share spoiled on the way: a fall, a collision.
        steps: mean length in control steps.
        goal_distance: mean at the end, in metres.
        measures: the task's own (`Task.measures`), each over the episodes that have it; None
            where none has.
        solved: of each episode, 0 or 1.
    """

    episodes: int
    normalized_reward: float
    solved_reward: float
    success: float
    violations: float
    steps: float
    goal_distance: float
    measures: dict[str, float | None]
    solved: tuple[int, ...]

    def __post_init__(self) -> None:
        if not 1 <= self.episodes < 2**31:
            raise ValueError(f"episodes must be a count, not {self.episodes}")
        for name in ("success", "violations"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1], not {getattr(self, name)}")
        if len(self.solved) != self.episodes or not set(self.solved) <= {0, 1}:
            raise ValueError("solved must be 0 or 1 for each of the episodes")
        if not math.isclose(self.success, float(np.mean(self.solved)), abs_tol=1e-12):
            raise ValueError("success must be the share of solved episodes")


@dataclass(frozen=True)
class Score:
    """Attributes:
    protocol: its name.
    solved_reward: the headline, by which policies are ranked: over the perturbed starts.
    normalized_reward: over the perturbed starts.
    success: share of the perturbed starts solved.
    against_plan: mean return from the perturbed starts over that of the best motion known under
        the planner's speed limits (`Task.ideal`), which do not bind a policy: it may pass 1.
    perturbed: episodes from perturbed starts.
    nominal: the episode from the task's own start.
    changes: episodes in changed physics, by the name of the condition.
    robustness: survival and recovery under pushes.
    origin: what it depends on.
    log: actions to replay the physics from; it is kept in a file of its own.
    """

    protocol: str
    solved_reward: float
    normalized_reward: float
    success: float
    against_plan: float
    perturbed: Summary
    nominal: Summary
    changes: dict[str, Summary]
    robustness: Robustness
    origin: Origin
    log: ActionLog | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("solved_reward", "normalized_reward", "success"):
            if getattr(self, name) != getattr(self.perturbed, name):
                raise ValueError(f"{name} must be that of the perturbed starts")

    def as_dict(self) -> dict[str, Any]:
        """Plain values, all but the log."""
        values = asdict(replace(self, log=None))
        del values["log"]
        return values
