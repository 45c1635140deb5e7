"""`tsbench report`: write one page about a run: plan, motion, score and learning."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tsbench.cli import places
from tsbench.cli.arguments import verb_parser


def call(words: Sequence[str]) -> None:
    parser = verb_parser("report", json=False)
    parser.add_argument("run", metavar="RUN", help="a finished run's directory, or TASK/ENTRY")
    what = "the new page (the missing ones of report.html and view.html in RUN)"
    parser.add_argument("--html", type=places.path, metavar="FILE", help=what)
    options = parser.parse_args(words)
    from tsbench.core.files import check_ending, check_new, write_new
    from tsbench.runs.directory import RunDirectory
    from tsbench.viewer import report

    run = RunDirectory(places.run(options.run))
    report.check_finished(run)
    path = options.html or run.report_file
    check_ending(path, ".html")
    if options.html or run.view_file.exists():
        check_new(path, "give another by --html FILE")
    if options.html:
        write_new(path, report.render(run).encode())
    else:
        report.write_pages(run)
    sys.stdout.write(f"{path}\n")
