"""Learning curves of every task, against what training costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from tsbench.core.task import Task
from tsbench.runs.directory import Stage
from tsbench.runs.results import Curve, Result, Results
from tsbench.viewer.paper.exhibit import (
    MONOLITHIC,
    OURS,
    PRM,
    PRM_RL,
    Claim,
    Exhibit,
    Group,
    Verdict,
    by_task,
    compare,
    drawing,
    legend,
    papers_group,
    solves,
    tidy,
)

SAMPLES = 200  # of each stage, in the mean over seeds
PLANNING = (0.0, (3.0, 1.5))  # dashes of a stage without physics


@dataclass(frozen=True)
class Axis:
    """A measure of what training costs.

    Attributes:
        name: ends the name of the figure's files.
        label: of the axis.
        spent: what a whole stage has cost.
        along: the same at each point of the stage's curve.
        note: what to know of it.
        known: whether a result says what its stages have cost.
    """

    name: str
    label: str
    spent: Callable[[Stage], float]
    along: Callable[[Stage, Curve], np.ndarray]
    note: str = ""
    known: Callable[[Result], bool] = lambda row: True


AXES = (
    Axis("steps", "environment steps", lambda s: s.steps, lambda s, c: c.steps),
    Axis(
        "substeps",
        "physics steps",
        lambda s: s.physics_substeps,
        lambda s, c: c.steps * (s.physics_substeps / s.steps),
        " Planning takes none, so that it stands at zero. Trainings that failed are left out, "
        "because nobody counted theirs.",
        lambda row: row.score is not None,
    ),
    Axis(
        "seconds",
        "seconds",
        lambda s: s.seconds,
        lambda s, c: c.seconds,
        " Seconds are those of the machine that trained, which other work may have slowed.",
    ),
)


def exhibits(
    results: Results, groups: Sequence[Group], tasks: Mapping[str, Task]
) -> Iterator[Exhibit]:
    """One for each of `AXES`, with a panel for each task and budget that has curves."""
    with_curves = [
        group for group in groups if any(results.curves.get(row.words) for row in group.rows)
    ]
    if not with_curves:
        return
    claims = tuple(_claims(groups, tasks))
    for axis in AXES:
        yield _exhibit(axis, results, with_curves, claims if axis is AXES[0] else ())


def _exhibit(
    axis: Axis, results: Results, groups: Sequence[Group], claims: Sequence[Claim]
) -> Exhibit:
    parts = _by_budget(groups)
    data: list[tuple[object, ...]] = []
    with drawing(0.7 + 2.3 * len(parts)) as figure:
        panels = figure.subplots(len(parts), 1, squeeze=False)[:, 0]
        for panel, (title, members) in zip(panels, parts.items(), strict=True):
            for group in members:
                rows = [row for row in group.rows if axis.known(row)]
                for dashes, xs, ys in _means(axis, results.curves, rows):
                    for x, y in zip(xs, ys, strict=True):
                        panel.plot(x, y, color=group.colour, alpha=0.35, lw=0.7, ls=dashes)
                    x, y = np.mean(xs, axis=0), np.mean(ys, axis=0)
                    panel.plot(x, y, color=group.colour, lw=2.0, ls=dashes)
                for row in rows:
                    end = sum(axis.spent(stage) for stage in row.stages)
                    panel.plot(
                        end, row.normalized_reward, "o", color=group.colour, ms=6, mec="white"
                    )
                    data += _rows(axis, results.curves.get(row.words, ()), group.label, row)
            panel.set_title(title, loc="left")
            panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
            panel.xaxis.set_major_formatter(EngFormatter(sep=""))
            tidy(panel)
            panel.set(ylabel="normalized return", xlim=(0.0, None))
        panels[-1].set_xlabel(axis.label)
        legend(
            figure, groups,
            [
                Line2D([], [], color="grey", ls=PLANNING, label="planning stage"),
                Line2D([], [], color="grey", label="stage in physics"),
                Line2D([], [], color="grey", ls="", marker="o", label="finished policy"),
            ],
        )  # fmt: skip
    return Exhibit(
        name=f"learning_{axis.name}",
        title=f"Learning curves over {axis.label}",
        note="Thin: every seed; thick: their mean. Each stage's return is a share of the largest "
        "of its own reward, as in the paper; episodes of an imitation stage begin anywhere along "
        "the reference, so that even a perfect one stays below 1. The curve of prm_rl is that of "
        "driving from point to point, which is an easier task; its other stages have none. Dots "
        "stand for the finished policies on the task's own reward, from the protocol's perturbed "
        "starts: they alone can be "
        f"compared between methods.{axis.note}",
        figure=figure,
        claims=claims,
        columns=("task", "method", "seed", "stage", axis.name, "normalized_return"),
        rows=data,
    )


def _by_budget(groups: Sequence[Group]) -> Mapping[str, list[Group]]:
    """The groups of each panel, by its title: of a task, and of each of its budgets where it has
    several. On one axis a larger budget would leave the others a corner."""
    found: dict[str, list[Group]] = {}
    for task, members in by_task(groups).items():
        budgets = {group.first.budget for group in members}
        for group in sorted(members, key=lambda group: group.first.budget):
            title = task if len(budgets) == 1 else f"{task}, budget {group.first.budget}"
            found.setdefault(title, []).append(group)
    return found


def points(
    axis: Axis, curves: Sequence[Curve], row: Result
) -> Iterator[tuple[Stage, np.ndarray, np.ndarray]]:
    """Each stage with the points of its curve, what earlier stages have cost added."""
    spent = 0.0
    for stage in row.stages:
        curve = next((one for one in curves if one.stage == stage.name), None)
        if curve is not None and stage.steps:
            yield stage, spent + axis.along(stage, curve), curve.returns
        spent += axis.spent(stage)


def _means(
    axis: Axis, curves: Mapping[tuple[str, ...], Sequence[Curve]], rows: Sequence[Result]
) -> Iterator[tuple[object, np.ndarray, np.ndarray]]:
    """Of each stage the dashes, and x and y of all seeds at equal shares of the stage, (seeds,
    SAMPLES)."""
    found: dict[str, list[tuple[Stage, np.ndarray, np.ndarray]]] = {}
    for row in rows:
        for stage, x, y in points(axis, curves.get(row.words, ()), row):
            found.setdefault(stage.name, []).append((stage, x, y))
    for seeds in found.values():
        sampled = []
        for _, x, y in seeds:
            share = np.linspace(0.0, len(x) - 1.0, SAMPLES)
            at = np.arange(len(x))
            sampled.append((np.interp(share, at, x), np.interp(share, at, y)))
        xs, ys = np.array(sampled).transpose(1, 0, 2)
        physics = any(stage.physics_substeps for stage, _, _ in seeds)
        yield ("-" if physics else PLANNING), xs, ys


def _rows(
    axis: Axis, curves: Sequence[Curve], label: str, row: Result
) -> Iterator[tuple[object, ...]]:
    for stage, xs, ys in points(axis, curves, row):
        for x, y in zip(xs, ys, strict=True):
            yield row.task, label, row.seed, stage.name, round(float(x), 3), round(float(y), 6)


def _claims(groups: Sequence[Group], tasks: Mapping[str, Task]) -> Iterator[Claim]:
    for task in by_task(groups):
        yield from compare(
            groups, task, OURS, MONOLITHIC,
            "Two stages earn much more than the monolithic formulation.",
        )  # fmt: skip
        expected = {
            OURS: ("Two stages solve the task.", True),
            MONOLITHIC: ("The monolithic formulation fails to solve the task.", False),
        }
        if tasks[task].drawing().feet:
            says = "PRM finds no good policies for quadrupeds (it was not evaluated on them)."
            expected[PRM] = (says, False)
        else:
            says = "Two stages earn slightly more than PRM."
            yield from compare(groups, task, OURS, PRM, says)
            yield from compare(groups, task, PRM, MONOLITHIC, "PRM earns more than monolithic.")
            yield from compare(groups, task, OURS, PRM_RL, "PRM-RL works poorly.")
            expected[PRM] = ("PRM solves the task.", True)
        for method, (says, good) in expected.items():
            group = papers_group(groups, task, method)
            if group is not None:
                yield solves([group], says, good=good)
        group = papers_group(groups, task, OURS)
        if group is not None:
            yield from _cheaper(group)


def _cheaper(group: Group) -> Iterator[Claim]:
    """What a step of planning costs beside one in physics."""
    cost: dict[bool, list[float]] = {True: [], False: []}
    for row in group.rows:
        for stage in row.stages:
            if stage.steps and stage.seconds:
                cost[stage.physics_substeps > 0].append(stage.seconds / stage.steps)
    if cost[True] and cost[False]:
        ratio = float(np.mean(cost[True]) / np.mean(cost[False]))
        yield Claim(
            "A step of planning is 5 to 10 times cheaper than another.",
            f"{group.task}: a training step with physics takes {ratio:.1f} times as long as one of "
            "planning, learning included",
            Verdict.of(5.0 <= ratio <= 10.0),
        )
