"""`tsbench leaderboard`: show the leaderboard: as tables, or as a site."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tsbench.cli import places
from tsbench.cli.arguments import verb_parser
from tsbench.cli.verdicts import BOARD_HELP, tell
from tsbench.leaderboard.kept import BOARD


def call(words: Sequence[str]) -> None:
    parser = verb_parser("leaderboard")
    flag = parser.add_argument
    flag("--board", type=places.path, metavar="DIRECTORY", help=BOARD_HELP)
    flag("--html", type=places.path, metavar="DIRECTORY", help="write the site there")
    flag("--plain", action="store_true", help="a site without 3-D views and figures, in seconds")
    flag("--readme", action="store_true", help="write the tables into README.md of the board")
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.core.errors import os_errors
    from tsbench.core.files import write_json, write_whole
    from tsbench.leaderboard import page
    from tsbench.viewer import report

    board = places.board(options.board, BOARD, written=options.readme)
    if options.html:
        render = None if options.plain else report.render
        written = page.write_site(board, options.html, render, tell(Console(stderr=True)))
        sys.stdout.write(f"{written[-1]}\n")
    found = page.tables(board)
    if options.readme or not options.html:
        readme = board / "README.md"
        with os_errors(readme):
            before = readme.read_text(encoding="utf-8") if readme.exists() else "# Leaderboards\n"
            text = page.markdown(*found, before.partition("\n## ")[0])
            if options.readme:
                write_whole(readme, text.encode())
        tables = text[text.index("\n## ") + 1 :]
        sys.stdout.write(f"{readme}\n" if options.readme else tables)
    write_json(options.json, page.plain(*found))
