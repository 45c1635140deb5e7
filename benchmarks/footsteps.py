"""The footsteps of roadmaps: `python benchmarks/footsteps.py [TASK...]`.

A blind roadmap knows nothing of the gait. `raw` is the way through it as it is: all feet move at
all times. `blind` is the plan that follows the way as far as the planning variant lets it, which
holds the feet in stance. `layered` is the roadmap layered by the phase of the gait, `by hand` the
task's hand-made planner. Figures are means over `SEEDS`: plan steps until the goal; the planning
return with the credit of the steps that the arrival spares; mean and standard deviation of the
length of a step on the way, from one stance of a foot to its next; the largest mean slip of a foot
in stance; whether the plan passes its audit.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from tsbench import tasks
from tsbench.core.motion import Plan
from tsbench.core.task import Plannable, plannable, roadmap_space
from tsbench.planning.roadmap import cycled, find_route
from tsbench.sim.kinematic import naive_plan, plan_along, rolled_out
from tsbench.viewer.paper.plans import step_lengths

SAMPLES, NEIGHBOURS, SEEDS = 2000, 16, range(5)
COLUMNS = ("plan steps", "return", "step, mm", "its spread, mm", "slip, mm", "audit")


def raw(task: Any, points: np.ndarray) -> Plan:
    """The points of a way as a plan, which the planning variant need not allow."""
    times = np.arange(len(points)) * task.abstraction().timestep
    along = points[:, :1] + task.ideal().rows(slice(1)).feet[..., 0] + points[:, 3:]
    states = task.abstraction().flatten(task.kinematic(times, points[:, :3], along))
    plan = naive_plan(task)
    return replace(plan, states=states, rewards=np.zeros(len(states) - 1))


def figures(task: Plannable[Any], plan: Plan) -> list[float]:
    reference = task.reference(plan)
    audit = task.audit(plan, reference)
    lengths = step_lengths(plan, reference)
    slip = next(item.value for item in audit.items if "slip" in item.what)
    steps = len(plan.rewards)
    earned = plan.rewards.sum() + task.max_reward * (task.abstraction().horizon - steps)
    stride = (1e3 * np.mean(lengths), 1e3 * np.std(lengths))
    return [steps, earned, *stride, 1e3 * slip, audit.passed]


def layered() -> list[str]:
    """The tasks whose roadmap can be layered by a gait."""
    made = {name: tasks.make(name) for name in tasks.names()}
    planned = {name: task for name, task in made.items() if isinstance(task, Plannable)}
    return [name for name, task in planned.items() if task.abstraction().lattice() is not None]


def show(names: Sequence[str]) -> None:
    for name in names:
        task = plannable(tasks.make(name))
        abstraction, space = task.abstraction(), roadmap_space(task, "roadmap")
        lattice = abstraction.lattice()
        assert lattice is not None
        actions = cycled(lattice, abstraction.horizon)
        table = Table("plan", *COLUMNS, title=name)
        found = {
            "by hand": [naive_plan(task)],
            "layered": [rolled_out(task, lambda _, k, a=actions: a[k : k + 1])],  # type: ignore[misc]
        }
        for shortcut in (False, True):
            routes = [
                find_route(space, SAMPLES, NEIGHBOURS, seed, shortcut=shortcut).points
                for seed in SEEDS
            ]
            label = ", shortcuts" if shortcut else ""
            found[f"raw{label}"] = [raw(task, points) for points in routes]
            found[f"blind{label}"] = [plan_along(task, space, points) for points in routes]
        for label, plans in found.items():
            mean = np.mean([figures(task, plan) for plan in plans], axis=0)
            earned = "-" if label.startswith("raw") else f"{mean[1]:.1f}"
            cells = (f"{mean[0]:.0f}", earned, *(f"{x:.0f}" for x in mean[2:5]), f"{mean[5]:.0%}")
            table.add_row(label, *cells)
        Console(width=100).print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("tasks", nargs="*", metavar="TASK", help="(all that have a gait)")
    options, known = parser.parse_args(), layered()
    if wrong := [name for name in options.tasks if name not in known]:
        parser.error(f"{wrong[0]} is no task with a gait; there are {', '.join(known)}")
    show(options.tasks or known)


if __name__ == "__main__":
    main()
