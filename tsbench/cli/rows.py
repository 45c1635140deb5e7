"""Rows of values: a table where the terminal is wide enough for it, else a list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

GAP = 3  # columns between two columns of a table
LEAST = 20  # columns that a folded column needs

Row = Sequence[str]


@dataclass(frozen=True)
class Section:
    """Attributes:
    headers: of the columns. The first column names the rows.
    rows: the values, one for each header.
    verdict: a line above the rows, or "".
    """

    headers: Row
    rows: Sequence[Row]
    verdict: str = ""


def show_rows(
    console: Console, headers: Row, rows: Sequence[Row], *, title: str = "", folded: int | None = 0
) -> None:
    """Prints rows, as `show_sections` does."""
    show_sections(console, [Section(headers, rows)], title=title, folded=folded)


def show_sections(
    console: Console, sections: Sequence[Section], *, title: str = "", folded: int | None = 0
) -> None:
    """Prints sections of rows with the same number of columns. Nothing is cut: in a terminal that
    is too narrow for a table each row becomes a paragraph.

    Args:
        console: the terminal.
        sections: with at least one row in all.
        title: above the table.
        folded: the column whose texts are folded to the width; None for none.
    """
    if not _fits(console, sections, folded):
        _show_list(console, sections, title)
        return
    first = sections[0]
    table = Table(
        title=escape(title) or None, title_justify="left", box=SIMPLE_HEAD, pad_edge=False,
        show_header=any(first.headers),
    )  # fmt: skip
    numeric = len(sections) > 1
    for place, header in enumerate(first.headers):
        right = "right" if numeric and place else "left"
        table.add_column(
            escape(header),
            no_wrap=place != folded,
            overflow="fold",
            justify=right,  # type: ignore[arg-type]
        )
    for section in sections:
        if section is not first:
            table.add_section()
            table.add_row(*map(escape, section.headers), style="bold")
        if section.verdict:
            table.add_row(section.verdict, style="bold")
        for row in section.rows:
            table.add_row(*map(escape, row))
    console.print(table)


def _fits(console: Console, sections: Sequence[Section], folded: int | None) -> bool:
    rows = [row for section in sections for row in (section.headers, *section.rows)]
    fixed = [place for place in range(len(rows[0])) if place != folded]
    widths = [max(len(row[place]) for row in rows) for place in fixed]
    least = 0 if folded is None else min(LEAST, max(len(row[folded]) for row in rows))
    return sum(widths) + least + GAP * len(rows[0]) <= console.width


def _show_list(console: Console, sections: Sequence[Section], title: str) -> None:
    def say(line: str, indent: int = 0, style: str = "") -> None:
        console.print(Padding(Text(line, style=style, overflow="fold"), (0, 0, 0, indent)))

    if title:
        say(title)
    for section in sections:
        if len(sections) > 1:
            say(section.headers[0], style="bold")
        if section.verdict:
            say(section.verdict, style="bold")
        for row in section.rows:
            say(row[0])
            pairs = zip(section.headers[1:], row[1:], strict=True)
            say("; ".join(f"{head}: {text}" if head else text for head, text in pairs if text), 2)
    console.print()
