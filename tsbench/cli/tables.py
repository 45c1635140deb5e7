"""The tables and lines that show results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tsbench.core.task import Task
from tsbench.core.words import duration, number
from tsbench.evaluation.flips import Flips
from tsbench.evaluation.score import Score
from tsbench.evaluation.words import FIGURES, counts, episode_rows, push_rows, verdict
from tsbench.runs.directory import Record, RunDirectory
from tsbench.viewer.paper import scores

HEADLINES = ("solved_reward", "normalized_reward", "against_plan")


def score_table(title: str, score: Score, task: Task[Any]) -> Table:
    """The table of a score: perturbed starts, the task's own start, changed physics and pushes."""
    perturbed = score.perturbed
    table = Table(
        title=escape(title),
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        caption="\n".join(f"{name}: {FIGURES[name]}" for name in HEADLINES),
        caption_justify="left",
    )
    table.add_column(f"protocol {score.protocol}")
    table.add_column(f"{perturbed.episodes} perturbed starts", justify="right")
    table.add_column("own start", justify="right")
    table.add_row(verdict(perturbed), style="bold")
    for label, value, own in episode_rows(score, task):
        table.add_row(label, value, own)
    table.add_section()
    table.add_row("changed physics", "solved", "normalized_reward", style="bold")
    for name, change in score.changes.items():
        solved = f"{counts(change)[0]} of {change.episodes}"
        table.add_row(name, solved, number(change.normalized_reward))
    table.add_section()
    table.add_row("pushes", "survived", "task solved", style="bold")
    for label, survived, recovered in push_rows(score):
        table.add_row(label, survived, recovered)
    return table


def flips_table(physics: str, found: Sequence[Flips]) -> Table:
    """The numbers of verdicts that change in other physics."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(f"verdicts that change in physics {physics}")
    table.add_column("flipped", justify="right")
    table.add_column("share", justify="right")
    for one in found:
        table.add_row(one.verdict, f"{one.flipped} of {one.verdicts}", f"{one.share:.1%}")
    return table


def show_run(console: Console, record: Record, task: Task[Any]) -> None:
    """Prints the score of a finished run and the cost of each stage."""
    table = score_table(record.title, record.score, task)
    table.add_section()
    table.add_row("stage", "steps", "time", style="bold")
    for stage in record.stages:
        table.add_row(stage.name, f"{stage.steps:,}", duration(stage.seconds))
    console.print(table)
    show_rank(console, record.standard, record.score)


def show_scores(console: Console, lines: Sequence[scores.Line]) -> None:
    """Prints the scores of many runs: a table for each task, a column for each method."""
    for task in dict.fromkeys(line.group.task for line in lines):
        own = [line for line in lines if line.group.task == task]
        table = Table(title=task, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        for header in ("", *(line.group.label for line in own)):
            table.add_column(escape(header), overflow="fold")
        columns = [scores.cells(line) for line in own]
        for row in zip(scores.COLUMNS[2:-1], *(one[2:-1] for one in columns), strict=True):
            table.add_row(*(escape(one.replace(" [", "\n[")) for one in row))
        for name in own[0].measures:
            table.add_row(name, *(number(line.measures[name]) for line in own))
        console.print(table)


def show_places(console: Console, run: RunDirectory) -> None:
    """Prints the report's path and the command that makes the score again."""
    for label, place in (
        ("report", run.report_file),
        ("score again", f"tsbench evaluate {run.path}"),
    ):
        console.print(f" {label:<12} {place}", markup=False, highlight=False, soft_wrap=True)


def show_rank(console: Console, standard: bool, score: Score) -> None:
    """Prints why a score is not ranked, if so."""
    reasons = [] if standard else ["the task's constants were changed"]
    if not score.origin.protocol.ranked:
        reasons.append(f"protocol {score.protocol} plays too few episodes")
    if reasons:
        console.print(f" not ranked: {' and '.join(reasons)}", highlight=False)
