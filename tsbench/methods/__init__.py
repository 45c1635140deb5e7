"""The methods. A new one is one file here and one config in conf/method/.

`tsbench.methods.NAME` has a dataclass `Options` and a function
`train(problem, workspace) -> Policy`; with PPO stages it names their kinds in `STAGES`.
"""

from __future__ import annotations

import ast
import importlib
import pkgutil
from pathlib import Path
from typing import Any, Protocol, cast

from tsbench.errors import TsbenchError, unknown
from tsbench.policy import Policy
from tsbench.problem import Problem, Workspace
from tsbench.typed import typed


class Method(Protocol):
    """A module of this package.

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
    """All methods, sorted: the modules of this package. Imports none of them."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))


def summary(name: str) -> str:
    """The first line of the method's file, which says what it does. Imports nothing."""
    source = (Path(__path__[0]) / f"{name}.py").read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]


def find(name: str) -> Method:
    """The method of that name.

    Raises:
        TsbenchError: there is none, or it lacks a part.
    """
    if name not in names():
        raise unknown("method", name, names())
    module = importlib.import_module(f"{__name__}.{name}")
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


def options(kind: type[Any], problem: Problem) -> Any:
    """The method's options as an instance of its dataclass `kind`.

    Raises:
        TsbenchError: an option that the method does not have, or a value of the wrong type.
    """
    given = {key: value for key, value in problem.options.items() if key != "name"}
    return typed(kind, given, "method")
