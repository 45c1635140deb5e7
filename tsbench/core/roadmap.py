"""What planners that do not learn need to know of a planning variant."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np

from tsbench.core.state import S, Start


class RoadmapSpace(ABC, Generic[S]):
    """Points of d coordinates, between which a plan moves on straight lines.

    Attributes:
        low: least coordinates of the box that all points lie in, shape (d,).
        high: largest coordinates, shape (d,).
        scale: the largest change of each coordinate in a plan step, shape (d,).
        start: the task's start, shape (d,).
        goal: a point at the task's goal, shape (d,).
    """

    low: np.ndarray
    high: np.ndarray
    scale: np.ndarray
    start: np.ndarray
    goal: np.ndarray

    @abstractmethod
    def free(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Whether plans may move straight from `first` to `second`, each of shape (n, d), which lie
        in the box; shape (n,)."""

    @abstractmethod
    def action(self, state: S, point: np.ndarray) -> np.ndarray:
        """The action that brings one state, batch axis (1,), to a point (d,) within reach of a plan
        step, shape (1, action_size)."""

    @abstractmethod
    def places(self, points: np.ndarray) -> np.ndarray:
        """Where the robot is at points (n, d): world frame in metres, shape (n, 3), for drawing."""

    def steps(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Plan steps that straight moves take at top speed, not rounded, shape (...,), between
        points (..., d). By default each coordinate has a speed limit of its own."""
        steps: np.ndarray = np.max(np.abs(second - first) / self.scale, axis=-1)
        return steps


class DrivableSpace(RoadmapSpace[S]):
    """A roadmap space whose points are goals like the task's own: a policy that flies or drives to
    the goal can be sent to any of them.

    Attributes:
        near: metres from a point that count as there.
    """

    near: float

    @abstractmethod
    def points(self, state: S) -> np.ndarray:
        """Where the robot is, shape (n, d), in states (n,)."""

    @abstractmethod
    def sent(self, state: S, points: np.ndarray) -> S:
        """The states moved along with the world so that `points`, shape (n, d) or (d,), come to lie
        at the goal. What a policy for the task sees there, it has to see to go to the points."""

    @abstractmethod
    def moved(self, start: Start, points: np.ndarray) -> Start:
        """The task's starts (n,) moved to `points`, shape (n, d) or (d,)."""


@dataclass(frozen=True)
class Move:
    """A move from any node of a layer to a node of the next layer.

    Attributes:
        shift: nodes along each axis of the lattice by which the move goes on.
        action: that the move takes, shape (action_size,).
        reward: of the move at the start's distance from the goal, without the `Lattice.worth` of
            the node that it leads to.
        growth: factor by which the move raises all later rewards, since it goes nearer to the goal.
    """

    shift: tuple[int, ...]
    action: np.ndarray
    reward: float
    growth: float


class Lattice(ABC):
    """The nodes of a cyclic motion, in layers of one plan step each.

    Every layer has the same nodes. The position along the way is none of their coordinates: a
    motion is the same everywhere on the way, only its rewards grow towards the goal.

    Attributes:
        layers: plan steps in a cycle.
        shape: nodes along each axis.
        start: index of the start's node in layer 0.
    """

    layers: int
    shape: tuple[int, ...]
    start: tuple[int, ...]

    @abstractmethod
    def moves(self, layer: int) -> Sequence[Move]:
        """All moves from a layer to the next; none of them breaks the motion's schedule."""

    @abstractmethod
    def worth(self, layer: int) -> np.ndarray:
        """The factor of the planning reward that depends on the node, shape `shape`."""
