"""`tsbench doctor`: say what works on this machine."""

from __future__ import annotations

from collections.abc import Sequence

from tsbench.cli.arguments import verb_parser


def call(words: Sequence[str]) -> None:
    parser = verb_parser("doctor")
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.cli import doctor
    from tsbench.core.files import write_json

    console, found = Console(), list[tuple[str, str]]()
    for subject, state in doctor.findings():
        found.append((subject, state))
        line = f"{subject:<18} {state}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    refused = [state for subject, state in found if subject == "refused"]
    write_json(options.json, {**dict(found), "refused": refused})
