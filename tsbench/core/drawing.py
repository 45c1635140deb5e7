"""What pictures of a task show beyond its model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Flame:
    """What an engine looks like while it works.

    Attributes:
        body: that carries it.
        actuator: whose control makes it.
        nozzle: where it begins, in the body's frame in metres.
        direction: where it points to, in the body's frame, of length 1.
        length: metres per unit of control; negative where negative controls make it.
    """

    body: str
    actuator: str
    nozzle: tuple[float, float, float]
    direction: tuple[float, float, float]
    length: float


@dataclass(frozen=True)
class Drawing:
    """What pictures of a task show beyond its model.

    Attributes:
        feet: the geoms that are to touch the ground, each named as its foot.
        contacts: seconds (...,) -> whether each foot is to be on the ground, (..., feet), or None
            where nothing says so.
        flames: of engines.
        bounds: lowest and highest corner of the world in metres, where it has an edge. A flat
            world has both at the same coordinate across it.
        worth: positions (n, 3) -> the reward of a robot's being there (n,); drawn over a flat
            world's bounds.
    """

    feet: tuple[str, ...] = ()
    contacts: Callable[[np.ndarray], np.ndarray] | None = None
    flames: tuple[Flame, ...] = ()
    bounds: tuple[np.ndarray, np.ndarray] | None = None
    worth: Callable[[np.ndarray], np.ndarray] | None = None
