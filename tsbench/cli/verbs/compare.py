"""`tsbench compare`: put runs beside each other: scores, learning curves, statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from tsbench.cli import places
from tsbench.cli.arguments import new_file, verb_parser


def call(words: Sequence[str]) -> None:
    parser = verb_parser("compare")
    what = "runs, kept entries (TASK/ENTRY), results folders, or folders with such in them"
    parser.add_argument("runs", nargs="+", metavar="RUN", help=what)
    parser.add_argument(
        "--png", type=new_file, metavar="FILE", help="write the learning curves as one picture"
    )
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.cli import tables
    from tsbench.core.files import write_json, write_new
    from tsbench.runs import results
    from tsbench.viewer import comparison

    parts = [results.read([places.entry(word)]) for word in options.runs]
    everything = results.Results()
    for part in parts:
        everything.update(part)
    console, pairs = Console(), comparison.pairs(everything)
    names = comparison.names(everything)
    tables.show_runs(console, dict(zip(options.runs, parts, strict=True)), names)
    tables.show_pairs(console, pairs, incomparable=comparison.incomparable(everything))
    if options.png:
        write_new(options.png, comparison.picture(everything))
        console.print(f" {options.png}", markup=False, highlight=False, soft_wrap=True)
    runs = [
        {"run": word, "words": row.words, "score": row.score.as_dict() if row.score else None}
        for word, part in zip(options.runs, parts, strict=True)
        for row in part.rows.values()
    ]
    write_json(options.json, {"runs": runs, "pairs": [asdict(pair) for pair in pairs]})
