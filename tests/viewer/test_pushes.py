"""Pushes in words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tsbench.errors import TsbenchError
from tsbench.viewer.pushes import parse_push
from tsbench.viewer.subject import pair, subject


@pytest.mark.parametrize(
    ("text", "time", "force"),
    [
        ("100N@0.5s:+y", 0.5, (0.0, 100.0, 0.0)),
        ("2.5N@3s:-z", 3.0, (0.0, 0.0, -2.5)),
        ("100N @ 0.5s : -x", 0.5, (-100.0, 0.0, 0.0)),
        ("10N@0s:90", 0.0, (0.0, 10.0, 0.0)),
        ("10N@0s:-60", 0.0, (5.0, -8.660254037844386, 0.0)),
        ("10N@0s:+180.0", 0.0, (-10.0, 0.0, 0.0)),
    ],
)
def test_pushes_in_words(text: str, time: float, force: tuple[float, float, float]) -> None:
    push = parse_push(text)
    assert (push.time, push.duration) == (time, 0.1)
    np.testing.assert_allclose(push.force, force, atol=1e-12)


@pytest.mark.parametrize(
    "text",
    ["", "100N", "100@0.5s:+y", "100N@0.5:+y", "100N@0.5s:y", "-1N@0s:+x", "1N@-1s:+x", "1N@0s:+w",
     "nanN@0s:+x", "1e3N@0s:+x", "1N@0s:+x+y"],
)  # fmt: skip
def test_what_is_no_push_is_told_what_one_is(text: str) -> None:
    with pytest.raises(TsbenchError, match=r"cannot read the push .*such as 100N@0\.5s:\+y"):
        parse_push(text)


def test_a_push_after_the_end_is_refused(make_run: Callable[..., Path]) -> None:
    run = str(make_run("rocket_navigation"))
    assert subject(run).show(parse_push("9N@3.6s:+x")).title
    late = parse_push("9N@3.7s:+x")  # it has fallen out of the world by then
    with pytest.raises(TsbenchError, match=r"a push at 3\.7 s comes after .* end at 3\.68 s"):
        subject(run).show(late)
    with pytest.raises(TsbenchError, match="comes after"):
        pair([run, run], late)
