"""Pushes: what disturbs an episode, the same in the batched and the dm_control environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tsbench.core.task import Plant


def direction(plant: Plant[Any], heading: np.ndarray | float) -> np.ndarray:
    """The direction in the world frame of a push with a heading, in radians from the first axis of
    `Plant.push_plane` to the second, shape (...,) -> (..., 3)."""
    first, second = np.array(plant.push_plane)
    heading = np.asarray(heading)[..., None]
    return np.asarray(np.cos(heading) * first + np.sin(heading) * second)


@dataclass(frozen=True)
class Push:
    """A constant force for a while on the body that a task lets be pushed (`Plant.pushed`), at its
    centre of mass. One for all episodes, or, with a leading axis n everywhere, one for each.

    Attributes:
        time: when it begins, in seconds since the start of the episode, shape () or (n,).
        duration: seconds, shape () or (n,).
        force: newtons in the world frame, shape (3,) or (n, 3).
    """

    time: np.ndarray | float
    duration: np.ndarray | float
    force: np.ndarray

    def rows(self, rows: np.ndarray | slice) -> Push:
        """The pushes of some members of the batch; a push for all is theirs too."""
        if np.ndim(self.force) == 1:
            return self
        return Push(np.asarray(self.time)[rows], np.asarray(self.duration)[rows], self.force[rows])

    def during(self, time: np.ndarray, timestep: float) -> np.ndarray:
        """The force in newtons over the control steps that begin at `time` (n,), shape (n, 3).

        A step that the push covers only in part gets that share of its force, so that the whole
        impulse, force times duration, arrives whatever the steps.
        """
        begin = np.maximum(self.time, time)
        end = np.minimum(np.add(self.time, self.duration), time + timestep)
        # Rounded, since times are sums: a step that is covered is covered exactly.
        share = np.round(np.clip((end - begin) / timestep, 0.0, 1.0), 9)
        force: np.ndarray = share[..., None] * self.force
        return force
