"""Roadmaps beside OMPL's planners at equal time: `python benchmarks/planners.py [TASK...]`.

For each number of samples, tsbench's roadmap plans with and without shortcuts, and OMPL's planners
get as many seconds as the roadmap with shortcuts took (at least `LEAST`, below which they find
nothing). OMPL asks Python whether a way is free, tsbench asks numpy about many at once: so equal
time is not equally many edges, and the edges are in the table. Needs the package
examples/planner-ompl.

Figures are means over `SEEDS`: seconds of planning; seconds of the flight, which is the cost; the
length in plan steps; the angle through which the way turns, a measure of its smoothness; the least
clearance of the plan from what is to be avoided; whether the plan passes its audit.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from planner_ompl.method import PLANNERS, Ways
from rich.console import Console
from rich.table import Table

from tsbench import tasks
from tsbench.core.roadmap import RoadmapSpace
from tsbench.core.task import Plannable, plannable, roadmap_space
from tsbench.planning.roadmap import find_route, resampled
from tsbench.sim.kinematic import plan_along
from tsbench.tasks.rocket import Rocket

SAMPLES = (250, 1000, 4000, 16_000)
SEEDS = (0, 1, 2)
NEIGHBOURS = 16
LEAST = 0.05  # s
COLUMNS = ("seconds", "edges", "flight, s", "length", "turns, rad", "clearance, m", "audit")

Planner = Callable[[int], tuple[np.ndarray, int]]  # seed -> corners (k, d), edges checked


def roadmap(space: RoadmapSpace[Any], samples: int, *, shortcut: bool) -> Planner:
    def plan(seed: int) -> tuple[np.ndarray, int]:
        route = find_route(space, samples, NEIGHBOURS, seed, shortcut=shortcut)
        return route.corners, route.graph.checked

    return plan


def ompl(space: RoadmapSpace[Any], planner: str, seconds: float) -> Planner:
    def plan(seed: int) -> tuple[np.ndarray, int]:
        ways = Ways(space)
        return ways.plan(planner, seconds, seed), ways.checked

    return plan


def measured(task: Plannable[Any], space: RoadmapSpace[Any], planner: Planner) -> np.ndarray:
    """The columns of the table, means over the seeds."""
    rows = []
    for seed in SEEDS:
        began = time.perf_counter()
        corners, edges = planner(seed)
        seconds = time.perf_counter() - began
        moves = np.diff(corners, axis=0) / space.scale
        lengths = np.linalg.norm(moves, axis=-1)
        moves, lengths = moves[lengths > 1e-6], lengths[lengths > 1e-6]
        cosines = np.sum(moves[1:] * moves[:-1], axis=-1) / (lengths[1:] * lengths[:-1])
        steps = float(space.steps(corners[:-1], corners[1:]).sum())
        plan = plan_along(task, space, resampled(space, corners))
        reference = task.reference(plan)
        passed = task.audit(plan, reference).passed
        rows.append(
            [
                seconds,
                edges,
                steps * plan.timestep,
                lengths.sum(),
                np.arccos(np.clip(cosines, -1.0, 1.0)).sum(),
                clearance(task, reference.qpos),
                passed,
            ]
        )
    mean: np.ndarray = np.mean(np.array(rows, float), axis=0)
    return mean


def clearance(task: Any, qpos: np.ndarray) -> float:
    """Metres between a rocket's outline, at any angle, and the nearest obstacle on its way."""
    state = task.kinematic(np.zeros(len(qpos)), qpos[:, :2], qpos[:, 2])
    return float(state.clearance.min(initial=np.inf))


def rockets() -> list[str]:
    return [name for name in tasks.names() if isinstance(tasks.make(name), Rocket)]


def show(names: Sequence[str]) -> None:
    console = Console(width=120)
    for name in names:
        task = plannable(tasks.make(name))
        space = roadmap_space(task, "roadmap")
        best = float(space.steps(space.start, space.goal)) * task.abstraction().timestep
        table = Table("planner", "samples", *COLUMNS, title=f"{name}; straight: {best:.3f} s")
        for samples in SAMPLES:
            rough = measured(task, space, roadmap(space, samples, shortcut=False))
            ours = measured(task, space, roadmap(space, samples, shortcut=True))
            found = {"roadmap": rough, "roadmap, shortcuts": ours}
            for planner in PLANNERS:
                limit = max(float(ours[0]), LEAST)
                found[f"OMPL {planner}"] = measured(task, space, ompl(space, planner, limit))
            for label, figures in found.items():
                cells = [f"{value:.3f}" for value in figures]
                cells[1], cells[-1] = f"{figures[1]:,.0f}", f"{figures[-1]:.0%}"
                table.add_row(label, f"{samples:,}", *cells)
        console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="*", metavar="TASK", help="(all rockets)")
    options, known = parser.parse_args(), rockets()
    if wrong := [name for name in options.tasks if name not in known]:
        parser.error(f"{wrong[0]} is no rocket; there are {', '.join(known)}")
    show(options.tasks or known)


if __name__ == "__main__":
    main()
