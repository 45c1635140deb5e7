"""The table that `tsbench bench` prints."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from tsbench.bench import Findings


def show(console: Console, findings: Findings) -> None:
    """Prints figures, ratios, notes and the machine.

    Args:
        console: prints them.
        findings: the results of comparisons.
    """
    for title, ranges in (("figures", findings.figures), ("ratios", findings.ratios)):
        table = Table(box=SIMPLE_HEAD, pad_edge=False)
        table.add_column(title, no_wrap=True)
        for header in ("median", "least", "most"):
            table.add_column(header, justify="right")
        table.add_column("")
        for name, value in ranges.items():
            spread = (value.median, value.least, value.most)
            table.add_row(name, *(_three_digits(number) for number in spread), value.unit)
        if ranges:
            console.print(table)
    for note in findings.notes:
        console.print(note, highlight=False, soft_wrap=True)
    versions = ", ".join(f"{key} {value}" for key, value in findings.machine.items())
    console.print(versions, highlight=False, soft_wrap=True)


def _three_digits(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:#.3g}"
