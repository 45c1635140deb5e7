"""The words of `tsbench run`, checked for what people type instead of `key=value`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from tsbench import methods, tasks
from tsbench.cli import places
from tsbench.core.errors import TsbenchError, nearest, quoted
from tsbench.runs.directory import RunDirectory
from tsbench.runs.schema import RunConfig

KEYS = (*(field.name for field in fields(RunConfig)), "resume")
PATHS = ("directory=", "resume=")  # words whose value is a path


def expanded(words: Sequence[str]) -> list[str]:
    """The words with ~ for the home directory in paths, which a shell leaves after `=`."""
    found = []
    for word in words:
        key, separator, value = word.partition("=")
        if f"{key}=" in PATHS and value.startswith("~"):
            value = str(places.path(value))
        found.append(f"{key}{separator}{value}")
    return found


def check(words: Sequence[str]) -> None:
    """Checks that words are `key=value`.

    Raises:
        TsbenchError: one is not. The message says which word is meant, where that can be guessed.
    """
    for word in words:
        if "=" not in word and not word.startswith("~"):
            hint = _of_bare(word)
            raise TsbenchError(f"cannot read {quoted(word)}: words are key=value{hint}")


def _of_bare(word: str) -> str:
    """A hint for a name without its key."""
    named = {name: f"task={name}" for name in tasks.names()}
    named |= {name: f"method={name}" for name in methods.names()}
    if RunDirectory(places.path(word)).begun:
        return _meant(f"resume={word}")
    near = nearest(word, named)
    return _meant(named[near]) if near else ""


def of_flag(word: str, words: Sequence[str]) -> str:
    """A hint for a key that is given as a flag, `--seed 3` or `--seed=3`.

    Args:
        word: the flag, which `tsbench run` does not have.
        words: all words of the command line.
    """
    flag, _, value = word.partition("=")
    key = nearest(flag.lstrip("-"), KEYS)
    if key is None:
        return ""
    following = list(words[words.index(word) + 1 :])
    if not value and following and "=" not in following[0]:
        value = following[0]
    return _meant(f"{key}={value or '...'}")


def _meant(word: str) -> str:
    return f" (did you mean {word}?)"
