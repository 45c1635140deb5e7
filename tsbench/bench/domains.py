"""The tasks that are measured: those that tsbench itself brings, grouped by their robot."""

from __future__ import annotations

from typing import Any

from tsbench import tasks
from tsbench.core import plugins
from tsbench.core.task import Plannable, Task


def domains() -> dict[str, tuple[Task[Any], ...]]:
    """tsbench's own tasks by the name of their MJCF, which all tasks of a robot share. The tasks of
    a robot are sorted by name. Tasks of plug-ins are left out, so that the figures of a machine do
    not depend on what else is installed."""
    found: dict[str, tuple[Task[Any], ...]] = {}
    for name in tasks.names():
        if tasks.provider(name) == plugins.own():
            task = tasks.make(name)
            robot = task.spec().modelname
            found[robot] = (*found.get(robot, ()), task)
    return found


def richest(group: tuple[Task[Any], ...]) -> Task[Any]:
    """The task with the most geoms in its model, which costs the physics most; of equals, the
    first."""
    return max(group, key=lambda task: task.spec().compile().ngeom)


def planned(group: tuple[Task[Any], ...]) -> Plannable[Any] | None:
    """The first task with a planning variant; None if no task has one."""
    return next((task for task in group if isinstance(task, Plannable)), None)
