"""The methods. A new one is one file here and one config in conf/method/.

`tsbench.methods.NAME` has a dataclass `Options` and a function
`train(problem, workspace) -> Policy`. A method with PPO stages lists their kinds in `STAGES`. Both
files may also lie in another package (see `tsbench.core.plugins`).
"""

from __future__ import annotations

import ast
import pkgutil
from contextlib import suppress
from functools import cache
from importlib.abc import InspectLoader
from importlib.util import find_spec
from typing import Any, Protocol, cast

from tsbench.core import plugins
from tsbench.core.errors import TsbenchError, unknown
from tsbench.core.method import Problem, Workspace
from tsbench.core.plugins import Plugin, Provider
from tsbench.core.policy import Policy
from tsbench.core.task import Plannable
from tsbench.core.typed import typed

PLANLESS = "monolithic"  # a method that can learn every task, with or without a planning variant


class Method(Protocol):
    """The module of a method.

    Attributes:
        Options: dataclass of what the method's config holds beside its name, with defaults.
    """

    Options: type[Any]

    def train(self, problem: Problem, workspace: Workspace) -> Policy:
        """Solves the problem.

        Raises:
            TsbenchError: the method cannot do this task, or not with these options.
        """


def names() -> tuple[str, ...]:
    """All methods that can be used, sorted: tsbench's own and those of plug-ins. Imports none."""
    return tuple(sorted(name for name, offers in _found()[0].items() if len(offers) == 1))


def refused() -> tuple[str, ...]:
    """A line for each plug-in that cannot be imported, and for each name that several bring."""
    found, broken = _found()
    several = [_ambiguous(name) for name, offers in found.items() if len(offers) > 1]
    return (*broken, *sorted(map(str, several)))


def provider(name: str) -> Provider:
    """The package that brings a method.

    Raises:
        TsbenchError: no such method.
    """
    return _plugin(name).provider


def summary(name: str) -> str:
    """The first line of the method's file, which says what it does. Does not import it.

    Raises:
        TsbenchError: no such method.
    """
    module = _plugin(name).module
    spec = find_spec(module)
    loader = spec.loader if spec else None
    source = loader.get_source(module) if isinstance(loader, InspectLoader) else None
    return (ast.get_docstring(ast.parse(source or "")) or "").partition("\n")[0]


def find(name: str) -> Method:
    """The method of that name.

    Raises:
        TsbenchError: no such method, or the method cannot be imported or lacks a part.
    """
    module = _plugin(name).load()
    for part in ("Options", "train"):
        if not hasattr(module, part):
            raise TsbenchError(f"the method {name} has no {part} (see tsbench.methods.Method)")
    return cast(Method, module)


def stages(name: str) -> tuple[str, ...]:
    """The kinds of PPO stages that a method has, whose settings `task.training` may change: the
    method's `STAGES`, or none where it names none.

    Raises:
        TsbenchError: there is no such method, or it lacks a part.
    """
    return tuple(getattr(find(name), "STAGES", ()))


def all_stages() -> set[str]:
    """The kinds of PPO stages of all methods that can be imported."""
    kinds: set[str] = set()
    for name in names():
        with suppress(TsbenchError):
            kinds.update(stages(name))
    return kinds


def options(kind: type[Any], problem: Problem) -> Any:
    """The method's options as an instance of its dataclass `kind`.

    Raises:
        TsbenchError: an option that the method does not have, or a value of the wrong type.
    """
    given = {key: value for key, value in problem.options.items() if key != "name"}
    return typed(kind, given, "method")


def planned_task(problem: Problem, method: str) -> Plannable[Any]:
    """The problem's task, for a method that needs its planning variant.

    Raises:
        TsbenchError: the task has none.
    """
    task = problem.task
    if not isinstance(task, Plannable):
        raise TsbenchError(
            f"the method {method} needs a planning variant, which {task.name} lacks; "
            f"method={PLANLESS} needs none"
        )
    return task


@cache
def _found() -> tuple[dict[str, dict[str, Plugin]], tuple[str, ...]]:
    """The methods, by name and then by the package that brings them, and a line for each plug-in
    that cannot be imported."""
    own = [
        Plugin(module.name, f"{__name__}.{module.name}", plugins.own())
        for module in pkgutil.iter_modules(__path__)
    ]
    found: dict[str, dict[str, Plugin]] = {}
    broken: list[str] = []
    for plugin in (*own, *plugins.plugins(plugins.METHODS)):
        try:
            plugin.find()
        except TsbenchError as error:
            broken.append(str(error))
        else:
            found.setdefault(plugin.name, {})[plugin.provider.package] = plugin
    return found, tuple(dict.fromkeys(broken))


def _plugin(name: str) -> Plugin:
    found, broken = _found()
    offers = found.get(name, {})
    if len(offers) > 1:
        raise _ambiguous(name)
    if not offers:
        raise unknown("method", name, names(), broken)
    return next(iter(offers.values()))


def _ambiguous(name: str) -> TsbenchError:
    return plugins.ambiguous("method", name, _found()[0][name])
