"""Cards. A task's: what a policy sees and does, what it is rewarded for, and what was reached. A
method's: what it does, its options, and what was kept of it."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from typing import Any

from rich.console import Console

from tsbench import methods, tasks
from tsbench.cli.rows import show_rows
from tsbench.cli.tables import kept_rows
from tsbench.core import plugins
from tsbench.core.constants import SOURCES, described
from tsbench.core.errors import unknown
from tsbench.core.task import Plannable, Task
from tsbench.core.words import number, several
from tsbench.evaluation import references
from tsbench.evaluation.words import REFERENCES
from tsbench.leaderboard.submission import kept_manifests
from tsbench.runs import schema


def show(console: Console, name: str) -> dict[str, Any]:
    """Prints the card of a task or of a method.

    Returns:
        Its content as plain values.

    Raises:
        TsbenchError: there is no such task or method, or the method cannot be imported.
    """
    if name in tasks.names():
        return _show_task(console, name)
    if name in methods.names():
        return _show_method(console, name)
    raise unknown("task or method", name, (*tasks.names(), *methods.names()), plugins.broken())


def _show_method(console: Console, name: str) -> dict[str, Any]:
    about, options = inspect.getdoc(methods.find(name)) or "", list(_options(name))
    stages = methods.stages(name)
    made = [entry for entry, one in kept_manifests().items() if one.method == name]
    facts = {
        "training stages": f"{', '.join(stages)}: task.training.STAGE.KEY=..."
        if stages
        else "none",
        "tasks": "all" if name == methods.PLANLESS else "tsbench run refuses what it cannot do",
        "kept entries": ", ".join(made) or "none",
    }
    console.print(f"{name}, a method", style="bold", highlight=False)
    console.print(_prose(about), markup=False, highlight=False)
    show_rows(console, ("", ""), list(facts.items()), folded=1)
    if options:
        show_rows(console, ("option", "default", "meaning"), options, folded=2)
    line = f"tsbench run task=NAME method={name}{' method.KEY=...' if options else ''}"
    console.print(f"Try it: {line}", markup=False, highlight=False, soft_wrap=True)
    keys = ("name", "default", "meaning")
    return {
        "method": name,
        "about": about,
        "stages": stages,
        "kept": made,
        "options": [dict(zip(keys, row, strict=True)) for row in options],
    }


def _options(name: str) -> Iterator[tuple[str, str, str]]:
    """Word, default and meaning of each option, as its line in the method's configuration says."""
    for folder in plugins.configurations("method"):
        if (file := folder / f"{name}.yaml").is_file():
            for line in file.read_text("utf-8").splitlines():
                match = _OPTION.fullmatch(line)
                if match and match[1] != "name":
                    yield f"method.{match[1]}", match[2], match[3] or ""
            return


_OPTION = re.compile(r"(\w+): *(.*?) *(?:# *(.*))?")


def _show_task(console: Console, name: str) -> dict[str, Any]:
    task = tasks.make(name)
    facts, reached = dict(_facts(task)), list(_reached(task))
    constants = list(_constants(task))
    about = inspect.getdoc(sys.modules[type(task).__module__]) or ""
    console.print(f"{name}, version {task.version}", style="bold", highlight=False)
    console.print(_prose(about), markup=False, highlight=False)
    show_rows(console, ("", ""), list(facts.items()), folded=1)
    sources = "; ".join(f"{letter}: {meaning}" for letter, meaning in SOURCES.items())
    if constants:
        headers = ("constant", "value", "unit", "source", "meaning")
        show_rows(console, headers, constants, folded=4)
        console.print(f"Sources: {sources}.", markup=False, highlight=False)
    if reached:
        show_rows(console, ("by protocol v1", "solved_reward", "success"), reached)
    method = "" if isinstance(task, Plannable) else f" method={methods.PLANLESS}"
    line = f"tsbench run task={name}{method} budget=smoke"
    console.print(f"Try it: {line}", markup=False, highlight=False, soft_wrap=True)
    keys = ("name", "value", "unit", "source", "meaning")
    return {
        "task": name,
        "version": task.version,
        "about": about,
        **facts,
        "constants": [dict(zip(keys, row, strict=True)) for row in constants],
        "reached": [
            dict(zip(("name", "solved_reward", "success"), row, strict=True)) for row in reached
        ],
    }


def _facts(task: Task[Any]) -> Iterator[tuple[str, str]]:
    own = type(task)
    seen, done = _own(task, own.observation), _own(task, own.control)
    yield "observation", f"{several(task.observation_size, 'number')}. {seen}".strip()
    yield "action", f"{several(task.action_size, 'number')} in [-1, 1]. {done}".strip()
    reward = _own(task, own.reward)
    yield "reward", f"at most {number(task.max_reward)} a step. {reward}".strip()
    if terms := _own(task, own.reward_terms):
        yield "reward's terms", terms
    seconds = task.horizon * task.timestep
    yield "length", f"{task.horizon} steps of {number(task.timestep)} s: {number(seconds)} s"
    for label, function in (
        ("ends early", own.terminal),
        ("violation", own.violated),
        ("at the goal", own.reached),
        ("solved", own.success),
    ):
        if words := _own(task, function):
            yield label, words
    yield from ((f"measure {name}", meaning) for name, meaning in task.measure_notes.items())
    for name, budget in schema.budgets(task.name).items():
        yield f"budget {name}", f"{budget.plan:,} steps to plan with, {budget.act:,} to act with"


def _constants(task: Task[Any]) -> Iterator[tuple[str, str, str, str, str]]:
    """Name, value, unit, source and meaning: of the function's constants, which words can change,
    and of the records of constants in the task's module."""
    for name, value in tasks.defaults(task.name).items():
        yield name, _value(value), "", "", f"task.constants.{name}=... changes it, for studies"
    for name, value, unit, source, meaning in described(sys.modules[type(task).__module__]):
        yield name, _value(value), unit, source, meaning


def _reached(task: Task[Any]) -> Iterator[tuple[str, str, str]]:
    stored = references.stored(task.name) or {"rows": {}}
    for name, row in stored["rows"].items():
        yield REFERENCES.get(name, name), number(row["solved_reward"]), number(row["success"])
    yield from kept_rows(task)


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_value, value))
    return number(value)


def _own(task: Task[Any], function: Any) -> str:
    """The text of a function's docstring before its sections, as one paragraph; "" for a function
    that the task inherits from an interface, whose text says nothing of this task."""
    if function.__module__ == Task.__module__:
        return ""
    return _prose(inspect.cleandoc(function.__doc__ or "").partition("\n\nArgs:")[0])


def _prose(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()
