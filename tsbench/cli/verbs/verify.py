"""`tsbench verify`: check whether entries of the leaderboard hold what they claim."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from tsbench.cli import places
from tsbench.cli.arguments import new_file, threads, verb_parser
from tsbench.cli.verdicts import BOARD_HELP, show_verdict, tell
from tsbench.core.errors import TsbenchError
from tsbench.leaderboard.kept import BOARD


def call(words: Sequence[str]) -> int:
    parser = verb_parser("verify")
    flag = parser.add_argument
    what = "directories of entries, or kept ones (TASK/ENTRY)"
    flag("entries", nargs="*", type=places.entry, metavar="ENTRY", help=what)
    flag("--all", action="store_true", help="every entry of the board")
    flag("--quick", action="store_true", help="replay the kept actions only, in seconds")
    flag("--seed-file", type=places.path, metavar="FILE", help="score from the hidden starts too")
    flag("--retrain", action="store_true", help="train again by the recorded configuration")
    flag("--record", action="store_true", help="keep the verdicts in verdicts/ of the board")
    flag("--retract", metavar="REASON", help="take the entries back, and keep that verdict")
    flag("--pull-request", metavar="BASE", help="the entries that HEAD adds to this commit")
    flag("--in", dest="checkout", type=places.path, default=Path(), metavar="DIRECTORY",
         help="with --pull-request: the repository (here)")  # fmt: skip
    flag("--comment", type=new_file, metavar="FILE", help="write the verdicts as Markdown too")
    flag("--board", type=places.path, metavar="DIRECTORY", help=BOARD_HELP)
    flag("--threads", type=threads, metavar="N", help="CPU threads (all)")
    options = parser.parse_args(words)
    if sum((bool(options.entries), options.all, options.pull_request is not None)) != 1:
        parser.error("one of ENTRY, --all and --pull-request BASE is needed")
    if options.quick and (options.seed_file or options.retrain):
        parser.error("--quick makes no score again, which --seed-file and --retrain build on")
    from rich.console import Console

    from tsbench.core.files import write_json, write_new
    from tsbench.leaderboard import pull_request, verify

    console = Console()
    written = options.record or options.retract is not None
    board = places.board(options.board, BOARD, written=written)
    for entry in options.entries:
        if not (entry.is_dir() or entry.is_symlink()):
            raise TsbenchError(f"no entry {entry}")
    faults: list[str] = []
    if options.pull_request is not None:
        entries, faults = pull_request.entries(options.checkout, options.pull_request)
    else:
        entries = verify.entries(board) if options.all else options.entries
    if options.all and not entries:
        raise TsbenchError(f"no entries in {board}")
    train = None
    if options.retrain:
        from tsbench.runs.execute import execute

        train = execute
    seed = options.seed_file and verify.hidden_seed(options.seed_file, board)
    asked = verify.Asked(not options.quick, seed, train, options.threads)
    verdicts = []
    for fault in faults:
        console.print(f"refused: {fault}", markup=False, highlight=False, soft_wrap=True)
    entries = [] if faults else entries
    for entry in entries if written else ():
        verify.check_lies_on(board, entry)
    for entry in entries:
        if options.retract is not None:
            verdict = verify.retracted(entry, options.retract)
        elif options.record and verify.is_retracted(board, entry):
            line = f"{entry} stays retracted, as {verify.place(board, entry)} says"
            console.print(line, markup=False, highlight=False, soft_wrap=True)
            continue
        else:
            verdict = verify.verify(entry, asked, tell(Console(stderr=True)))
        show_verdict(console, verdict)
        verdicts.append(verdict)
        if verdict.digest and written:
            place = verify.record(board, entry, verdict)
            kept = f"kept as it is: {verify.place(board, entry)} says as much or more"
            sys.stdout.write(f"{place or kept}\n")
    if options.comment:
        write_new(options.comment, verify.comment(verdicts, faults).encode())
    shown = {"refused": faults, "verdicts": [asdict(verdict) for verdict in verdicts]}
    write_json(options.json, shown)
    if options.retract is not None:
        return 0
    return int(bool(faults) or not all(verdict.passed for verdict in verdicts))
