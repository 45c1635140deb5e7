"""The tasks. A new one is one file here, one MJCF in models/ and one config in conf/task/.

All of them may also lie in another package (see `tsbench.core.plugins`).
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from functools import cache
from typing import Any

from tsbench.core import plugins
from tsbench.core.errors import TsbenchError, unknown
from tsbench.core.plugins import Provider
from tsbench.core.task import Task
from tsbench.sim.promises import check_promises

Factory = Callable[..., Task[Any]]

_factories: dict[str, dict[str, Factory]] = {}  # by name and by the package that brings it


def register(name: str) -> Callable[[Factory], Factory]:
    """Adds a task: a function of its constants, all with defaults, that returns the task."""

    def add(factory: Factory) -> Factory:
        package = factory.__module__.partition(".")[0]
        offers = _factories.setdefault(name, {})
        if package in offers:
            raise ValueError(f"the task {name!r} is registered already")
        offers[package] = factory
        return factory

    return add


def names() -> tuple[str, ...]:
    """All tasks that can be made, sorted: tsbench's own and those of plug-ins."""
    return tuple(sorted(name for name, offers in _offers().items() if len(offers) == 1))


def refused() -> tuple[str, ...]:
    """A line for each plug-in that cannot be imported, and for each name that several packages
    bring."""
    several = [_ambiguous(name) for name, offers in _offers().items() if len(offers) > 1]
    return (*_broken().values(), *sorted(map(str, several)))


def provider(name: str) -> Provider | None:
    """The installed package that brings a task, or None if no installed package brings it.

    Raises:
        TsbenchError: several packages bring a task of that name.
    """
    offers = _offers().get(name, {})
    if len(offers) > 1:
        raise _ambiguous(name)
    return next((one for one in plugins.providers() if one.package in offers), None)


def defaults(name: str) -> dict[str, Any]:
    """The constants that `make` takes for a task, with their standard values.

    Raises:
        TsbenchError: no such task.
    """
    parameters = inspect.signature(_factory(name)).parameters
    return {constant: parameter.default for constant, parameter in parameters.items()}


def make(name: str, /, **constants: Any) -> Task[Any]:
    """The task of that name; `constants` change what defines it (see `standard`).

    Raises:
        TsbenchError: no such task or constant.
    """
    factory = _factory(name)
    allowed = inspect.signature(factory).parameters
    for constant, value in constants.items():
        if constant not in allowed:
            raise unknown(f"constant of {name}", constant, allowed)
        default = allowed[constant].default
        boolean = isinstance(default, bool)
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if boolean and not isinstance(value, bool):
            raise TsbenchError(f"{constant} of {name} must be true or false, not {value!r}")
        if isinstance(default, (int, float)) and not boolean and not number:
            raise TsbenchError(f"{constant} of {name} must be a number, not {value!r}")
    try:
        return factory(**constants)
    except (TypeError, ValueError, OverflowError) as error:
        given = f" with {constants}" if constants else ""
        raise TsbenchError(f"{name} cannot be made{given}: {error}") from None


def checked(name: str, /, **constants: Any) -> Task[Any]:
    """The task of that name, as `make`, found to keep what tasks promise.

    Raises:
        TsbenchError: no such task or constant, or the task breaks a promise (`sim.promises`).
    """
    task = make(name, **constants)
    check_promises(name, task)
    return task


def standard(task: Task[Any]) -> bool:
    """Whether the task has the constants that scores are ranked by."""
    return task.constants() == make(task.name).constants()


def _factory(name: str) -> Factory:
    offers = _offers().get(name, {})
    if len(offers) > 1:
        raise _ambiguous(name)
    if not offers:
        raise unknown("task", name, names(), _broken().values())
    return next(iter(offers.values()))


def _offers() -> dict[str, dict[str, Factory]]:
    """The registered tasks, without those of packages of which a module cannot be imported."""
    broken = _broken()
    return {
        name: {package: make for package, make in offers.items() if package not in broken}
        for name, offers in _factories.items()
    }


@cache
def _broken() -> dict[str, str]:
    """Imports all tasks. Returns a line with the reason for each package that cannot be
    imported."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    broken = {}
    for plugin in plugins.plugins(plugins.TASKS):
        try:
            plugin.find()
            plugin.load()
        except TsbenchError as error:
            broken[plugin.provider.package] = str(error)
    return broken


def _ambiguous(name: str) -> TsbenchError:
    return plugins.ambiguous("task", name, _offers()[name])
