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
        episodes: number of episodes.
        normalized_reward: return over the largest conceivable return.
        solved_reward: the same mean, in which an unsolved episode counts as zero.
        success: share of solved episodes.
        violations: share of episodes with a violation on the way, such as a fall or a collision.
        steps: length in control steps.
        goal_distance: metres from the goal at the end.
        measures: the task's own figures (`Task.measures`). Each is the mean over the episodes that
            have the figure, or None if no episode has it.
        solved: 1 for each solved episode, else 0.
    """

    episodes: int
    normalized_reward: float
    solved_reward: float
    success: float
    violations: float
    steps: float
    goal_distance: float
    measures: dict[str, float | None]
    solved: tuple[int, ...] = field(repr=False)

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
    protocol: name of the protocol.
    solved_reward: `Summary.solved_reward` of the perturbed starts, by which policies are ranked.
    normalized_reward: `Summary.normalized_reward` of the perturbed starts.
    success: share of the perturbed starts that were solved.
    against_plan: mean return from the perturbed starts over the return of the best motion known
        under the planner's speed limits (`Task.ideal`). The limits do not bind a policy, so the
        quotient may pass 1.
    perturbed: episodes from perturbed starts.
    nominal: the episode from the task's own start.
    changes: episodes in changed physics, by the name of the condition.
    robustness: survival and recovery under pushes.
    origin: everything that the score depends on.
    log: the actions from which the physics can be replayed. The log has a file of its own.
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
        if self.nominal.measures.keys() != self.perturbed.measures.keys():
            raise ValueError("nominal.measures must have the names that perturbed.measures has")

    def __repr__(self) -> str:
        """The figures by which policies are compared, on one line; `as_dict` has all of them."""
        solved = round(self.success * self.perturbed.episodes)
        names = ("solved_reward", "normalized_reward", "against_plan")
        figures = [f"{name} {getattr(self, name):.4g}" for name in names]
        figures.append(f"survival_100N {self.robustness.survival_100N:.1%}")
        verdict = f"SOLVED {solved} of {self.perturbed.episodes}"
        what = f"{self.origin.task}, protocol {self.protocol}: {verdict}"
        return f"<Score of {what}, {', '.join(figures)}>"

    def as_dict(self) -> dict[str, Any]:
        """The score as plain values, without the log."""
        values = asdict(replace(self, log=None))
        del values["log"]
        return values
