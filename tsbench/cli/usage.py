"""Help texts in the width of the terminal."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from textwrap import fill

WIDEST = 99  # columns, in which the texts are written
TERMS = 0.4  # of the width may be for the terms; else an explanation stands under its term
_ROW = re.compile(r"  (?P<term>\S.*?)(?: {2,}(?P<text>\S.*))?")


def fitted(text: str, width: int | None = None) -> str:
    """A help text with its paragraphs and rows wrapped.

    A row is a line that is indented by two, with a term and after two spaces or more its
    explanation, which deeper indented lines continue. A line without an explanation, such as an
    example, stays as it is.

    Args:
        text: in lines of at most `WIDEST` columns.
        width: in columns; None for that of the terminal.
    """
    width = min(width or shutil.get_terminal_size().columns, WIDEST)
    if width == WIDEST:
        return text
    return "\n".join(_wrapped(block, width) for block in _blocks(text)).rstrip("\n") + "\n"


def _blocks(text: str) -> Iterator[tuple[str, str, int]]:
    """Term, explanation and column of each row; a paragraph has no term."""
    term, words, column = "", "", 0
    for line in [*text.splitlines(), ""]:
        indent = len(line) - len(line.lstrip())
        if line.strip() and (indent > 2 or (indent == 0 and words and not term)):
            words, column = f"{words} {line.strip()}".strip(), column or indent
            continue
        if term or words:
            yield term, words, column
        if not line.strip():
            yield "", "", 0
        row = _ROW.fullmatch(line)
        term, words = (row["term"], row["text"] or "") if row else ("", line)
        column = row.start("text") if row and row["text"] else 0


def _wrapped(block: tuple[str, str, int], width: int) -> str:
    term, words, column = block
    if not term:
        hanging = " " * 7 if words.startswith("usage:") else ""
        return _fill(words, width, "", hanging)
    if not words:
        return f"  {term}"
    if column > TERMS * width or len(term) + 4 > column:
        return f"  {term}\n{_fill(words, width, ' ' * 6, ' ' * 6)}"
    return _fill(words, width, f"  {term}".ljust(column), " " * column)


def _fill(words: str, width: int, first: str, others: str) -> str:
    return fill(
        words, width, initial_indent=first, subsequent_indent=others, break_on_hyphens=False,
        break_long_words=False,
    )  # fmt: skip
