"""Pushes in words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.sim.push import direction
from tsbench.viewer.pushes import headings, parse_push, push_in_words
from tsbench.viewer.subject import pair, subject

WALK = tasks.make("laikago_walk")


@pytest.mark.parametrize(
    ("text", "time", "force"),
    [
        ("100N@0.5s:+y", 0.5, (0.0, 100.0, 0.0)),
        ("2.5N@3s:-y", 3.0, (0.0, -2.5, 0.0)),
        ("100N @ 0.5s : -x", 0.5, (-100.0, 0.0, 0.0)),
        ("10N@0s:90", 0.0, (0.0, 10.0, 0.0)),
        ("10N@0s:-60", 0.0, (5.0, -8.660254037844386, 0.0)),
        ("10N@0s:+180.0", 0.0, (-10.0, 0.0, 0.0)),
    ],
)
def test_pushes_in_words(text: str, time: float, force: tuple[float, float, float]) -> None:
    push = parse_push(text, WALK)
    assert (push.time, push.duration) == (time, 0.1)
    np.testing.assert_allclose(push.force, force, atol=1e-12)


def test_a_push_stays_in_the_plane_that_scores_push_in() -> None:
    """The rocket's plane is x-z: a heading means the same in the viewer and in a score."""
    rocket = tasks.make("rocket_navigation")
    np.testing.assert_allclose(parse_push("9N@1s:90", rocket).force, [0, 0, 9], atol=1e-12)
    np.testing.assert_allclose(parse_push("9N@1s:-z", rocket).force, [0, 0, -9])
    scored = 9 * direction(rocket, np.pi / 2)
    np.testing.assert_allclose(parse_push("9N@1s:90", rocket).force, scored, atol=1e-12)
    with pytest.raises(TsbenchError, match=r"leaves the plane .* \+x, -x, \+z, -z or an angle"):
        parse_push("9N@1s:+y", rocket)
    with pytest.raises(TsbenchError, match=r"allowed are \+x, -x, \+y, -y or an angle"):
        parse_push("9N@1s:+z", WALK)


def test_headings_follow_the_axes_of_the_plane() -> None:
    """Whatever their order; an axis that is none of the world's is told as a vector."""

    def pushed(*plane: tuple[float, float, float]) -> Any:
        return cast(Any, SimpleNamespace(pushed="robot", push_plane=plane))

    x, y, z = (0.6, 0.8, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    assert list(headings(WALK).items())[:3] == [("+x", "ahead"), ("-x", "back"), ("+y", "left")]
    turned = pushed(y, (-1.0, 0.0, 0.0))
    assert list(headings(turned).items())[::2] == [("+y", "left"), ("-x", "back")]
    oblique = pushed(x, z)
    assert list(headings(oblique).items()) == [
        ("0", "along (0.6, 0.8, 0)"), ("180", "along (-0.6, -0.8, 0)"), ("+z", "up"), ("-z", "down")
    ]  # fmt: skip
    for heading in headings(oblique):
        parse_push(f"9N@1s:{heading}", oblique)
    assert push_in_words(parse_push("9N@1s:0", oblique), oblique) == "9 N at 0 degrees at 1 s"
    with pytest.raises(TsbenchError, match=r"leaves the plane .* allowed are \+z, -z or an angle"):
        parse_push("9N@1s:+x", oblique)
    with pytest.raises(TsbenchError, match="allowed are an angle"):
        parse_push("9N@1s:+x", pushed(x, (0.48, -0.36, 0.8)))


@pytest.mark.parametrize(
    "text",
    ["", "100N", "100@0.5s:+y", "100N@0.5:+y", "100N@0.5s:y", "-1N@0s:+x", "1N@-1s:+x", "1N@0s:+w",
     f"1N@0s:{'9' * 400}", f"{'9' * 400}N@0s:+x", "nanN@0s:+x", "1e3N@0s:+x", "1N@0s:+x+y"],
)  # fmt: skip
def test_what_is_no_push_is_told_what_one_is(text: str) -> None:
    with pytest.raises(TsbenchError, match=r"cannot read the push .*such as 100N@0\.5s:\+x"):
        parse_push(text, WALK)


def test_a_push_after_the_end_is_refused(make_run: Callable[..., Path]) -> None:
    run = str(make_run("rocket_navigation"))
    assert subject(run).show("9N@3.6s:+x").title
    late = "9N@3.7s:+x"  # the rocket has fallen out of the world by then
    with pytest.raises(TsbenchError, match=r"a push at 3\.7 s comes after .* end at 3\.68 s"):
        subject(run).show(late)
    with pytest.raises(TsbenchError, match="comes after"):
        pair([run, run], late)
