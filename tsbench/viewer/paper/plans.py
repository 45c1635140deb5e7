"""Plans of the methods that plan, and how smooth they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.task import Plannable, Task
from tsbench.core.words import several
from tsbench.runs.results import Results
from tsbench.viewer.paper.exhibit import (
    OURS,
    PRM,
    Claim,
    Exhibit,
    Group,
    Verdict,
    base_path,
    by_task,
    drawing,
    papers_group,
    tidy,
)
from tsbench.viewer.scene import Array
from tsbench.viewer.show import landmarks

ARRIVED = 0.05  # m, nearer than this to where a plan comes nearest to its goal it has arrived


@dataclass(frozen=True)
class Way:
    """A plan in figures.

    Attributes:
        group: of the run that it is of.
        seed: of that run.
        plan: itself.
        path: positions of the robot's base, world frame in metres, shape (n, 3).
        length: metres until it arrives.
        seconds: until it arrives.
        roughness: root of the mean squared acceleration of the base until it arrives, m/s^2.
        turning: by how much its direction turns in a metre, in radians.
    """

    group: Group
    seed: int
    plan: Plan
    path: Array
    length: float
    seconds: float
    roughness: float
    turning: float


def exhibits(
    results: Results, groups: Sequence[Group], tasks: dict[str, Task]
) -> Iterator[Exhibit]:
    """One for each task of which there are plans at hand, and which has footsteps or a flat world
    to draw them in."""
    for name, members in by_task(groups).items():
        task = tasks[name]
        if not isinstance(task, Plannable) or not (has_steps(task) or has_map(task)):
            continue
        ways: dict[Group, list[Way]] = {}
        for group in members:
            for row in group.rows:
                run = results.folders.get(row.words)
                plan = run.plan(task) if run else None
                if plan is not None:
                    ways.setdefault(group, []).append(way(task, plan, group, row.seed))
        if ways:
            yield _exhibit(task, ways)


def has_steps(task: Plannable[Any]) -> bool:
    """Whether plans for the task say where each foot is, and which of them stand."""
    coordinates = task.abstraction().coordinates
    feet = task.drawing().feet
    told = all(f"{foot}_x" in coordinates for foot in feet)
    return bool(feet) and told and {"feet", "contacts"} <= task.tracked.keys()


def has_map(task: Task) -> bool:
    """Whether the task's world is bounded, and so flat across y (`viewer.stage`)."""
    return task.drawing().bounds is not None


def way(task: Plannable[Any], plan: Plan, group: Group, seed: int) -> Way:
    path = base_path(task, task.abstraction().poses(plan.states))
    marks = {mark.text: mark.position for mark in landmarks(task.spec().compile())}
    away = np.linalg.norm(path - marks.get("goal", path[-1]), axis=-1)
    flight = path[: max(int(np.argmax(away < away.min() + ARRIVED)), 2) + 1]
    moves = np.linalg.norm(np.diff(flight, axis=0), axis=-1)
    acceleration = np.diff(flight, n=2, axis=0) / plan.timestep**2
    steps = np.diff(flight, axis=0)[moves > 1e-9]
    unit = steps / np.linalg.norm(steps, axis=-1, keepdims=True)
    cosine = np.clip(np.sum(unit[1:] * unit[:-1], axis=-1), -1.0, 1.0)
    length = float(moves.sum())
    return Way(
        group=group,
        seed=seed,
        plan=plan,
        path=path,
        length=length,
        seconds=(len(flight) - 1) * plan.timestep,
        roughness=float(np.sqrt(np.mean(np.sum(acceleration**2, axis=-1)))),
        turning=float(np.arccos(cosine).sum() / max(length, 1e-9)),
    )


def _exhibit(task: Plannable[Any], ways: dict[Group, list[Way]]) -> Exhibit:
    steps = has_steps(task)
    height = 0.4 + len(ways) * (2.1 if steps else 3.4)
    with drawing(height) as figure:
        panels = figure.subplots(len(ways), 1, squeeze=False, sharex=True, sharey=True)[:, 0]
        for panel, (group, members) in zip(panels, ways.items(), strict=True):
            roughness = np.mean([one.roughness for one in members])
            turning = np.mean([one.turning for one in members])
            panel.set_title(
                f"{group.label}: {roughness:.1f} m/s\u00b2, {turning:.2f} rad/m",
                loc="left", color=group.colour,
            )  # fmt: skip
            if steps:
                _draw_feet(panel, task, members[0])
            else:
                _draw_paths(panel, task, members)
            tidy(panel)
        panels[-1].set_xlabel("time, s" if steps else "x, m")
    what = (
        "Where each foot of the first seed's plan is along the way: level while it stands."
        if steps
        else "The plans of the seeds at hand."
    )
    return Exhibit(
        name=f"plans_{task.name}",
        title=f"Planned motions of {task.name}",
        note=f"{what} Smoothness of the base's path until it arrives, mean over seeds: the root of "
        "the mean squared acceleration, and by how much the direction turns in a metre.",
        figure=figure,
        claims=tuple(_claims(task, ways)),
        columns=(
            "task", "method", "seed", "length_m", "seconds", "roughness_m_per_s2",
            "turning_rad_per_m",
        ),
        rows=[
            (task.name, group.label, one.seed, round(one.length, 3), round(one.seconds, 3),
             round(one.roughness, 4), round(one.turning, 5))
            for group, members in ways.items()
            for one in members
        ],
    )  # fmt: skip


