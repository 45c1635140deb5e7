"""Reads pushes as users write them: 100N@0.5s:+y."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from tsbench.core.errors import TsbenchError
from tsbench.core.task import Plant
from tsbench.sim.push import Push, direction

DURATION = 0.1  # s, of every push, as in the protocol
_NUMBER = r"\d{1,6}(?:\.\d{1,12})?"
_GRAMMAR = re.compile(rf"({_NUMBER})N@({_NUMBER})s:([+-][xyz]|[+-]?{_NUMBER})")


def parse_push(text: str, plant: Plant[Any]) -> Push:
    """A push of 0.1 s, from its force in newtons, its start in seconds, and its direction.

    The direction is an axis of the plant's `push_plane`, or a heading in degrees as in scores: from
    the first axis of that plane to the second.

    Raises:
        TsbenchError: the text is no push, or its axis is outside that plane.
    """
    found = _GRAMMAR.fullmatch(text.replace(" ", ""))
    if not found:
        raise TsbenchError(
            f"cannot read the push '{text}': expected NEWTONSN@SECONDSs:DIRECTION, such as "
            "100N@0.5s:+x; the direction is an axis such as +x or -z, or an angle in degrees"
        )
    newtons, seconds, heading = float(found[1]), float(found[2]), found[3]
    if heading[-1] not in "xyz":
        return Push(seconds, DURATION, newtons * direction(plant, math.radians(float(heading))))
    along = np.eye(3)["xyz".index(heading[-1])]
    if not (np.array(plant.push_plane) @ along).any():
        axes = [
            f"{sign}{'xyz'[int(np.argmax(axis))]}" for axis in plant.push_plane for sign in "+-"
        ]
        raise TsbenchError(
            f"the push '{text}' leaves the plane that the {plant.pushed} is pushed in: "
            f"allowed are {', '.join(axes)} or an angle in degrees"
        )
    return Push(seconds, DURATION, newtons * along * (-1.0 if heading[0] == "-" else 1.0))
