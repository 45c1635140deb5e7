"""Pushes that disturb an episode, equal in the batched and the dm_control environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tsbench.core.errors import TsbenchError
from tsbench.core.task import Plant


def direction(plant: Plant[Any], heading: np.ndarray | float) -> np.ndarray:
    """The direction in the world frame of a push with a heading, in radians from the first axis of
    `Plant.push_plane` to the second, shape (...,) -> (..., 3)."""
    first, second = np.array(plant.push_plane)
    heading = np.asarray(heading)[..., None]
    return np.asarray(np.cos(heading) * first + np.sin(heading) * second)


@dataclass(frozen=True)
class Push:
    """A constant force of limited duration on a task's pushed body (`Plant.pushed`), at its centre
    of mass. One push for all episodes, or one for each, with a leading axis n in all fields.

    Attributes:
        time: begin in seconds since the start of the episode, shape () or (n,).
        duration: duration in seconds, shape () or (n,).
        force: force in newtons in the world frame, shape (3,) or (n, 3).
    """

    time: np.ndarray | float
    duration: np.ndarray | float
    force: np.ndarray

    def __post_init__(self) -> None:
        """
        Raises:
            TsbenchError: a field is no finite number or has another shape, or the push has no
                duration.
        """
        try:
            time, duration, force = (np.asarray(value, float) for value in vars(self).values())
        except (TypeError, ValueError):
            raise TsbenchError("time, duration and force of a push must be numbers") from None
        if force.ndim not in (1, 2) or force.shape[-1] != 3:
            raise TsbenchError(
                f"force of a push must have the shape (3,) or (n, 3), not {force.shape}"
            )
        for name, value in (("time", time), ("duration", duration)):
            if value.shape != force.shape[:-1]:
                raise TsbenchError(
                    f"{name} of a push must have the shape {force.shape[:-1]}, as its force has "
                    f"{force.shape}, not {value.shape}"
                )
        if not all(np.isfinite(value).all() for value in (time, duration, force)):
            raise TsbenchError("time, duration and force of a push must be finite")
        if not (duration > 0.0).all():
            raise TsbenchError(f"duration of a push must be positive, not {duration.min()}")

    def expect_count(self, count: int) -> None:
        """Checks that there is a push for each of `count` episodes, or one for all.

        Raises:
            TsbenchError: there are more or fewer.
        """
        if np.ndim(self.force) == 2 and len(self.force) != count:
            raise TsbenchError(
                f"there must be one push, or one for each of {count} episodes, "
                f"not {len(self.force)}"
            )

    def rows(self, rows: np.ndarray | slice) -> Push:
        """The pushes of some members of the batch; a push for all episodes is returned as it is."""
        if np.ndim(self.force) == 1:
            return self
        return Push(*(np.asarray(value)[rows] for value in vars(self).values()))

    def during(self, time: np.ndarray, timestep: float) -> np.ndarray:
        """The force in newtons over the control steps that begin at `time` (n,), shape (n, 3).

        A step that the push covers in part gets that share of the force. The whole impulse, force
        times duration, therefore does not depend on the time step.
        """
        begin = np.maximum(self.time, time)
        end = np.minimum(np.add(self.time, self.duration), time + timestep)
        # Rounded, because times are sums with rounding errors: full cover must give exactly one.
        share = np.round(np.clip((end - begin) / timestep, 0.0, 1.0), 9)
        force: np.ndarray = share[..., None] * self.force
        return force