def _draw_paths(panel: Any, task: Plannable[Any], members: Sequence[Way]) -> None:
    for one in members:
        panel.plot(one.path[:, 0], one.path[:, 2], color=one.group.colour, lw=1.3, alpha=0.8)
    for mark in landmarks(task.spec().compile()):
        x, _, z = mark.position
        shape, size = ("*", 11) if mark.text == "goal" else ("s", 6)
        panel.plot(x, z, shape, color="black", ms=size, clip_on=shape == "s")
    panel.set(aspect="equal", ylabel="z, m")


def _draw_feet(panel: Any, task: Plannable[Any], one: Way) -> None:
    names = task.abstraction().coordinates
    shades = ("-", "--", "-.", ":")
    for foot, dashes in zip(task.drawing().feet, shades, strict=False):
        column = one.plan.states[:, names.index(f"{foot}_x")]
        panel.plot(
            one.plan.times, column, dashes, color=one.group.colour, lw=1.2,
            label=foot.removesuffix("_foot"),
        )  # fmt: skip
    panel.set(ylabel="x of each foot, m")
    panel.legend(ncols=4, loc="upper left", fontsize=9)


def _claims(task: Plannable[Any], ways: dict[Group, list[Way]]) -> Iterator[Claim]:
    """Of a task with footsteps how regular they are, of another one how smooth its plans."""
    if has_steps(task):
        yield from _regular(task, ways)
    else:
        yield from _smoother(task.name, ways)


def _regular(task: Plannable[Any], ways: dict[Group, list[Way]]) -> Iterator[Claim]:
    """By how much the length of a step varies, and by the audit; means over the plans."""
    ours, theirs = _papers(ways)
    if not (ours and theirs):
        return
    told, spreads = [], []
    for members in (theirs, ours):
        motions = [(one.plan, task.reference(one.plan)) for one in members]
        passed = sum(task.audit(*motion).passed for motion in motions)
        lengths = [found for motion in motions if len(found := step_lengths(*motion))]
        if not lengths:
            return  # these plans do not take a step
        spread = float(np.mean([np.std(found) for found in lengths]))
        label = members[0].group.label
        told.append(
            f"{1e3 * spread:.0f} mm in plans of {label}, of which {passed} of {len(motions)} pass "
            "their audit"
        )
        spreads.append(spread)
    yield Claim(
        "PRM's plans have irregular footsteps.",
        f"{task.name}: the length of a step varies (standard deviation) by {'; by '.join(told)}",
        Verdict.of(spreads[0] > spreads[1]),
    )


def step_lengths(plan: Plan, reference: ReferenceMotion) -> np.ndarray:
    """How far each foot moves forward from one stance to its next one, until the plan ends, in
    metres, of all feet, shape (n,)."""
    feet, stands = reference.tracked["feet"], reference.tracked["contacts"]
    lengths = []
    for foot in range(feet.shape[1]):
        begins = np.flatnonzero(np.diff(stands[:, foot].astype(int)) == 1) + 1
        begins = begins[reference.times[begins] < plan.times[-1]]
        lengths.append(np.diff(feet[begins, foot, 0]))
    return np.concatenate(lengths)


def _smoother(task: str, ways: dict[Group, list[Way]]) -> Iterator[Claim]:
    ours, theirs = _papers(ways)
    if not (ours and theirs):
        return
    told, smoother = [], set()
    for name, unit in (("roughness", "m/s\u00b2"), ("turning", "rad/m")):
        means = [float(np.mean([getattr(one, name) for one in part])) for part in (ours, theirs)]
        told.append(f"{name} {means[0]:.2f} and {means[1]:.2f} {unit}")
        smoother.add(Verdict.of(means[0] < means[1]))
    yield Claim(
        "The learned plan is smoother than PRM's.",
        f"{task}: {' and '.join(told)}, of {several(len(ours), 'plan')} of {OURS} "
        f"and {len(theirs)} of {theirs[0].group.label}",
        smoother.pop() if len(smoother) == 1 else Verdict.PART,
    )


def _papers(ways: dict[Group, list[Way]]) -> Iterator[list[Way]]:
    """The plans of the two-stage method and of the roadmap, as the paper has them."""
    task = next(iter(ways)).task
    for method in (OURS, PRM):
        group = papers_group(list(ways), task, method)
        yield ways[group] if group else []
