"""`tsbench figures`: make the paper's figures and its table again, from runs or results."""

from __future__ import annotations

from collections.abc import Sequence

from tsbench.cli import places
from tsbench.cli.arguments import add_runs, verb_parser


def call(words: Sequence[str]) -> None:
    parser = verb_parser("figures", json=False)
    add_runs(parser)
    out = "a new folder, which gets index.html and the figures as PNG, SVG and CSV"
    parser.add_argument("--out", type=places.path, required=True, metavar="DIR", help=out)
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.cli import tables
    from tsbench.runs import results
    from tsbench.viewer.paper import page

    lines, remarks = page.write(results.read(options.runs), options.out)
    console = Console()
    tables.show_scores(console, lines)
    for line in remarks:
        console.print(f" {line}", markup=False, highlight=False, soft_wrap=True)
    console.print(f" {options.out / 'index.html'}", markup=False, highlight=False, soft_wrap=True)
