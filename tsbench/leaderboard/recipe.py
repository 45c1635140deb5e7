"""Whether the recorded command of a training still makes the settings that it has made.

A command names some settings, and the version that ran it has filled in the others. A later version
may have other defaults, so that the same words train something else.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from tsbench.core.errors import TsbenchError, plain_line
from tsbench.leaderboard.coherence import KEY, WORD
from tsbench.runs import config
from tsbench.runs.directory import RunDirectory


def remark(run: RunDirectory) -> str:
    """What a reader should know of the recorded command; "" if it makes the same settings again."""
    try:
        words = lacking(run)
    except TsbenchError as error:
        return f"this version of tsbench refuses its command: {plain_line(str(error))}"
    if not words:
        return ""
    return (
        "its command leaves out what was a default when it ran; "
        f"this version makes its settings with {shlex.join(words)} added"
    )


def lacking(run: RunDirectory) -> tuple[str, ...]:
    """The words that the recorded command of a training lacks to make the settings of its
    `config.yaml` with this version of tsbench; none without a configuration, and none for a command
    with values that are no plain numbers or names, which is not composed.

    Raises:
        TsbenchError: this version refuses the command.
    """
    if not run.begun:
        return ()
    words = shlex.split(run.command)[2:]  # without `tsbench run`
    plain = [word.lstrip("+").partition("=") for word in words]
    if not all(KEY.fullmatch(key) and WORD.fullmatch(value) for key, _, value in plain):
        return ()
    kept = run.config()
    # A seed is no default, and without it the trainings of an entry have one command.
    left_out = ("seed=", "device=", "hydra.")
    given = tuple(word for word in words if not word.lstrip("+").startswith(left_out))
    made = _settings((*given, f"device={kept.device}"))
    wanted = {
        key: value
        for key, value in _leaves(kept.identity)
        if key != "seed" and not _other_budget(key, kept.budget)
    }
    return tuple(
        f"{key}={config.word(value)}"
        for key, value in wanted.items()
        if made.get(key, ...) != value
    )


@cache
def _settings(words: tuple[str, ...]) -> dict[str, Any]:
    return dict(_leaves(config.compose(words).identity))


def _leaves(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def _other_budget(key: str, budget: str) -> bool:
    """Whether a setting changes nothing: of a budget that the training has not, or what a GPU
    would have changed."""
    return key.startswith("task.gpu.") or (
        key.startswith("task.budgets.") and not key.startswith(f"task.budgets.{budget}.")
    )
