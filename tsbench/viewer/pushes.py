"""Pushes as people write them: 100N@0.5s:+y."""

from __future__ import annotations

import math
import re

import numpy as np

from tsbench.errors import TsbenchError
from tsbench.sim.push import Push

DURATION = 0.1  # s, of every push that is written so; the protocol's
_NUMBER = r"\d+(?:\.\d+)?"
_GRAMMAR = re.compile(rf"({_NUMBER})N@({_NUMBER})s:([+-][xyz]|[+-]?{_NUMBER})")


def parse_push(text: str) -> Push:
    """A push of 0.1 s: its force in newtons, when it begins in seconds, and where to: along an
    axis of the world, or at an angle in degrees on the ground, 0 along +x and 90 along +y.

    Raises:
        TsbenchError: the text is no push.
    """
    found = _GRAMMAR.fullmatch(text.replace(" ", ""))
    if not found:
        raise TsbenchError(
            f"cannot read the push '{text}': expected NEWTONSN@SECONDSs:DIRECTION, such as "
            "100N@0.5s:+y; the direction is +x, -x, +y, -y, +z, -z or an angle in degrees"
        )
    newtons, seconds, heading = float(found[1]), float(found[2]), found[3]
    direction = np.zeros(3)
    if heading[-1] in "xyz":
        direction["xyz".index(heading[-1])] = -1.0 if heading[0] == "-" else 1.0
    else:
        angle = math.radians(float(heading))
        direction[:2] = math.cos(angle), math.sin(angle)
    return Push(seconds, DURATION, newtons * direction)
