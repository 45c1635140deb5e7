"""Heat maps of a planar task's reward, beside those of its imitation rewards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tsbench.core.motion import ReferenceMotion
from tsbench.core.task import Plannable
from tsbench.runs.results import Results
from tsbench.viewer.paper.exhibit import (
    OURS,
    SHARES,
    Claim,
    Exhibit,
    Group,
    Verdict,
    base_path,
    best_at_hand,
    drawing,
    main_group,
)

PIXELS = 160  # along the longer side of a map
FELT = 0.01  # share of the largest reward that a learner may feel


def exhibits(results: Results, groups: Sequence[Group]) -> Iterator[Exhibit]:
    """One for each planar task of which the two-stage method has left a plan, by the best of its
    seeds at hand."""
    for task_name in dict.fromkeys(group.task for group in groups):
        group = main_group(groups, task_name, OURS)
        best = best_at_hand(results, group) if group else None
        if best is None:
            continue
        run = results.folders[best.words]
        task = run.task(task_name)
        drawn = task.drawing()
        if isinstance(task, Plannable) and drawn.still is not None and drawn.bounds is not None:
            plan = run.plan(task)
            if plan is not None:
                yield _exhibit(task, task.reference(plan), best.seed)


def _exhibit(task: Plannable[Any], reference: ReferenceMotion, seed: int) -> Exhibit:
    x, z, grid = _grid(task)
    along = base_path(task, reference.qpos)
    path = along[:, [0, 2]]
    names = ["reward R", *(f"imitation, {form}" for form in task.imitation_forms)]
    maps = [_worth(task, grid, reference, form) for form in (None, *task.imitation_forms)]
    lengths = np.linalg.norm(np.diff(path, axis=0, prepend=path[:1]), axis=1)
    felt = {
        name: float(
            np.average(_worth(task, along, reference, form) > FELT * values.max(), weights=lengths)
        )
        for name, form, values in zip(names, (None, *task.imitation_forms), maps, strict=True)
    }
    ratio = len(z) / len(x)
    with drawing(0.4 + (0.35 + 4.5 * ratio) * len(maps)) as figure:
        panels = figure.subplots(len(maps), 1, sharex=True)
        for panel, name, values in zip(panels, names, maps, strict=True):
            image = panel.pcolormesh(
                x, z, values.reshape(len(z), len(x)), cmap=SHARES, rasterized=True
            )
            if name != names[0]:
                panel.plot(*path.T, color="white", lw=1.0, ls="--")
            panel.plot(*path[0], "o", color="white", ms=5)
            panel.set_title(name, loc="left")
            panel.set(aspect="equal", ylabel="z, m")
            figure.colorbar(image, ax=panel)
        panels[-1].set_xlabel("x, m")
    columns = ("x_m", "z_m", *(name.replace(", ", "_").replace(" ", "_") for name in names))
    points = grid[:, [0, 2]]
    return Exhibit(
        name=f"heatmap_{task.name}",
        title=f"Reward of {task.name}, and its imitation rewards",
        note=f"The dashed line is the plan of seed {seed}, which is imitated; the dot its start. A "
        f"{task.drawing().robot} at rest is rewarded at each place; what moving on along the plan "
        "earns is left out.",
        figure=figure,
        claims=tuple(_claims(task.name, names, maps[0], felt)),
        columns=columns,
        rows=np.round(np.column_stack([points, *maps]), 6).tolist(),
    )


def _claims(
    task: str, names: Sequence[str], reward: np.ndarray, felt: dict[str, float]
) -> Iterator[Claim]:
    area = float(np.mean(np.abs(reward) > FELT * reward.max()))
    yield Claim(
        "R is sparse: it is felt only very close to the goal or to obstacles.",
        f"{task}: R exceeds {FELT:.0%} of its largest value on {area:.0%} of the world and along "
        f"{felt[names[0]]:.0%} of the plan's length",
        Verdict.of(max(area, felt[names[0]]) < 0.5),
    )
    for name in names[1:]:
        yield Claim(
            "R_imi is dense along the reference motion.",
            f"{task}, {name}: it exceeds {FELT:.0%} of its largest value along {felt[name]:.0%} of "
            "the plan's length",
            Verdict.of(felt[name] > 0.95),
        )


def _grid(task: Plannable[Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x (m,), z (n,) and positions (n * m, 3) within the task's world."""
    bounds = task.drawing().bounds
    assert bounds is not None
    low, high = bounds
    span = (high - low)[[0, 2]]
    columns, rows = np.maximum(np.rint(PIXELS * span / span.max()), 2).astype(int)
    x, z = np.linspace(low[0], high[0], columns), np.linspace(low[2], high[2], rows)
    grid = np.stack(np.broadcast_arrays(x[None], low[1], z[:, None]), axis=-1)
    return x, z, grid.reshape(-1, 3)


def _worth(
    task: Plannable[Any], positions: np.ndarray, reference: ReferenceMotion, form: str | None
) -> np.ndarray:
    """Reward of a robot at rest at positions (n, 3), shape (n,): R, or an imitation reward."""
    still = task.drawing().still
    assert still is not None
    state = still(positions)
    judge = task if form is None else task.tracker(reference, form)
    action = np.zeros((len(positions), task.action_size))
    found: np.ndarray = judge.reward(state, action, state)
    return found
