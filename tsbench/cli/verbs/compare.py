"""`tsbench compare`: put runs beside each other: scores, learning curves, statistics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from tsbench.cli import places
from tsbench.cli.arguments import new_file, verb_parser

if TYPE_CHECKING:
    from tsbench.runs.results import Results


def call(words: Sequence[str]) -> None:
    parser = verb_parser("compare")
    what = (
        "runs, kept entries (TASK/ENTRY), results folders, or folders with such in them; runs by "
        "one command are told apart by these words"
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help=what)
    parser.add_argument(
        "--png", type=new_file, metavar="FILE", help="write the learning curves as one picture"
    )
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.cli import tables
    from tsbench.core.files import check_ending, write_json, write_new
    from tsbench.runs import results
    from tsbench.viewer import comparison

    if options.png:
        check_ending(options.png, ".png")
    found = {word: results.read([places.entry(word)]) for word in options.runs}
    parts = _told_apart(found)
    everything = results.Results()
    for part in parts.values():
        everything.update(part)
    console, pairs = Console(), comparison.pairs(everything)
    names = comparison.names(everything)
    tables.show_runs(console, parts, names)
    tables.show_pairs(console, pairs, incomparable=comparison.incomparable(everything))
    if options.png:
        write_new(options.png, comparison.picture(everything))
        console.print(f" {options.png}", markup=False, highlight=False, soft_wrap=True)
    runs = [
        {"run": word, "words": row.words, "score": row.score.as_dict() if row.score else None}
        for word, part in found.items()
        for row in part.rows.values()
    ]
    write_json(options.json, {"runs": runs, "pairs": [asdict(pair) for pair in pairs]})


def _told_apart(found: Mapping[str, Results]) -> dict[str, Results]:
    """The results under each word of the command line. Where two words have runs by one command,
    such as those before and after a change of the code, the place becomes a part of what names
    these runs and those that differ from them in the seed alone."""
    from tsbench.runs.directory import RunDirectory
    from tsbench.runs.results import Results

    counts = Counter(name for part in found.values() for name in part.rows)
    clash = {name for name, count in counts.items() if count > 1}
    kinds = {part.rows[name].kind for part in found.values() for name in clash & part.rows.keys()}
    homes = {}  # runs that are named one by one belong to the folder in which they lie
    for word in found:
        place = places.entry(word)
        homes[word] = str(place.parent) if RunDirectory(place).begun else word
    within = Counter((homes[word], name) for word, part in found.items() for name in part.rows)
    if max(within.values(), default=0) > 1:
        homes = {word: word for word in found}
    parts = {}
    for word, part in found.items():
        names = {
            name: (*name, f"in {homes[word]}") if row.kind in kinds else name
            for name, row in part.rows.items()
        }
        parts[word] = Results(
            {names[name]: replace(row, words=names[name]) for name, row in part.rows.items()},
            {names.get(name, name): curves for name, curves in part.curves.items()},
            {names.get(name, name): folder for name, folder in part.folders.items()},
        )
    return parts
