"""Writes the paper's figures: pictures, their data, the table, and one page that shows them."""

from __future__ import annotations

import base64
import csv
import html
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib

from tsbench import tasks
from tsbench.core.errors import TsbenchError, os_errors
from tsbench.core.files import taken, write_new
from tsbench.core.words import command
from tsbench.runs.results import CONSTANTS, Results
from tsbench.viewer.page import fill
from tsbench.viewer.paper import ladder, learning, maps, plans, scores, strips, surfaces
from tsbench.viewer.paper.exhibit import DPI, STYLE, Exhibit, Group, grouped

DISTANCE = f"{CONSTANTS}distance="  # the constant that a ladder changes


def write(results: Results, out: Path) -> tuple[list[scores.Line], list[str]]:
    """Makes all figures that the results have data for.

    Args:
        results: of runs, entries and results folders.
        out: a new or empty folder.

    Returns:
        The table of scores, and a line for each thing that a reader must know of them.

    Raises:
        TsbenchError: the folder holds files, or a policy or plan is missing or damaged.
    """
    with os_errors(out):
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise taken(out, way_out="give another by --out DIR")
        out.mkdir(parents=True, exist_ok=True)
    groups = grouped(results.groups())
    standard = [group for group in groups if group.first.standard]
    rungs = [group for group in groups if _is_rung(group)]
    made = {name: tasks.make(name) for name in dict.fromkeys(group.task for group in standard)}
    remarks = _remarks(groups, rungs, standard)
    exhibits: list[Exhibit] = []
    lines: list[scores.Line] = []
    if standard:
        first, lines = scores.exhibit(standard, made)
        exhibits.append(first)
    exhibits += maps.exhibits(results, standard)
    exhibits += learning.exhibits(results, standard, made)
    exhibits += plans.exhibits(results, standard, made)
    try:
        exhibits += strips.exhibits(results, standard, made)
    except TsbenchError as error:
        remarks.append(f"motion strips left out: {error}")
    exhibits += surfaces.exhibits(standard, made)
    exhibits += ladder.exhibits(rungs)
    if not exhibits:
        raise TsbenchError("these results have no figures: none is of a standard task or a ladder")
    pictures = {exhibit.name: _save(exhibit, out) for exhibit in exhibits}
    write_new(out / "table.csv", _csv(scores.COLUMNS, [scores.cells(line) for line in lines]))
    write_new(out / "table.md", _markdown(lines).encode())
    content = fill(
        "paper/page.html",
        {
            "table": _table(lines),
            "figures": "".join(_section(exhibit, pictures[exhibit.name]) for exhibit in exhibits),
            "commands": "".join(_commands(groups)),
            "remarks": "".join(f"<li>{html.escape(line)}</li>" for line in remarks),
        },
    )
    write_new(out / "index.html", content.encode())
    return lines, remarks


def _is_rung(group: Group) -> bool:
    """Whether nothing but the goal's distance differs from the standard task."""
    changed = [word for word in group.first.words if word.startswith(CONSTANTS)]
    return all(word.startswith(DISTANCE) for word in changed)


def _remarks(
    groups: Sequence[Group], rungs: Sequence[Group], standard: Sequence[Group]
) -> list[str]:
    found = [
        f"{group.task}, {group.label}: left out, since its constants were changed"
        for group in groups
        if group not in rungs and group not in standard
    ]
    for group in groups:
        protocols = {row.score.origin.protocol for row in group.rows if row.score}
        found += [
            f"{group.task}, {group.label}: protocol {protocol.name} asks too little for a rank"
            for protocol in protocols
            if not protocol.ranked
        ]
        if len({row.settings for row in group.rows}) > 1:
            found.append(
                f"{group.task}, {group.label}: its seeds were trained with several settings, "
                "though with the same words"
            )
        for row in group.rows:
            if row.failure:
                found.append(f"{row.command}: no policy, {row.failure}")
    return found


def _save(exhibit: Exhibit, out: Path) -> bytes:
    """Writes PNG, SVG and CSV. Returns the PNG."""
    contents = {}
    with matplotlib.rc_context(STYLE):
        for kind in ("svg", "png"):
            content = io.BytesIO()
            metadata = {"Date": None} if kind == "svg" else {"Software": None}
            exhibit.figure.savefig(content, format=kind, dpi=DPI, metadata=metadata)
            contents[kind] = content.getvalue()
    for kind, drawn in contents.items():
        write_new(out / f"{exhibit.name}.{kind}", drawn)
    write_new(out / f"{exhibit.name}.csv", _csv(exhibit.columns, exhibit.rows))
    return contents["png"]


def _csv(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue().encode()


def _markdown(lines: Sequence[scores.Line]) -> str:
    rows = [scores.COLUMNS, ["---"] * len(scores.COLUMNS), *map(scores.cells, lines)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _table(lines: Sequence[scores.Line]) -> str:
    def row(found: Sequence[str], kind: str) -> str:
        return f"<tr>{''.join(f'<{kind}>{html.escape(one)}</{kind}>' for one in found)}</tr>"

    body = "".join(row(scores.cells(line), "td") for line in lines)
    return f"<table>{row(scores.COLUMNS, 'th')}{body}</table>"


def _section(exhibit: Exhibit, picture: bytes) -> str:
    name, data = exhibit.name, base64.b64encode(picture).decode()
    claims = "".join(
        f'<tr class="{claim.verdict.name.lower()}">'
        f"<td>{html.escape(claim.says)}</td><td>{html.escape(claim.found)}</td>"
        f"<td><b>{claim.verdict}</b></td></tr>"
        for claim in exhibit.claims
    )
    head = "<tr><th>the paper says</th><th>what came out</th><th></th></tr>"
    return (
        f'<section id="{name}"><h2>{html.escape(exhibit.title)}</h2>'
        f'<img alt="{html.escape(exhibit.title)}" src="data:image/png;base64,{data}">'
        f"<p>{html.escape(exhibit.note)}</p>"
        + (claims and f'<div class="wide"><table class="claims">{head}{claims}</table></div>')
        + "<p>"
        + " ".join(f'<a href="{name}.{kind}">{kind.upper()}</a>' for kind in ("png", "svg", "csv"))
        + "</p></section>"
    )


def _commands(groups: Sequence[Group]) -> Iterator[str]:
    for group in groups:
        first = group.first
        words = [word for word in first.words if not word.startswith("seed=")]
        seeds = ",".join(str(row.seed) for row in group.rows)
        line = command("run", "-m", *words, f"seed={seeds}")
        yield f"<li><code>{html.escape(line)}</code></li>"
