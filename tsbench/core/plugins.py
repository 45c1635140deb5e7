"""The packages that bring tasks and methods: tsbench itself, and plug-ins.

A plug-in is an installed package whose pyproject.toml names the modules that it brings:

[project.entry-points."tsbench.tasks"]
cart = "cart_package.task"  # registers tasks under names of its own choice

[project.entry-points."tsbench.methods"]
lazy = "cart_package.lazy"  # is the method `lazy`

Like tsbench, its package contains the files `conf/task/TASK.yaml`, `conf/method/METHOD.yaml` and
`models/MODEL.xml`. A plug-in that cannot be imported is refused in one line; the others work.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from importlib.resources import files
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from types import ModuleType

from tsbench.core.errors import TsbenchError

OWN = "tsbench"
TASKS, METHODS = "tsbench.tasks", "tsbench.methods"  # the groups of entry points
HASHED = (".py", ".yaml", ".xml")  # code, configuration and models


@dataclass(frozen=True, order=True)
class Provider:
    """A package that brings tasks or methods.

    Attributes:
        package: its name for `import`.
        distribution: its name for `pip install`.
        version: of the distribution.
    """

    package: str
    distribution: str
    version: str

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}"

    def folder(self) -> Traversable:
        """The package's own folder.

        Raises:
            TsbenchError: the package cannot be imported.
        """
        with self.explained():
            if not hasattr(importlib.import_module(self.package), "__path__"):
                raise ImportError(f"{self.package} is a single module; it must be a package")
            return files(self.package)

    def code(self) -> str:
        """sha256 of the package's code, configuration and models, with their names.

        Raises:
            TsbenchError: the package cannot be imported.
        """
        content = hashlib.sha256()
        for name, file in sorted(walk(self.folder())):
            if name.endswith(HASHED):
                content.update(f"{name}\0".encode())
                content.update(hashlib.sha256(file.read_bytes()).digest())
        return content.hexdigest()

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Turns any exception of a plug-in's code into a `TsbenchError` that names the plug-in."""
        try:
            yield
        except Exception as error:
            if self.package == OWN:  # a defect of tsbench, which needs its traceback
                raise
            reason = f"{type(error).__name__}: {error}"
            raise TsbenchError(f"the plug-in {self} cannot be used: {reason}") from error


@dataclass(frozen=True, order=True)
class Plugin:
    """An entry point of a plug-in.

    Attributes:
        name: name of the entry point.
        module: name of the module that the entry point refers to.
        provider: the package that brings the entry point.
    """

    name: str
    module: str
    provider: Provider

    def find(self) -> None:
        """Checks that the module exists. Imports only the packages that contain it.

        Raises:
            TsbenchError: the module does not exist, or a containing package cannot be imported.
        """
        self.provider.folder()
        with self.provider.explained():
            if find_spec(self.module) is None:
                raise ModuleNotFoundError(f"No module named {self.module!r}")

    def load(self) -> ModuleType:
        """Imports the module.

        Raises:
            TsbenchError: the module cannot be imported.
        """
        with self.provider.explained():
            return importlib.import_module(self.module)


@cache
def plugins(group: str) -> tuple[Plugin, ...]:
    """The entry points of a group (`TASKS` or `METHODS`) of all installed packages, sorted."""
    found = []
    for point in entry_points(group=group):
        module = point.value.partition(":")[0].strip()
        distribution = point.dist
        assert distribution is not None  # only an entry point made by hand has none
        provider = Provider(module.partition(".")[0], distribution.name, distribution.version)
        found.append(Plugin(point.name, module, provider))
    return tuple(sorted(found))


@cache
def own() -> Provider:
    """tsbench itself."""
    # A checkout on the path may never have been installed.
    return Provider(OWN, OWN, version_of(OWN) or "0+unknown")


def version_of(package: str) -> str | None:
    """The version of an installed package, or None without it."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def providers() -> tuple[Provider, ...]:
    """tsbench itself, then every plug-in in order."""
    return own(), *sorted({plugin.provider for plugin in plugins(TASKS) + plugins(METHODS)})


def broken() -> tuple[str, ...]:
    """A line for each plug-in whose package cannot be imported."""
    lines = []
    for provider in providers():
        try:
            provider.folder()
        except TsbenchError as error:
            lines.append(str(error))
    return tuple(lines)


def configurations(group: str = "") -> Iterator[Traversable]:
    """The configuration folder of every package that has one, tsbench's first.

    Args:
        group: "task" or "method" for that subfolder; "" for the whole folder.
    """
    for provider in providers():
        with suppress(TsbenchError):  # `broken` reports it
            folder = provider.folder() / "conf"
            if (found := folder / group if group else folder).is_dir():
                yield found


def ambiguous(kind: str, name: str, packages: Iterable[str]) -> TsbenchError:
    """The error for a name that several packages bring.

    Args:
        kind: kind of the named thing, e.g. "task".
        name: the name.
        packages: the packages that bring it.
    """
    known = {provider.package: str(provider) for provider in providers()}
    brought = " and by ".join(known.get(package, package) for package in sorted(packages))
    return TsbenchError(f"the {kind} {name!r} is brought by {brought}: uninstall all but one")


def walk(folder: Traversable, path: str = "") -> Iterator[tuple[str, Traversable]]:
    """All files below a folder, by their paths relative to it; none if there is no such folder."""
    for entry in folder.iterdir() if folder.is_dir() else ():
        if entry.is_dir():
            yield from walk(entry, f"{path}{entry.name}/")
        else:
            yield f"{path}{entry.name}", entry
