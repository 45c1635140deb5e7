"""The types of a run's configuration, and the configuration files that tasks and methods bring.

Hydra is not imported here: it composes configurations (`runs.config`), and takes a while to load.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.resources.abc import Traversable
from typing import Any

import yaml

from tsbench import methods, tasks
from tsbench.core import plugins
from tsbench.core.errors import TsbenchError, unknown
from tsbench.core.lazy import Lazy
from tsbench.core.method import Budget
from tsbench.core.typed import typed

SEEDS = 2**32  # numpy and torch both take 32 bits
ELSEWHERE = ("directory", "threads", "checkpoint", "loggers")  # keys that change no result
DEVICES = "cpu, cuda, cuda:N, auto, warp"
DEVICE = re.compile(r"cpu|cuda(:\d{1,3})?|auto|warp")
omegaconf = Lazy("omegaconf")


@dataclass(frozen=True)
class OnGPU:
    """What a GPU changes of a task's configuration, since it steps many more environments at once.

    A run's configuration has the changes in it, except where words on the command line say
    otherwise.

    Attributes:
        budgets: some keys of some budgets, by name.
        training: some PPO settings by kind of stage.
    """

    budgets: dict[str, dict[str, Any]] = field(default_factory=dict)
    training: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class TaskConfig:
    """The content of `conf/task/NAME.yaml`.

    Attributes:
        name: a registered task.
        budgets: the task's budgets, by name.
        training: changes to the PPO settings by kind of stage (a method's `STAGES`).
        constants: changed constants of the task, for studies; such a score cannot be ranked.
        gpu: what a GPU changes of budgets and training.
    """

    name: str
    budgets: dict[str, Budget]
    training: dict[str, dict[str, Any]] = field(default_factory=dict)
    constants: dict[str, Any] = field(default_factory=dict)
    gpu: OnGPU = field(default_factory=OnGPU)


@dataclass(frozen=True)
class RunConfig:
    """The configuration of a run, as `conf/config.yaml` composes it.

    Attributes:
        task: the task's configuration.
        method: the method's name and its options.
        seed: in [0, 2**32).
        budget: a name among the task's budgets.
        directory: the run directory, or None for the standard place.
        threads: CPU threads, or None for all.
        checkpoint: seconds of training between checkpoints.
        device: "cpu", "cuda", "cuda:N", "warp" (a GPU's code on a CPU, for tests), or "auto".
        deterministic: whether a device other than the CPU has to give the same bits each time.
        loggers: what shows the figures of the training elsewhere (`runs.events.LOGGERS`).

    Raises:
        TsbenchError: a value is missing, unknown or out of range.
    """

    task: TaskConfig
    method: dict[str, Any]
    seed: int = 0
    budget: str = "fast"
    directory: str | None = None
    threads: int | None = None
    checkpoint: float = 30.0
    device: str = "cpu"
    deterministic: bool = False
    loggers: tuple[str, ...] = ("tensorboard",)

    @property
    def identity(self) -> dict[str, Any]:
        """The part of the configuration that determines a run's results."""
        return identity(asdict(self))

    def __post_init__(self) -> None:
        if not isinstance(self.method.get("name"), str):
            raise TsbenchError("method.name is missing")
        if not 0 <= self.seed < SEEDS:
            raise TsbenchError(f"seed must lie between 0 and {SEEDS - 1}, not {self.seed}")
        if self.threads is not None and self.threads < 1:
            raise TsbenchError(f"threads must be at least 1, not {self.threads}")
        if not self.checkpoint >= 0.0:
            raise TsbenchError(f"checkpoint must not be negative, not {self.checkpoint}")
        if not DEVICE.fullmatch(self.device):
            raise TsbenchError(f"device must be one of {DEVICES}, not {self.device!r}")
        if self.deterministic and self.device == "cpu":
            raise TsbenchError("deterministic: true is for a GPU; on the CPU every run is")
        if self.budget not in self.task.budgets:
            raise unknown("budget", self.budget, self.task.budgets)


def identity(values: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a configuration's values that determines a run's results."""
    return {name: value for name, value in values.items() if name not in ELSEWHERE}


def identity_hash(values: Mapping[str, Any]) -> str:
    """sha256 of `identity`, by which `versions.json` names the configuration.

    Raises:
        TypeError: JSON does not have a value.
    """
    return hashlib.sha256(json.dumps(identity(values), sort_keys=True).encode()).hexdigest()


def encode(values: Mapping[str, Any], command: str) -> bytes:
    """The bytes of `config.yaml`: the command on the first line, then the values."""
    return f"# {command}\n{yaml.safe_dump(dict(values), sort_keys=False)}".encode()


def names(group: str) -> tuple[str, ...]:
    """The names of the configurations of a group ("task" or "method"), sorted."""
    return tuple(sorted(_files(group)))


def incomplete() -> tuple[str, ...]:
    """A line for each task and method that can be made but not run, since it has no configuration
    of its name."""
    return tuple(
        lacking(group, name)
        for group, registry in (("task", tasks), ("method", methods))
        for name in registry.names()
        if name not in _files(group)
    )


def lacking(group: str, name: str) -> str:
    """A line that says that a task or method has no configuration."""
    return f"the {group} {name!r} cannot be run: its package lacks conf/{group}/{name}.yaml"


def budgets(task: str) -> dict[str, Budget]:
    """The budgets that a task's configuration offers; none without a configuration.

    Raises:
        TsbenchError: the configuration is wrong.
    """
    file = _files("task").get(task)
    if file is None:
        return {}
    text = file.read_text("utf-8")
    try:
        plain = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        if "${" in text:  # values of other keys, which only OmegaConf fills in
            plain = omegaconf.OmegaConf.to_container(
                omegaconf.OmegaConf.create(plain), resolve=True
            )
    except (yaml.YAMLError, omegaconf.errors.OmegaConfBaseException) as error:
        raise TsbenchError(f"{file}: {' '.join(str(error).split())}") from None
    config: TaskConfig = typed(TaskConfig, plain, "task")
    check_name("task", task, config.name)
    return config.budgets


def _files(group: str) -> dict[str, Traversable]:
    """The files of a group by name. Of two files with one name it keeps the one Hydra takes."""
    found: dict[str, Traversable] = {}
    for folder in plugins.configurations(group):
        for file in folder.iterdir():
            if file.name.endswith(".yaml"):
                found.setdefault(file.name.removesuffix(".yaml"), file)
    return found


def check_name(group: str, file: str, name: str) -> None:
    """Checks that a configuration has the name of its file.

    Raises:
        TsbenchError: it has another.
    """
    if name != file:
        raise TsbenchError(f"conf/{group}/{file}.yaml must have name: {file}, not {name}")


def words_of(config: RunConfig, given: Iterable[str]) -> tuple[str, ...]:
    """The words of a run in one order, with the defaults of task, method, budget and seed, and
    without those that change no result."""
    said = {
        "task": config.task.name,
        "method": config.method["name"],
        "budget": config.budget,
        "seed": config.seed,
    }
    plain = {word.lstrip("+~") for word in given}
    others = {word for word in plain if word.partition("=")[0] not in (*said, *ELSEWHERE)}
    others = {word for word in others if not word.startswith(("hydra.", "hydra/"))}
    return (*(f"{key}={value}" for key, value in said.items()), *sorted(others))
