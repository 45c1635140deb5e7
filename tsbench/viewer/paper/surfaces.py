"""Survival and recovery of pushes, over force, heading and phase."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tsbench.core.task import Task
from tsbench.evaluation.robustness import Surface
from tsbench.evaluation.score import Score
from tsbench.evaluation.words import claim_force
from tsbench.runs.results import Result
from tsbench.viewer.paper.exhibit import (
    OURS,
    SHARES,
    Claim,
    Exhibit,
    Group,
    Verdict,
    by_task,
    drawing,
    legend,
    tidy,
)

TICKS = 5  # at most, on an axis of a map
KINDS = ("survived", "recovered")


def exhibits(groups: Sequence[Group], tasks: dict[str, Task]) -> Iterator[Exhibit]:
    """One for each task."""
    for name, members in by_task(groups).items():
        scored = {group: _surfaces(group) for group in members}
        scored = {group: surfaces for group, surfaces in scored.items() if surfaces}
        if scored:
            yield _exhibit(tasks[name], scored)


def _surfaces(group: Group) -> list[tuple[Result, Surface]]:
    """Those of the group's seeds that were pushed on one grid, the most frequent one."""
    found: dict[tuple[object, ...], list[tuple[Result, Surface]]] = {}
    for row in group.rows:
        if row.score:
            surface = row.score.robustness.surface
            grid = (surface.forces_N, surface.headings_rad, surface.phases)
            found.setdefault(grid, []).append((row, surface))
    return max(found.values(), key=len, default=[])


def _exhibit(task: Task, scored: dict[Group, list[tuple[Result, Surface]]]) -> Exhibit:
    rows: list[tuple[object, ...]] = []
    with drawing(2.7 + 2.0 * len(scored)) as figure:
        top, *below = figure.subplots(
            1 + len(scored), 2, gridspec_kw={"height_ratios": [1.15, *[1.0] * len(scored)]}
        )
        for panel, kind in zip(top, KINDS, strict=True):
            for group, surfaces in reversed(scored.items()):  # the first method on top
                forces = surfaces[0][1].forces_N
                shares = [np.mean(getattr(one, kind), axis=(1, 2)) for _, one in surfaces]
                for share in shares:
                    panel.plot(forces, share, color=group.colour, alpha=0.35, lw=0.7)
                panel.plot(forces, np.mean(shares, axis=0), color=group.colour, lw=2.0)
            panel.set_title(kind, loc="left")
            panel.set(xlabel="force, N", ylim=(-0.03, 1.03))
            tidy(panel)
        top[0].set_ylabel("share of pushes")
        for (group, surfaces), panels in zip(scored.items(), below, strict=True):
            grid = surfaces[0][1]
            shares = np.mean([one.survived for _, one in surfaces], axis=0)
            degrees = [f"{angle:.0f}" for angle in np.degrees(grid.headings_rad)]
            seconds = [f"{phase * task.timestep:.2f}" for phase in grid.phases]
            for panel, share, ticks, label in (
                (panels[0], shares.mean(axis=2), degrees, "heading of the push, degrees"),
                (panels[1], shares.mean(axis=1), seconds, "beginning of the push, s"),
            ):
                image = panel.imshow(
                    share, origin="lower", aspect="auto", vmin=0.0, vmax=1.0, cmap=SHARES
                )
                _ticks(panel.set_xticks, ticks)
                _ticks(panel.set_yticks, [f"{force:.0f}" for force in grid.forces_N])
                if panels is below[-1]:
                    panel.set_xlabel(label)
            panels[0].set_ylabel("force, N")
            panels[0].set_title(f"{group.label}, survived", loc="left", color=group.colour)
            rows += list(_rows(task, group, surfaces))
        figure.colorbar(
            image, ax=[panel for pair in below for panel in pair], shrink=0.5, aspect=30
        )
        legend(figure, list(scored))
    return Exhibit(
        name=f"survival_{task.name}",
        title=f"Pushes that policies for {task.name} survive",
        note="Survived: the episode went on to its last step or goal without "
        f"{task.mishap} and without straying. Recovered: it was solved too. Above: thin lines are "
        "seeds, thick ones their mean. Below: share of the seeds' pushes that are survived.",
        figure=figure,
        claims=tuple(_claims(scored)) if task.drawing().feet else (),
        columns=("task", "method", "force_N", "heading_rad", "phase_step", "seeds", *KINDS),
        rows=rows,
    )


def _ticks(setter: object, labels: Sequence[str]) -> None:
    every = -(-len(labels) // TICKS)
    assert callable(setter)
    setter(range(0, len(labels), every), labels[::every])


def _rows(
    task: Task, group: Group, surfaces: Sequence[tuple[Result, Surface]]
) -> Iterator[tuple[object, ...]]:
    grid = surfaces[0][1]
    means = [np.mean([getattr(one, kind) for _, one in surfaces], axis=0) for kind in KINDS]
    for at in np.ndindex(means[0].shape):
        force, heading, phase = at
        yield (
            task.name, group.label, round(grid.forces_N[force], 3),
            round(grid.headings_rad[heading], 4), grid.phases[phase], len(surfaces),
            *(round(float(mean[at]), 4) for mean in means),
        )  # fmt: skip


def _claims(scored: dict[Group, list[tuple[Result, Surface]]]) -> Iterator[Claim]:
    for group, surfaces in scored.items():
        if group.method != OURS:
            continue
        scores: list[Score] = [row.score for row, _ in surfaces if row.score]
        force, name = claim_force(scores[0]), scores[0].origin.task
        seconds = scores[0].robustness.push_duration_s
        survived = [score.robustness.survival_100N for score in scores]
        recovered = float(np.mean([score.robustness.recovery_100N for score in scores]))
        yield Claim(
            "The policy endures forces of up to 100 N for 0.1 s (said of the walk).",
            f"{name}: of pushes of {force:.3g} N for {seconds:g} s {group.label} survives "
            f"{np.mean(survived):.1%} (seeds {min(survived):.1%} to {max(survived):.1%}), and "
            f"solves the task after {recovered:.1%}",
            Verdict.of(min(survived) == 1.0),
        )
