"""Things to draw in pictures of a task in addition to its MuJoCo model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tsbench.core.state import State


@dataclass(frozen=True)
class Flame:
    """The flame of a running engine.

    Attributes:
        body: name of the body that carries the engine.
        actuator: name of the actuator whose control sets the length of the flame.
        nozzle: start of the flame in the body's frame in metres.
        direction: unit vector along the flame in the body's frame.
        length: metres per unit of control; negative if the engine runs at negative controls.
    """

    body: str
    actuator: str
    nozzle: tuple[float, float, float]
    direction: tuple[float, float, float]
    length: float


@dataclass(frozen=True, eq=False)
class Lines:
    """Straight lines that stay where they are.

    Attributes:
        name: of what they show.
        note: says what that is.
        colour: red, green, blue in [0, 1].
        segments: both ends of each line in the world frame in metres, shape (m, 2, 3).
        width: of a line, over the size of the picture.
    """

    name: str
    note: str
    colour: tuple[float, float, float]
    segments: np.ndarray
    width: float


@dataclass(frozen=True)
class Drawing:
    """Things to draw in pictures of a task in addition to its MuJoCo model.

    Attributes:
        feet: names of the geoms that should touch the ground; each has the name of its foot.
        contacts: the contact schedule: seconds (...,) -> whether each foot should be on the ground,
            (..., feet). None without a schedule.
        flames: flames of the engines.
        bounds: lowest and highest corner of the world in metres; None for an unbounded world. In a
            flat world both corners have the same coordinate along the normal of its plane.
        worth: positions (n, 3) in metres -> reward of a robot at each position (n,); drawn within
            the bounds of a flat world.
        still: positions (n, 3) in metres -> the states of a robot at rest there; for maps of other
            rewards than `worth`.
        lines: lines of the world.
        robot: what moves, in a word that follows "the".
    """

    feet: tuple[str, ...] = ()
    contacts: Callable[[np.ndarray], np.ndarray] | None = None
    flames: tuple[Flame, ...] = ()
    bounds: tuple[np.ndarray, np.ndarray] | None = None
    worth: Callable[[np.ndarray], np.ndarray] | None = None
    still: Callable[[np.ndarray], State] | None = None
    lines: tuple[Lines, ...] = ()
    robot: str = "robot"
