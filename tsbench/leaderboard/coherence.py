"""Whether the files in which a run tells of its own training contradict each other.

Nobody can see from files how long a training took, or on which machine. What can be seen is whether
the files are those that tsbench writes, whether `versions.json` is of this configuration, model and
packages, whether the settings are those that the command asks for, and whether the stages add up.
Who changes one of the files alone is found out. Who writes all of them anew is found out only by
training again.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from tsbench.core.errors import TsbenchError, quoted
from tsbench.core.files import encode_json, read_file, read_json
from tsbench.core.policy import MAX_INFO, encode_info
from tsbench.core.task import Task
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.score import Score
from tsbench.runs.directory import (
    MAX_CONFIG,
    MAX_PROCESSES,
    MAX_SCORE,
    MAX_VERSIONS,
    Record,
    RunDirectory,
)
from tsbench.runs.schema import ELSEWHERE, encode, identity_hash

_HASH = re.compile(r"[0-9a-f]{64}")
_COMMIT = re.compile(r"[0-9a-f]{40}([0-9a-f]{24})?\+?")
_VERSION = re.compile(r"[0-9][0-9A-Za-z.+!_-]{0,63}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
KEY = re.compile(r"[a-z_][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*")
WORD = re.compile(r"[A-Za-z0-9_.+-]+")  # a value that stands for itself in Hydra's grammar
_PLAIN = {"true": True, "false": False, "null": None}


def check(run: RunDirectory, record: Record, task: Task[Any]) -> None:
    """Checks that the files of a training do not contradict each other.

    Args:
        run: the directory, whose files can be read and are of the right types.
        record: the content of its `score.json`.
        task: the task of the score.

    Raises:
        TsbenchError: they do. The message names the file.
    """
    settings = run.settings() if run.config_file.exists() else None
    versions = run.versions() if run.versions_file.exists() else None
    faults = [
        (run.score_file, _of_stages(record, task)),
        (run.score_file, _of_origin(record.score.origin)),
    ]
    if settings is not None:
        faults.append((run.config_file, _of_command(run.command, settings)))
    if versions is not None:
        faults.append((run.versions_file, _of_versions(versions, settings, record.score)))
    for path, found in faults:
        for fault in found:
            raise TsbenchError(f"{path}: {fault}")
    check_budget(run, record)
    for path, content, written in _written(run, settings):
        if content != written:
            raise TsbenchError(f"{path} is not written as tsbench writes it")


def check_budget(run: RunDirectory, record: Record) -> None:
    """Checks that a training has kept to its budget, as far as its files say.

    Raises:
        TsbenchError: its stages go beyond it.
    """
    if more := run.overspent(record):
        raise TsbenchError(f"{run.score_file}: {more}")


def _written(run: RunDirectory, settings: Any) -> Iterator[tuple[Path, bytes, bytes]]:
    """Each text file, its bytes, and those that tsbench writes for its content: a file must hold
    nothing that no reader sees."""
    for path, limit, encoded in (
        (run.policy_info_file, MAX_INFO, encode_info),
        (run.score_file, MAX_SCORE, encode_json),
        (run.versions_file, MAX_VERSIONS, encode_json),
    ):
        if path.exists():
            yield path, read_file(path, limit), encoded(read_json(path, limit))
    if settings is not None:
        path = run.config_file
        yield path, read_file(path, MAX_CONFIG), encode(settings, run.command)


def _of_stages(record: Record, task: Task[Any]) -> Iterator[str]:
    for stage in record.stages:
        name = quoted(stage.name)
        counts = (stage.budget, stage.steps, stage.interruptions, *stage.warnings.values())
        if min(counts) < 0 or not stage.seconds >= 0.0:
            yield f"stage {name}: a count or a time is negative"
        if stage.physics_substeps not in (0, stage.steps * task.substeps):
            steps = f"{stage.physics_substeps:,} physics steps in {stage.steps:,} steps"
            yield f"stage {name}: {steps}, where {task.substeps} each or none are possible"


def _of_origin(origin: Origin) -> Iterator[str]:
    for name in ("mjcf", "model", "constants"):
        if not _HASH.fullmatch(value := getattr(origin, name)):
            yield f"origin.{name} is no hash: {quoted(value)}"


def _of_command(command: str, settings: Any) -> Iterator[str]:
    """Words of the command that say another value than the configuration has. A word whose value
    is no plain number or name is not looked at."""
    try:
        words = shlex.split(command)
    except ValueError:
        yield "its first line is no command"
        return
    if words[:2] != ["tsbench", "run"]:
        yield f"its first line is no command of tsbench run: {quoted(command)}"
    for word in words[2:]:
        key, equals, value = word.partition("=")
        key = key.lstrip("+")
        if key in ("task", "method"):
            key += ".name"
        if not (equals and KEY.fullmatch(key) and WORD.fullmatch(value)):
            continue
        if key in ELSEWHERE or key.startswith("hydra.") or (key, value) == ("device", "auto"):
            continue
        found = _at(settings, key)
        if found is not _MISSING and found != _value(value):
            yield f"the command says {quoted(word)}, the value is {quoted(found)}"
        if found is _MISSING:
            yield f"the command says {quoted(word)}, there is no such value"


_MISSING = object()


def _at(values: Any, key: str) -> Any:
    for name in key.split("."):
        if not isinstance(values, Mapping) or name not in values:
            return _MISSING
        values = values[name]
    return values


def _value(word: str) -> Any:
    """The value of a word in Hydra's grammar: a number, true, false, null, or text."""
    if word.lower() in _PLAIN:
        return _PLAIN[word.lower()]
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    return word


