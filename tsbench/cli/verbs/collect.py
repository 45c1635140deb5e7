"""`tsbench collect`: keep the scores, curves and best policies of many runs as data."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tsbench.cli import places
from tsbench.cli.arguments import add_runs, verb_parser, whole_number


def call(words: Sequence[str]) -> None:
    parser = verb_parser("collect", json=False)
    add_runs(parser)
    out = "the results folder, which is made where there is none"
    parser.add_argument("--out", type=places.path, required=True, metavar="DIR", help=out)
    trials = "trials that were spent on tuning the settings of these runs"
    parser.add_argument("--trials", type=_trials, metavar="N", help=trials)
    options = parser.parse_args(words)
    from tsbench.runs import results

    found = results.read(options.runs)
    there = (options.out / results.ROWS).exists()
    before = results.load(options.out).rows.keys() if there else set()
    kept = results.collect(found, options.out, options.trials)
    replaced = len(found.rows.keys() & before)
    added = len(found.rows) - replaced
    sys.stdout.write(
        f"{options.out}: {added} added, {replaced} replaced, {len(kept.rows)} in all\n"
    )


def _trials(word: str) -> int:
    return whole_number(word, 0, 10**6)
