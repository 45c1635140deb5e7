"""Runs beside each other: their learning curves in one picture, and their scores pair by pair."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import matplotlib

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.evaluation.protocol import V1
from tsbench.evaluation.statistics import Difference, holm
from tsbench.runs.results import CONSTANTS, Results
from tsbench.viewer.paper import learning
from tsbench.viewer.paper.exhibit import DPI, STYLE, Group, by_task, difference, grouped

FIGURE = "solved_reward"  # that is compared


@dataclass(frozen=True)
class Pair:
    """Two groups of runs of one task, each of runs that differ in their seed alone.

    Attributes:
        task: name of the task.
        first: label of the first group.
        second: label of the second.
        seeds: number of seeds that both have.
        difference: `FIGURE` of the first less that of the second, over these seeds; None without
            any.
        p_value: of the difference, adjusted by Holm's method for the number of pairs; None with
            fewer than two seeds.
    """

    task: str
    first: str
    second: str
    seeds: int
    difference: Difference | None
    p_value: float | None


def names(results: Results) -> dict[tuple[str, ...], str]:
    """What tells a run's group from the others of its task, by the words of each run."""
    return {row.words: _name(group) for group in grouped(results.groups()) for row in group.rows}


def _name(group: Group) -> str:
    others = sorted({protocol for protocol, _, _ in _scored(group)} - {V1.name})
    more = [*_constants(group), *(f"protocol {other}" for other in others)]
    return ", ".join([group.label, *more])


def _constants(group: Group) -> list[str]:
    """What was changed of the task, as words."""
    return [word.removeprefix(CONSTANTS) for word in group.first.words if CONSTANTS in word]


def pairs(results: Results) -> list[Pair]:
    """Every pair of groups of one task that can be compared: with scores by one protocol, of the
    same task and constants. A run without a policy is worth zero by every protocol."""
    found = [
        (one, other, len(one.values(FIGURE).keys() & other.values(FIGURE).keys()))
        for one, other in _possible(results)
        if _comparable(one, other)
    ]
    differences = [difference(one, other, FIGURE) for one, other, _ in found]
    tested = {
        str(place): one.p_value
        for place, (one, (_, _, seeds)) in enumerate(zip(differences, found, strict=True))
        if one is not None and seeds > 1
    }
    adjusted = holm(tested)
    return [
        Pair(
            one.task, _name(one), _name(other), seeds, differences[place], adjusted.get(str(place))
        )
        for place, (one, other, seeds) in enumerate(found)
    ]


def incomparable(results: Results) -> bool:
    """Whether groups of one task are left out of `pairs` since their scores differ in kind."""
    return not all(_comparable(one, other) for one, other in _possible(results))


def _comparable(one: Group, other: Group) -> bool:
    return _constants(one) == _constants(other) and len(_scored(one) | _scored(other)) < 2


def _possible(results: Results) -> Iterator[tuple[Group, Group]]:
    for members in by_task(grouped(results.groups())).values():
        yield from combinations(members, 2)


def _scored(group: Group) -> set[tuple[str, int, str]]:
    """Protocols, versions and constants of the scores of a group's runs."""
    origins = [row.score.origin for row in group.rows if row.score]
    return {(one.protocol.name, one.task_version, one.constants) for one in origins}


def picture(results: Results) -> bytes:
    """The learning curves of all runs as a PNG: a panel for each task, a colour for each method.

    Raises:
        TsbenchError: none of the runs has kept its metrics.
    """
    groups = grouped(results.groups())
    made = {name: tasks.make(name) for name in by_task(groups)}
    shown = next(learning.exhibits(results, groups, made), None)
    if shown is None:
        raise TsbenchError("there are no learning curves: none of these has its metrics.jsonl")
    content = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        shown.figure.savefig(content, format="png", dpi=DPI, metadata={"Software": None})
    return content.getvalue()
