"""The tasks. A new one is one file here, one MJCF in models/ and one config in conf/task/."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from functools import cache
from typing import Any

from tsbench.errors import TsbenchError, unknown
from tsbench.task import Task

Factory = Callable[..., Task[Any]]

_factories: dict[str, Factory] = {}


def register(name: str) -> Callable[[Factory], Factory]:
    """Adds a task: a function of its constants, all with defaults, that returns the task."""

    def add(factory: Factory) -> Factory:
        if name in _factories:
            raise ValueError(f"the task {name!r} is registered already")
        _factories[name] = factory
        return factory

    return add


@cache
def names() -> tuple[str, ...]:
    """All tasks, sorted."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    return tuple(sorted(_factories))


def make(name: str, **constants: Any) -> Task[Any]:
    """The task of that name; `constants` change what defines it (see `standard`).

    Raises:
        TsbenchError: no such task or constant.
    """
    if name not in names():
        raise unknown("task", name, names())
    allowed = inspect.signature(_factories[name]).parameters
    for constant, value in constants.items():
        if constant not in allowed:
            raise unknown(f"constant of {name}", constant, allowed)
        number = isinstance(allowed[constant].default, (int, float))
        if number and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise TsbenchError(f"{constant} of {name} must be a number, not {value!r}")
    try:
        return _factories[name](**constants)
    except (TypeError, ValueError, OverflowError) as error:
        raise TsbenchError(f"{name} cannot be made with {constants}: {error}") from None


def standard(task: Task[Any]) -> bool:
    """Whether the task has the constants that scores are ranked by."""
    return task.constants() == make(task.name).constants()
