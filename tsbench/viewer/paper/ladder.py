"""The ladder: how probably a task is solved, against how far away its goal is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tsbench.viewer.paper.exhibit import (
    MONOLITHIC,
    OURS,
    Claim,
    Exhibit,
    Group,
    by_task,
    drawing,
    jitter,
    legend,
    solves,
    tidy,
)

Steps = dict[str, dict[float, Group]]  # by label and distance


def exhibits(groups: Sequence[Group]) -> Iterator[Exhibit]:
    """One figure with a panel for each task that was trained at several distances."""
    ladders = {task: _steps(members) for task, members in by_task(groups).items()}
    ladders = {task: steps for task, steps in ladders.items() if steps}
    if not ladders:
        return
    shown = [g for g in groups if any(g.label in steps for steps in ladders.values())]
    rows: list[tuple[object, ...]] = []
    with drawing(0.6 + 2.4 * len(ladders)) as figure:
        panels = figure.subplots(len(ladders), 1, squeeze=False)[:, 0]
        for panel, (task, steps) in zip(panels, ladders.items(), strict=True):
            room = 0.02 * max(d for by_distance in steps.values() for d in by_distance)
            beside = jitter(len(steps), 1.5 * room * (len(steps) - 1))
            for (label, by_distance), shift in zip(steps.items(), beside, strict=True):
                colour = next(iter(by_distance.values())).colour
                means = {
                    d: np.mean(_successes(g)) for d, g in by_distance.items() if len(g.rows) > 1
                }
                panel.plot(np.array([*means]) + shift, [*means.values()], color=colour, lw=1.5)
                for distance, group in by_distance.items():
                    found = _successes(group)
                    x = distance + shift + jitter(len(found), room)
                    panel.plot(x, found, "o", color=colour, alpha=0.6, ms=6, mec="white")
                    rows += [
                        (task, label, distance, row.seed, row.success, row.command)
                        for row in group.rows
                    ]
            panel.set_title(task, loc="left")
            panel.set(ylim=(-0.05, 1.05), ylabel="starts solved")
            panel.set_xticks(sorted({d for by_distance in steps.values() for d in by_distance}))
            tidy(panel)
        panels[-1].set_xlabel("distance of the goal from the start, m")
        legend(figure, shown)
    yield Exhibit(
        name="ladder",
        title="The ladder: probability of success against start distance",
        note="A dot is a seed: the share of perturbed starts that its policy solves; the line is "
        "the mean over several seeds. Methods stand side by side at each distance. A seed "
        "whose plan fails its audit solves none.",
        figure=figure,
        claims=tuple(_claims(ladders)),
        columns=("task", "method", "distance_m", "seed", "success", "command"),
        rows=rows,
    )


def _steps(groups: Sequence[Group]) -> Steps:
    """The labels with several distances. Of several groups of a label and distance the one with the
    most seeds counts."""
    found: Steps = {}
    for group in sorted(groups, key=lambda group: (group.first.distance, len(group.rows))):
        found.setdefault(group.label, {})[group.first.distance] = group
    return {label: by_distance for label, by_distance in found.items() if len(by_distance) > 1}


def _successes(group: Group) -> list[float]:
    return [row.success for row in group.rows]


def _claims(ladders: dict[str, Steps]) -> Iterator[Claim]:
    for steps in ladders.values():
        for method, says, good in (
            (
                MONOLITHIC,
                "The monolithic formulation fails (at a distance that it leaves out).",
                False,
            ),
            (OURS, "Two stages solve the task.", True),
        ):
            if method in steps:
                yield solves(list(steps[method].values()), says, good=good)
