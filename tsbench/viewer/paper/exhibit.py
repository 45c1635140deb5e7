"""What all of the paper's figures share: their parts, colours, labels and sizes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tsbench.core.task import Task
from tsbench.core.words import several
from tsbench.evaluation.statistics import PROVISIONAL_SEEDS, Difference, paired_difference
from tsbench.runs.results import Result, Results
from tsbench.viewer.scene import Array, body_poses

# The paper's methods, by the names that they have here. They stand here and not beside each method,
# because the figures tell what the paper claims of these four, most often of two of them together.
# Any other method needs no line: it has its own name and a spare colour.
OURS, MONOLITHIC, PRM, PRM_RL = "twostage", "monolithic", "prm", "prm_rl"

# Colours of Okabe and Ito's palette, which colour-blind readers can tell apart. A method has the
# same one in every figure; one that is not of the paper has a spare one.
COLOURS = {OURS: "#d55e00", PRM: "#009e73", PRM_RL: "#cc79a7", MONOLITHIC: "#0072b2"}
SPARE = ("#e69f00", "#56b4e9", "#000000", "#f0e442", *matplotlib.color_sequences["tab20b"])

WIDTH = 6.4  # inches; a picture as wide as a phone still shows its text
DPI = 150
SHARES = "cividis"  # colours of shares and rewards, the same to colour-blind readers
STYLE = {
    "font.family": "sans-serif",
    "font.size": 11.0,
    "axes.titlesize": 11.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": False,
    "legend.frameon": False,
    "svg.fonttype": "none",  # text stays text
    "text.parse_math": False,  # names and words may have a $
    "svg.hashsalt": "tsbench",
}
ENOUGH = 0.95  # share of the perturbed starts that a seed has to solve to succeed


class Verdict(StrEnum):
    """Whether what came out is what the paper says."""

    HOLDS = "as the paper says"
    PART = "in part"
    DIFFERS = "differs"
    OPEN = "cannot be told yet"

    @classmethod
    def of(cls, holds: bool) -> Verdict:
        return cls.HOLDS if holds else cls.DIFFERS


@dataclass(frozen=True)
class Claim:
    """Attributes:
    says: what the paper says.
    found: what came out.
    verdict: whether they agree.
    """

    says: str
    found: str
    verdict: Verdict


@dataclass(frozen=True, eq=False)
class Exhibit:
    """A figure of the paper.

    Attributes:
        name: of its files.
        title: what it shows, in a few words.
        note: how to read it.
        figure: the picture.
        claims: what the paper says of it, and what came out.
        columns: names of the columns of its data.
        rows: its data.
    """

    name: str
    title: str
    note: str
    figure: Figure
    claims: Sequence[Claim]
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]


@dataclass(frozen=True, eq=False)
class Group:
    """Runs that differ in their seed alone.

    Attributes:
        rows: by seed.
        label: names the group among those of its task.
        colour: of its method; paler or darker for further variants of the method.
    """

    rows: tuple[Result, ...]
    label: str
    colour: str

    @property
    def first(self) -> Result:
        return self.rows[0]

    @property
    def method(self) -> str:
        return self.first.method

    @property
    def task(self) -> str:
        return self.first.task

    def values(self, name: str) -> dict[int, float]:
        """An attribute of each result, by seed."""
        return {row.seed: float(getattr(row, name)) for row in self.rows}


def grouped(groups: Sequence[Sequence[Result]]) -> list[Group]:
    """The groups with labels and colours: the paper's methods first, then the others by name."""
    order = {method: rank for rank, method in enumerate(COLOURS)}
    ranked = sorted(
        groups,
        key=lambda rows: (
            order.get(rows[0].method, len(order)), bool(rows[0].options), rows[0].kind
        ),
    )  # fmt: skip
    others = sorted({rows[0].method for rows in groups} - COLOURS.keys())
    colours = COLOURS | {name: SPARE[i % len(SPARE)] for i, name in enumerate(others)}
    variants: dict[str, list[str]] = {}  # labels of each method, the same in all tasks
    kinds: dict[tuple[str, str], set[tuple[str, ...]]] = {}
    for rows in ranked:
        kinds.setdefault((rows[0].task, _label(rows[0])), set()).add(rows[0].options)
    found = []
    for rows in ranked:
        one = rows[0]
        label = _label(one, whole=len(kinds[one.task, _label(one)]) > 1)
        if one.budget != _main_budget(groups, one):
            label += f", budget {one.budget}"
        known = variants.setdefault(one.method, [])
        if label not in known:
            known.append(label)
        colour = _shade(colours[one.method], known.index(label))
        found.append(Group(tuple(rows), label, colour))
    return found


