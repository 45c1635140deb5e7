"""Motion strips of legged robots: every method's policy at the same instants."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tsbench.core.task import Task
from tsbench.runs.results import Result, Results
from tsbench.viewer.compose import compose
from tsbench.viewer.film import Camera
from tsbench.viewer.paper.exhibit import (
    MONOLITHIC,
    OURS,
    WIDTH,
    Claim,
    Exhibit,
    Group,
    Verdict,
    best_at_hand,
    by_task,
    drawing,
)
from tsbench.viewer.recording import Recording, record_episode

INSTANTS = 5
PIXELS = 300  # side of a picture
STILL = 0.1  # share of the way to the goal, below which a robot has not moved forward


def exhibits(
    results: Results, groups: Sequence[Group], tasks: dict[str, Task]
) -> Iterator[Exhibit]:
    """One for each task of a robot with feet, by the best seed at hand of each method.

    Raises:
        TsbenchError: no OpenGL works here.
    """
    for name, members in by_task(groups).items():
        if not tasks[name].drawing().feet:
            continue
        cast: dict[Group, tuple[Result, Recording]] = {}
        for method in dict.fromkeys(group.method for group in members):
            known = {
                group: best
                for group in members
                if group.method == method and (best := best_at_hand(results, group))
            }
            if known:
                group = max(known, key=lambda group: len(group.rows))
                policy = results.folders[known[group].words].policy()
                cast[group] = (known[group], record_episode(tasks[name], policy))
        if cast:
            yield _exhibit(tasks[name], cast)


def _exhibit(task: Task, cast: dict[Group, tuple[Result, Recording]]) -> Exhibit:
    leading = next(iter(cast.values()))[1]
    instants = np.linspace(0.0, leading.duration, INSTANTS)
    rows = []
    cell = WIDTH / INSTANTS
    with drawing(len(cast) * (cell + 0.62) + 0.2) as figure:
        grid = figure.subplots(len(cast), INSTANTS, squeeze=False)
        for panels, (group, (best, recording)) in zip(grid, cast.items(), strict=True):
            show = compose(recording, None, title="")
            with Camera(show, (PIXELS, PIXELS)) as camera:
                for panel, time in zip(panels, instants, strict=True):
                    panel.imshow(camera.portrait(show.actors[0], float(time)))
                    panel.set(xticks=[], yticks=[])
                    panel.spines[:].set_visible(False)
                    ended = time > recording.duration + 1e-6
                    frame = min(round(time / task.timestep), len(recording.qpos) - 1)
                    left = float(recording.goal_distance[frame])
                    state = "ended" if ended else f"{left:.2f} m"
                    panel.set_xlabel(f"{time:.2f} s\n{state}", fontsize=10)
                    rows.append((task.name, group.label, best.seed, round(time, 3), left, ended))
            panels[0].set_title(f"{group.label}, seed {best.seed}", loc="left", color=group.colour)
    return Exhibit(
        name=f"strip_{task.name}",
        title=f"Motions of {task.name} at the same instants",
        note="The best seed at hand of each method, from the task's own start. Below each picture: "
        "the time, and how far the goal still is. Orange discs: feet that press on the ground; "
        "blue ones: feet that the schedule wants there. On the ground a black ball marks the "
        "centre of mass, a white one the centre of pressure.",
        figure=figure,
        claims=tuple(_claims(task, cast)),
        columns=("task", "method", "seed", "time_s", "goal_distance_m", "ended"),
        rows=rows,
    )


def _claims(task: Task, cast: dict[Group, tuple[Result, Recording]]) -> Iterator[Claim]:
    for group, (_, recording) in cast.items():
        distance = recording.goal_distance
        gone = 1.0 - float(distance[-1] / distance[0])
        end = "solves the task" if recording.solved else "does not solve the task"
        fallen = f", spoiled by {task.mishap}" if recording.violated else ""
        told = (
            f"{task.name}: {group.label} goes {gone:.0%} of the way in {recording.duration:.1f} s"
            f"{fallen}, and {end}"
        )
        if group.method == OURS:
            says = "Two stages find a valid, periodic motion."
            yield Claim(says, told, Verdict.of(bool(recording.solved)))
        elif group.method == MONOLITHIC:
            says = "The monolithic policy barely balances, without any forward movement."
            yield Claim(says, told, Verdict.of(gone < STILL and not recording.violated))
