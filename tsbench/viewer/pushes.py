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
AXES = {
    "+x": "ahead", "-x": "back", "+y": "left", "-y": "right", "+z": "up", "-z": "down"
}  # fmt: skip
_NUMBER = r"\d{1,6}(?:\.\d{1,12})?"
_GRAMMAR = re.compile(rf"({_NUMBER})N@({_NUMBER})s:([+-][xyz]|[+-]?{_NUMBER})")


def parse_push(text: str, plant: Plant[Any]) -> Push:
    """A push of 0.1 s, from its force in newtons, its start in seconds, and its direction.

    The direction is an axis of the world in the plant's `push_plane`, or a heading in degrees as in
    scores: from the first axis of that plane to the second.

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
    plane = np.array(plant.push_plane)
    allowed = [axis for axis in AXES if np.allclose(plane.T @ plane @ _along(axis), _along(axis))]
    if heading not in allowed:
        words = " or ".join(filter(None, (", ".join(allowed), "an angle in degrees")))
        raise TsbenchError(
            f"the push '{text}' leaves the plane that the {plant.pushed} is pushed in: "
            f"allowed are {words}"
        )
    return Push(seconds, DURATION, newtons * _along(heading))


def headings(plant: Plant[Any]) -> dict[str, str]:
    """Four directions as `parse_push` reads them, and in words: along the first axis of the plant's
    `push_plane` and against it, along its second axis and against it."""
    found = {}
    for degrees in (0, 180, 90, 270):
        along = direction(plant, math.radians(degrees))
        axis = next((axis for axis in AXES if np.allclose(along, _along(axis))), None)
        vector = ", ".join(f"{one:.2g}" for one in along.round(9) + 0.0)
        found[axis or str(degrees)] = AXES[axis] if axis else f"along ({vector})"
    return found


def _along(heading: str) -> np.ndarray:
    """The unit vector, shape (3,), of an axis such as "-x"."""
    along: np.ndarray = np.eye(3)["xyz".index(heading[1])]
    return -along if heading[0] == "-" else along


def push_in_words(push: Push, plant: Plant[Any]) -> str:
    """A push that `parse_push` has read, such as "100 N left (+y) at 0.5 s"."""
    first, second = np.array(plant.push_plane) @ push.force
    angle = math.degrees(math.atan2(second, first))
    towards = f"at {angle:.3g} degrees"
    for axis, words in AXES.items():
        if np.array_equal(np.sign(push.force), _along(axis)):
            towards = f"{words} ({axis})"
    return f"{np.linalg.norm(push.force):.4g} N {towards} at {float(np.min(push.time)):g} s"
