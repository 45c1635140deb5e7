"""`tsbench submit`: pack runs into an entry of the leaderboard."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from tsbench.cli import places
from tsbench.cli.arguments import count, seeds, threads, verb_parser
from tsbench.cli.verdicts import show_verdict, tell
from tsbench.core.errors import TsbenchError
from tsbench.leaderboard.kept import BOARD


def call(words: Sequence[str]) -> int:
    parser = verb_parser("submit")
    flag = parser.add_argument
    flag("runs", nargs="+", type=places.path, metavar="RUN", help="a run, or an exported policy")
    flag("--name", required=True, help="of the entry: its directory")
    flag("--author", required=True, action="append", metavar="NAME", help="one of the authors")
    flag("--licence", required=True, metavar="NAME", help="of the files, e.g. MIT")
    flag("--url", help="where the method is described")
    flag("--hardware", metavar="TEXT", help="that trained it")
    flag("--tuning-trials", type=count, metavar="N", help="choices of settings tried before")
    flag("--trained", type=seeds, metavar="SEEDS", help="all that were trained, e.g. 0-9 (RUNs')")
    flag("--rescore", action="store_true", help="score again what has a score")
    flag("--check", action="store_true", help="run the whole verification and keep nothing")
    flag("--board", type=places.path, default=BOARD, metavar="DIRECTORY", help="(leaderboards)")
    flag("--threads", type=threads, metavar="N", help="CPU threads (all)")
    told = parser.add_argument_group("of policies that tsbench did not train")
    told.add_argument("--seeds", type=seeds, metavar="SEEDS", help="one for each RUN, e.g. 0-2")
    told.add_argument("--steps", type=count, metavar="N", help="environment steps of each that "
                      "has no score.json")  # fmt: skip
    told.add_argument("--seconds", type=float, metavar="S", help="of each training without one")
    told.add_argument("--command", metavar="TEXT", help="that trained those that are in no entry")
    told.add_argument("--code", metavar="COMMIT", help="of the code that trained them")
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.core.files import write_json
    from tsbench.evaluation.evaluate import evaluate
    from tsbench.evaluation.protocol import V1
    from tsbench.leaderboard import submission, verify
    from tsbench.runs.directory import RunDirectory
    from tsbench.runs.progress import progress_bar

    console = Console(stderr=True)
    try:
        described = submission.Described(
            entry=options.name,
            authors=tuple(options.author),
            licence=options.licence,
            url=options.url,
            hardware=options.hardware,
            tuning_trials=options.tuning_trials,
            seeds_trained=tuple(options.trained or ()),
        )
    except ValueError as error:
        raise TsbenchError(str(error)) from None
    foreign = (options.seeds, options.steps, options.seconds, options.command)
    if any(one is not None for one in (*foreign, options.code)):
        if own := [run.path for run in map(RunDirectory, options.runs) if run.begun]:
            parser.error(f"{own[0]} is a run of tsbench, which says its own seed and steps")
        if None in foreign:
            parser.error(f"{submission.FOREIGN} are given together or not at all")
        if len(options.seeds) != len(options.runs):
            parser.error(f"{len(options.seeds)} --seeds for {len(options.runs)} runs")
    given = None
    if options.command is not None:
        try:
            given = submission.Told(
                tuple(options.seeds), options.command, options.steps, options.seconds, options.code
            )
        except ValueError as error:
            raise TsbenchError(str(error)) from None

    def score(policy: Any, task: Any) -> Any:
        with progress_bar(console, "evaluate") as progress:
            return evaluate(policy, task, protocol=V1, threads=options.threads, progress=progress)

    packed = submission.pack(
        options.runs, described, options.board, V1, told=given, score=score,
        rescore=options.rescore, tell=tell(console),
    )  # fmt: skip
    try:
        submission.home(packed, options.board, V1, options.runs)
        asked = verify.Asked(rescore=options.check, threads=options.threads)
        verdict = verify.verify(packed, asked, tell(console))
        show_verdict(Console(), verdict)
        if verdict.passed and not options.check:
            place = submission.place(packed, options.board, V1, options.runs)
            sys.stdout.write(f"{place}\n")
    finally:
        submission.discard(packed)
    write_json(options.json, asdict(verdict))
    return int(not verdict.passed)
