"""`tsbench describe`: show the card of a task or of a method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tsbench.cli.arguments import verb_parser


def call(words: Sequence[str]) -> None:
    parser = verb_parser("describe")
    parser.add_argument("name", metavar="NAME", help="of either, which `tsbench list` gives")
    show_card(parser.parse_args(words))


def show_card(options: Any) -> None:
    from rich.console import Console

    from tsbench.cli import describe
    from tsbench.core.files import write_json

    name = options.name.removeprefix("task=").removeprefix("method=")
    write_json(options.json, describe.show(Console(), name))