def _main_budget(groups: Sequence[Sequence[Result]], one: Result) -> str:
    """Of the budgets of a task, method and options the one with the most runs."""
    counts: Counter[str] = Counter()
    for rows in groups:
        other = rows[0]
        if (other.task, other.method, other.options) == (one.task, one.method, one.options):
            counts[other.budget] += len(rows)
    return counts.most_common(1)[0][0]


def _label(result: Result, *, whole: bool = False) -> str:
    """The method with its options. Settings of the task, and all settings of a tuned run, are
    summed up as "other settings" or "tuned"; `whole` lists them."""
    shown = [word for word in result.options if not (result.trials or word.startswith("task."))]
    options = [word.removeprefix("method.") for word in shown]
    if others := [word for word in result.options if word not in shown]:
        said = "tuned" if result.trials else "other settings"
        options.append(f"{said} ({', '.join(others)})" if whole else said)
    return ", ".join([result.method, *options])


def _shade(colour: str, variant: int) -> str:
    """The colour, then paler, darker, still paler, still darker ones."""
    share = 0.6 ** ((variant + 1) // 2)
    ground = variant % 2  # white or black
    mixed: str = to_hex([ground + share * (part - ground) for part in to_rgb(colour)])
    return mixed


@contextmanager
def drawing(height: float) -> Iterator[Figure]:
    """A new figure of the standard width and a height in inches, in the figures' style."""
    with matplotlib.rc_context(STYLE):
        yield Figure(figsize=(WIDTH, height), layout="constrained")


def legend(figure: Figure, groups: Sequence[Group], extra: Sequence[Line2D] = ()) -> None:
    """One line for each label, above the panels."""
    lines = {group.label: Line2D([], [], color=group.colour, linewidth=3) for group in groups}
    handles, labels = [*lines.values(), *extra], [*lines, *(str(e.get_label()) for e in extra)]
    figure.legend(
        handles, labels, loc="outside upper center", ncols=min(len(handles), 3), fontsize=10,
        handlelength=1.5, columnspacing=1.2,
    )  # fmt: skip


def jitter(count: int, width: float) -> np.ndarray:
    """Offsets that keep dots at one place apart, evenly within the width, shape (count,)."""
    return (np.arange(count) - (count - 1) / 2) * width / max(count - 1, 1)


def difference(first: Group, second: Group, name: str) -> Difference | None:
    """What the first group has more than the second of an attribute of results, over the seeds that
    both have; None without such seeds."""
    one, other = first.values(name), second.values(name)
    seeds = one.keys() & other.keys()
    if not seeds:
        return None
    return paired_difference({"": {s: one[s] for s in seeds}}, {"": {s: other[s] for s in seeds}})


def fixed(value: float) -> str:
    """With three decimals, and without the sign of a zero."""
    return f"{round(value, 3) + 0.0:.3f}"


def interval(found: tuple[float, float] | None) -> str:
    return "" if found is None else f" [{fixed(found[0])}, {fixed(found[1])}]"


def compare(
    groups: Sequence[Group], task: str, better: str, worse: str, says: str
) -> Iterator[Claim]:
    """The paper's order of two methods on a task, beside what came out of it with one budget.

    The order holds where the 95 % interval of the paired difference of `solved_reward`, which ranks
    the rows, lies above zero, and does not where it lies below. Else it cannot be told.
    """
    first = papers_group(groups, task, better)
    if first is None:
        return
    alike = [group for group in groups if group.first.budget == first.first.budget]
    second = papers_group(alike, task, worse)
    if second is None:
        return
    found = difference(first, second, "solved_reward")
    if found is None:
        text = f"{task}: {first.label} and {second.label} have no seed in common"
        yield Claim(says, text, Verdict.OPEN)
        return
    one, other = (group.values("solved_reward") for group in (first, second))
    seeds = one.keys() & other.keys()
    text = (
        f"{task}: mean solved reward over {several(len(seeds), 'seed')} of {first.label} "
        f"{np.mean([one[seed] for seed in seeds]):.3f} and of {second.label} "
        f"{np.mean([other[seed] for seed in seeds]):.3f}; difference {found.mean:.3f}"
    )
    if found.interval is None:
        yield Claim(says, f"{text}, too few seeds for an interval", Verdict.OPEN)
        return
    low, high = found.interval
    told = Verdict.of(low > 0.0) if low > 0.0 or high < 0.0 else Verdict.OPEN
    yield Claim(says, text + interval(found.interval), told)


def solves(groups: Sequence[Group], says: str, *, good: bool) -> Claim:
    """Whether a method solves a task as the paper says, or does not (`good`), at each distance.

    A seed succeeds that solves at least `ENOUGH` of the perturbed starts. A method solves the task
    if at least `ENOUGH` of its seeds succeed, and does not if at least `ENOUGH` of them fail.

    Args:
        groups: of the method, each at another distance.
        says: what the paper says.
        good: whether that is that the method solves it.
    """
    told, verdicts = [], set()
    for group in groups:
        count = len(group.rows)
        succeed = sum(row.success >= ENOUGH for row in group.rows)
        at = f" at {group.first.distance:g} m" if len(groups) > 1 else ""
        told.append(f"{succeed} of {several(count, 'seed')}{at}")
        share = (succeed if good else count - succeed) / count
        if count < PROVISIONAL_SEEDS:
            continue
        if share >= ENOUGH:
            verdicts.add(Verdict.HOLDS)
        elif share <= 1.0 - ENOUGH:
            verdicts.add(Verdict.DIFFERS)
        else:
            verdicts.add(Verdict.PART)
    verdict = verdicts.pop() if len(verdicts) == 1 else Verdict.PART if verdicts else Verdict.OPEN
    found = f"at least {ENOUGH:.0%} of the perturbed starts are solved by {', '.join(told)}"
    return Claim(says, f"{groups[0].task}, {groups[0].label}: {found}", verdict)


def main_group(groups: Sequence[Group], task: str, method: str) -> Group | None:
    """The method's group on a task, of several the one with the most seeds."""
    found = [group for group in groups if (group.task, group.method) == (task, method)]
    return max(found, key=lambda group: len(group.rows)) if found else None


def papers_group(groups: Sequence[Group], task: str, method: str) -> Group | None:
    """The same of the groups with the method's defaults, as the paper has it; None without one."""
    return main_group([one for one in groups if not one.first.options], task, method)


def best_at_hand(results: Results, group: Group) -> Result | None:
    """The best of the group's results whose policies are at hand; None without one."""
    rows = [row for row in group.rows if row.words in results.folders and row.score]
    return max(rows, key=lambda row: (row.solved_reward, row.normalized_reward), default=None)


def by_task(groups: Sequence[Group]) -> Mapping[str, list[Group]]:
    """The groups of each task, the tasks in the order of their names."""
    found: dict[str, list[Group]] = {}
    for group in sorted(groups, key=lambda group: group.task):
        found.setdefault(group.task, []).append(group)
    return found


def base_path(task: Task[Any], qpos: Array) -> Array:
    """Positions of the robot's base at poses (n, nq): world frame in metres, shape (n, 3)."""
    model = task.spec().compile()
    return body_poses(model, qpos)[0][:, model.body(task.pushed).id]


def tidy(panel: Axes) -> None:
    panel.grid(alpha=0.3)
    panel.margins(x=0.02)
