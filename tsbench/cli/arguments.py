"""The words after a verb: their parser, and their types."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from tsbench.cli import places
from tsbench.cli.verbs import VERBS
from tsbench.core.errors import TsbenchError, nearest

JSON_HELP = "write what is shown to a new JSON file too"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are TsbenchErrors of one line."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """The options, which may stand between positional words. An unknown one is refused with the
        nearest that there is."""
        options, others = self.parse_known_intermixed_args(args, namespace)
        if not others:
            return options
        flags = [flag for flag in self._option_string_actions if flag.startswith("--")]
        key = others[0].lstrip("-").partition("=")[0]
        near = nearest(f"--{key}", flags)
        hint = f" (did you mean {near}?)" if near else ""
        return self.error(f"unrecognized arguments: {' '.join(others)}{hint}")

    def error(self, message: str) -> NoReturn:
        raise TsbenchError(f"{message} (see {self.prog} --help)")


def verb_parser(verb: str, *, json: bool = True) -> Parser:
    summary = VERBS[verb]
    parser = Parser(f"tsbench {verb}", description=summary, allow_abbrev=False)
    if json:
        parser.add_argument("--json", type=new_file, metavar="FILE", help=JSON_HELP)
    return parser


def add_runs(parser: Parser) -> None:
    """Adds the words that `results.read` takes, as `runs`."""
    what = "runs, entries, results folders, or folders with such in them"
    parser.add_argument("runs", nargs="+", type=places.path, metavar="RUNS", help=what)


def new_file(word: str) -> Path:
    """The path of a new file, checked before hours of work whose result it will hold.

    Raises:
        TsbenchError: the file exists or cannot be written.
    """
    from tsbench.core.files import check_new

    path = places.path(word)
    check_new(path)
    return path


def threads(word: str) -> int:
    return whole_number(word, 1, 1024)


def count(word: str) -> int:
    return whole_number(word, 0, 2**53 - 1)


def seeds(word: str) -> list[int]:
    """Seeds as words say them: 0-2,5."""
    found: list[int] = []
    for part in word.split(","):
        first, dash, last = part.partition("-")
        try:
            low = whole_number(first, 0, 2**32 - 1)
            high = whole_number(last, low, 2**32 - 1) if dash else low
        except argparse.ArgumentTypeError as error:
            raise argparse.ArgumentTypeError(f"needs seeds such as 0-2,5: {error}") from None
        if high - low >= 1000:
            raise argparse.ArgumentTypeError(f"more than 1000 seeds: {part!r}")
        found += range(low, high + 1)
    return found


def whole_number(word: str, lowest: int, highest: int) -> int:
    if not (word.isdecimal() and lowest <= int(word) <= highest):
        message = f"must be a whole number from {lowest} to {highest}, not {word!r}"
        raise argparse.ArgumentTypeError(message)
    return int(word)