def _of_versions(values: dict[str, Any], settings: Any, score: Score) -> Iterator[str]:
    found = dict(values)
    for key, right in _FORMS.items():
        if key not in found and key not in _SINCE:
            yield f"it has no {key}"
        elif key in found and not right(found[key]):
            yield f"{key} cannot be {quoted(found[key])}"
        found.pop(key, None)
    for key in found:
        yield f"it has a key {quoted(key)}, which tsbench does not write"
    if settings is not None and ("device" in values) != (settings.get("device", "cpu") != "cpu"):
        yield "it names a device that the configuration does not, or none"
    if settings is not None and not _fits(settings, values["configuration"]):
        yield "configuration is the hash of another configuration than config.yaml"
    origin = score.origin
    same = values["packages"].get("mujoco") == origin.packages.get("mujoco")
    if same and values["physics"] != {origin.task: origin.model}:
        yield f"physics is not the model of {origin.task} that was scored with the same mujoco"


def _fits(settings: Any, digest: str) -> bool:
    try:
        return identity_hash(settings) == digest
    except TypeError:  # a value, such as a date, that no configuration has
        return False


def _is(pattern: re.Pattern[str]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, str) and pattern.fullmatch(value) is not None


def _mapping(right: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """Whether a value is key: value pairs of names and right values."""
    return lambda value: (
        isinstance(value, Mapping)
        and all(_NAME.fullmatch(str(key)) and right(one) for key, one in value.items())
    )


def _line(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= 200 and value.isprintable()


# What each value of versions.json has to be.
_FORMS: dict[str, Callable[[Any], bool]] = {
    "configuration": _is(_HASH),
    "python": _is(_VERSION),
    "packages": _mapping(lambda one: one is None or _is(_VERSION)(one)),
    "code": _is(_HASH),
    "plug-ins": _mapping(
        lambda one: (
            isinstance(one, Mapping)
            and set(one) == {"version", "code"}
            and _line(one["version"])
            and _is(_HASH)(one["code"])
        )
    ),
    "physics": _mapping(_is(_HASH)),
    "device": lambda value: _line(value) or _mapping(_line)(value),
    "processes": lambda value: type(value) is int and 1 < value <= MAX_PROCESSES,
    "platform": _line,
    "commit": lambda value: value is None or _is(_COMMIT)(value),
}
_SINCE = {"plug-ins", "device", "processes"}  # keys that not every run has
