"""The table of scores: every task and method, over the training seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tsbench.core.task import Task
from tsbench.core.words import number, short
from tsbench.evaluation.statistics import Aggregate, Difference, aggregate, holm
from tsbench.viewer.paper.exhibit import (
    ENOUGH,
    OURS,
    Exhibit,
    Group,
    by_task,
    difference,
    drawing,
    fixed,
    interval,
    jitter,
    main_group,
    papers_group,
    tidy,
)

LEADING = 2  # of a task's measures, what matters most


@dataclass(frozen=True)
class Line:
    """A row of the table.

    Attributes:
        group: what it is of.
        solved: `solved_reward` over the seeds.
        normalized: `normalized_reward` over the seeds.
        success: mean share of the perturbed starts solved.
        succeeding: seeds that solve at least `ENOUGH` of them.
        measures: means of the task's leading measures, over the seeds that have them.
        against: `solved_reward` less that of the two-stage method with the same seeds, and
            with as many trials of tuning and the same budget if there is such a group.
        p_value: of that, after Holm over the rows of the table that have an interval; None for
            the others.
    """

    group: Group
    solved: Aggregate
    normalized: Aggregate
    success: float
    succeeding: int
    measures: dict[str, float | None]
    against: Difference | None
    p_value: float | None


def table(groups: Sequence[Group], tasks: dict[str, Task]) -> list[Line]:
    """The rows, by task."""
    ordered = [group for members in by_task(groups).values() for group in members]
    against: dict[Group, Difference] = {}
    for group in ordered:
        ours = _ours(groups, group)
        found = difference(group, ours, "solved_reward") if ours else None
        if found is not None:
            against[group] = found
    sure = [group for group, one in against.items() if one.interval is not None]
    corrected = holm({str(i): against[group].p_value for i, group in enumerate(sure)})
    p_values = dict(zip(sure, corrected.values(), strict=True))
    return [_line(group, tasks, against.get(group), p_values.get(group)) for group in ordered]


def _ours(groups: Sequence[Group], group: Group) -> Group | None:
    """The two-stage method's group that another one is held against: the one with its default
    settings, or with the tuning trials and budget of the other, if there is one. The default group
    is held against none, and those of other trials or budgets against it."""
    defaults = papers_group(groups, group.task, OURS) or main_group(groups, group.task, OURS)
    if group is defaults:
        return None
    if group.method == OURS or defaults is None or _effort(group) == _effort(defaults):
        return defaults
    alike = [one for one in groups if _effort(one) == _effort(group)]
    return main_group(alike, group.task, OURS) or defaults


def _effort(group: Group) -> tuple[int, str]:
    """Trials of tuning, and the budget."""
    return group.first.trials, group.first.budget


def _line(
    group: Group, tasks: dict[str, Task], against: Difference | None, p_value: float | None
) -> Line:
    measures = {}
    for name in list(tasks[group.task].measure_notes)[:LEADING]:
        values = [
            value
            for row in group.rows
            if row.score and (value := row.score.perturbed.measures.get(name)) is not None
        ]
        measures[name] = float(np.mean(values)) if values else None
    successes = list(group.values("success").values())
    return Line(
        group=group,
        solved=aggregate({"": group.values("solved_reward")}),
        normalized=aggregate({"": group.values("normalized_reward")}),
        success=float(np.mean(successes)),
        succeeding=sum(share >= ENOUGH for share in successes),
        measures=measures,
        against=against,
        p_value=p_value,
    )


COLUMNS = (
    "task", "method", "seeds", "solved_reward", "normalized_reward", "success",
    "seeds that succeed", f"less {OURS}", "p (Holm)", "steps", "trials", "measures",
)  # fmt: skip


def cells(line: Line) -> tuple[str, ...]:
    """A row as text, in the order of `COLUMNS`."""
    count = len(line.group.rows)
    against, p_value = "", ""
    if line.against is not None:
        against = f"{round(line.against.mean, 3) + 0.0:+.3f}{interval(line.against.interval)}"
        if line.p_value is not None:
            p_value = f"{line.p_value:.3g}"
    return (
        line.group.task,
        line.group.label,
        str(count) if line.solved.standing == "ranked" else f"{count}, {line.solved.standing}",
        f"{fixed(line.solved.iqm)}{interval(line.solved.interval)}",
        f"{fixed(line.normalized.iqm)}{interval(line.normalized.interval)}",
        f"{line.success:.2f}",
        f"{line.succeeding} of {count}",
        against,
        p_value,
        short(round(float(np.mean(list(line.group.values("steps").values()))))),
        str(max(row.trials for row in line.group.rows)),
        "; ".join(f"{name} {number(value)}" for name, value in line.measures.items()),
    )


def exhibit(groups: Sequence[Group], tasks: dict[str, Task]) -> tuple[Exhibit, list[Line]]:
    """The scores as dots and intervals, and the table."""
    lines = table(groups, tasks)
    parts = by_task([line.group for line in lines])
    sizes = [len(members) for members in parts.values()]
    with drawing(0.5 + sum(0.75 + 0.4 * size for size in sizes)) as figure:
        panels = figure.subplots(
            len(parts), 1, squeeze=False, gridspec_kw={"height_ratios": [s + 0.5 for s in sizes]}
        )[:, 0]
        for panel, (task, members) in zip(panels, parts.items(), strict=True):
            for place, group in enumerate(members):
                line = next(one for one in lines if one.group is group)
                scores = list(group.values("solved_reward").values())
                heights = place - 0.12 + jitter(len(scores), 0.4)
                panel.plot(scores, heights, "o", color=group.colour, ms=5, alpha=0.6, mec="white")
                if line.solved.interval is not None:
                    below = place + 0.27
                    panel.plot(line.solved.interval, [below] * 2, color=group.colour, lw=3)
                    panel.plot(line.solved.iqm, below, "D", color=group.colour, mec="black", ms=5)
            panel.set_title(task, loc="left")
            panel.set_yticks(range(len(members)), [group.label for group in members])
            panel.set_ylim(len(members) - 0.5, -0.5)
            panel.set_xlim(left=min(0.0, panel.get_xlim()[0]))
            tidy(panel)
        panels[-1].set_xlabel("solved_reward")
    rows = [
        (
            row.task, group.label, row.seed, row.solved_reward, row.normalized_reward, row.success,
            row.steps, round(sum(stage.seconds for stage in row.stages), 1), row.trials,
            row.failure, row.command, row.commit,
        )
        for group in (line.group for line in lines)
        for row in group.rows
    ]  # fmt: skip
    shown = Exhibit(
        name="scores",
        title="Scores of every task and method",
        note="A dot is a training seed; the diamond below is the interquartile mean over at least "
        "ten seeds, with its 95 % bootstrap interval. A seed whose plan fails its audit scores "
        "zero.",
        figure=figure,
        claims=(),
        columns=(
            "task", "method", "seed", "solved_reward", "normalized_reward", "success", "steps",
            "seconds", "trials", "failure", "command", "commit",
        ),
        rows=rows,
    )  # fmt: skip
    return shown, lines
