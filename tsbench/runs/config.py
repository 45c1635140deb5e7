"""The configuration of a run: `key=value` words, checked before anything starts.

Hydra composes the words with the YAML files of `tsbench.conf` and of plug-ins. This module gives
the result its types and turns every mistake in it into an error of one line.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib import import_module
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_module
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import (
    CompactHydraException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from tsbench import methods, tasks
from tsbench.core import plugins
from tsbench.core.errors import TsbenchError, unknown
from tsbench.core.typed import typed, unknown_key
from tsbench.runs.schema import RunConfig as RunConfig
from tsbench.runs.schema import check_name, lacking
from tsbench.runs.schema import names as names

CONFIGURATIONS = "tsbench.conf"
VERSION_BASE = "1.3"  # the defaults of this Hydra release
LAUNCHERS = ("joblib", "ray")  # of Hydra, which extras of the same names bring
OPEN_MAPPINGS = ("task.training.", "task.constants.", "task.gpu.")


class PluginConfigurations(SearchPathPlugin):
    """Adds the configurations of plug-ins to Hydra's search path, after tsbench's own.

    The order keeps a plug-in from replacing a configuration of tsbench.
    """

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in list(plugins.configurations())[1:]:
            search_path.append("plug-in", f"file://{folder}")


@contextmanager
def found_by_hydra() -> Iterator[None]:
    """Lets Hydra find the configurations of tsbench and of plug-ins within the context."""
    Plugins.instance().register(PluginConfigurations)
    with initialize_config_module(CONFIGURATIONS, version_base=VERSION_BASE):
        yield


def compose(words: Sequence[str]) -> RunConfig:
    """The configuration that `key=value` words select.

    Raises:
        TsbenchError: the words do not make a valid configuration.
    """
    overrides = parse_words(words)
    if "task" not in {override.key_or_group for override in overrides}:
        raise TsbenchError(f"task=NAME is missing; allowed: {', '.join(names('task'))}")
    for override in overrides:
        if override.is_sweep_override():
            raise TsbenchError(f"{override.input_line} asks for several runs: add -m for a sweep")
    try:
        with one_line_errors(), found_by_hydra():
            node = hydra_compose("config", overrides=opened(words))
    except ValueError as error:  # Hydra raises it where the value of a group is not a name
        raise TsbenchError(f"{_flat(error)} (in: {' '.join(words)})") from None
    config = parse(node, keys(words))
    files = {override.key_or_group: override.value() for override in overrides}
    for group, name in (("task", config.task.name), ("method", config.method["name"])):
        check_name(group, files.get(group, name), name)
    return config


def parse(node: DictConfig, given: Collection[str]) -> RunConfig:
    """Gives a composed configuration its types, and on a GPU makes the changes of `task.gpu`.

    Args:
        node: as Hydra has composed it.
        given: the keys that words set, which a GPU does not change.

    Raises:
        TsbenchError: a key is missing or unknown, or a value is of the wrong type or range.
    """
    with one_line_errors():
        plain = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    config: RunConfig = typed(RunConfig, plain, "")
    if config.device == "auto":
        # Only here, because torch takes a second to load.
        config = replace(config, device=import_module("tsbench.rl.devices").pick())
    if not config.device.startswith("cuda"):
        return config
    changed = asdict(config)
    for group, members in vars(config.task.gpu).items():
        for name, changes in members.items():
            for key, value in changes.items():
                path = f"task.{group}.{name}.{key}"
                if not any(path == word or path.startswith(f"{word}.") for word in given):
                    changed["task"][group].setdefault(name, {})[key] = value
    adapted: RunConfig = typed(RunConfig, changed, "")
    return adapted


def keys(words: Sequence[str]) -> set[str]:
    """The keys that `key=value` words set, other than the choices of task and method."""
    return {override.key_or_group for override in parse_words(words)} - {"task", "method"}


def sweep(words: Sequence[str]) -> Iterator[list[str]]:
    """The jobs of a sweep (`-m`) over discrete values, each as a list of words.

    Raises:
        TsbenchError: a word cannot be read.
    """
    choices: list[list[str]] = []
    for override in parse_words(words):
        if not override.is_sweep_override():
            choices.append([str(override.input_line)])
        elif override.is_discrete_sweep():
            key = override.get_key_element()
            choices.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        # The sweeper draws from the remaining kind, intervals: each job checks its own value.
    return (list(job) for job in itertools.product(*choices))


def opened(words: Sequence[str]) -> list[str]:
    """The words, with `++` (add or change) before keys that the YAML files need not list."""
    return [f"++{word}" if word.startswith(OPEN_MAPPINGS) else word for word in words]


def parse_words(words: Sequence[str]) -> list[Override]:
    """The words, parsed by Hydra's grammar.

    Raises:
        TsbenchError: a word cannot be read, gives a key again, or changes the name of a task or
            method alone.
    """
    with one_line_errors():
        overrides = list(OverridesParser.create().parse_overrides(list(words)))
    given: dict[str, str | None] = {}
    for override in overrides:
        key, line = override.get_key_element().lstrip("+~"), override.input_line
        if key in given:
            raise TsbenchError(f"{key} is given twice: {given[key]} and {line}")
        given[key] = line
        group, _, rest = override.key_or_group.partition(".")
        if group in ("task", "method") and rest == "name":
            raise TsbenchError(f"{group}.name comes with {group}=NAME and cannot be changed alone")
    return overrides


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Turns the errors of Hydra and OmegaConf about the user's words into a TsbenchError."""
    try:
        yield
    except OverrideParseException as error:
        words = "expected key=value, the value quoted where it has special characters"
        raise TsbenchError(f"cannot read '{error.override}': {words}") from None
    except MissingConfigException as error:
        if error.options is None or error.missing_cfg_file is None:
            raise TsbenchError(_flat(error)) from None
        missing = str(error.missing_cfg_file)
        parts = missing.rpartition("/") if missing.startswith("hydra/") else missing.partition("/")
        registry = {"task": tasks, "method": methods}.get(parts[0])
        if registry is not None and parts[2] in registry.names():
            raise TsbenchError(lacking(parts[0], parts[2])) from None
        if parts[0] == "hydra/launcher" and parts[2] in LAUNCHERS:
            reason = f"pip install 'tsbench[{parts[2]}]'"
            raise TsbenchError(f"the launcher {parts[2]} is missing: {reason}") from None
        raise unknown(parts[0], parts[2], error.options, plugins.broken()) from None
    except CompactHydraException as error:
        cause = error.__cause__
        if isinstance(cause, OmegaConfBaseException) and isinstance(cause.parent_node, DictConfig):
            path = str(cause.full_key or "").removesuffix(str(cause.key)).rstrip(".")
            siblings = [str(name) for name in cause.parent_node if name != "hydra"]
            raise unknown_key(path, str(cause.key), siblings) from None
        raise TsbenchError(_flat(error)) from None
    except (HydraException, OmegaConfBaseException) as error:
        raise TsbenchError(_flat(error)) from None


def _flat(error: Exception) -> str:
    """An error's message on one line, without Hydra's list of searched places."""
    return " ".join(str(error).split("Config search path")[0].split())


def word(value: Any) -> str:
    """A value in Hydra's grammar."""
    if isinstance(value, (list, tuple)):
        return f"[{','.join(map(word, value))}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)
