"""`tsbench bench`: measure speed, beside alternatives."""

from __future__ import annotations

from collections.abc import Sequence

from tsbench.cli.arguments import verb_parser


def call(words: Sequence[str]) -> None:
    parser = verb_parser("bench")
    parser.add_argument("--only", metavar="NAME", help="one comparison, such as laikago")
    parser.add_argument("--quick", action="store_true", help="a minute, with wider ranges")
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench import bench
    from tsbench.bench import table
    from tsbench.core.files import write_json

    progress = Console(stderr=True)
    findings = bench.measure(
        options.only, quick=options.quick, tell=lambda name: progress.print(f"measuring {name}")
    )
    table.show(Console(), findings)
    write_json(options.json, findings.as_dict())
