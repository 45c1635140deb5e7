"""Results as the user sees them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table

from tsbench.evaluation.score import Score, Summary
from tsbench.record import Record, RunDirectory


def duration(seconds: float) -> str:
    """h:mm:ss, or m:ss below an hour."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def number(value: Any) -> str:
    """Four digits of a fraction; a dash for what is not known."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@contextmanager
def progress(console: Console, what: str) -> Iterator[Callable[[float], None]]:
    """A bar that takes shares from 0 to 1, on a terminal; elsewhere it shows nothing."""
    columns = (TextColumn("{task.description:<10}"), BarColumn(), TaskProgressColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        row = bar.add_task(what, total=1.0)
        yield lambda share: bar.update(row, completed=share)


def score_table(title: str, score: Score) -> Table:
    """A score: the task's own start beside the perturbed ones, changed physics, and pushes."""
    nominal, perturbed = score.nominal, score.perturbed
    table = Table(title=escape(title), title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(f"protocol {score.protocol}")
    table.add_column("task's own start", justify="right")
    table.add_column(f"{perturbed.episodes} perturbed starts", justify="right")
    table.add_row(
        "normalized_reward",
        number(score.normalized_reward),
        number(perturbed.normalized_reward),
    )
    table.add_row("optimality", number(score.optimality))
    for name in ("success", "violations", "steps", "goal_distance"):
        table.add_row(name, number(getattr(nominal, name)), number(getattr(perturbed, name)))
    table.add_section()
    table.add_row("changed physics", "normalized_reward", "success", style="bold")
    for name, change in score.changes.items():
        table.add_row(name, number(change.normalized_reward), number(change.success))
    robustness = score.robustness
    low, high = robustness.survival_100N_interval
    table.add_section()
    table.add_row("pushes", style="bold")
    table.add_row(
        "survival_100N", number(robustness.survival_100N), f"95 %: {low:.3f} to {high:.3f}"
    )
    if robustness.mass_scale != 1.0:
        table.add_row("  100 N scaled by mass", number(claim_force(score)), "N")
    bound = "at least " if robustness.impulse_50_is_lower_bound else ""
    table.add_row("impulse_50", f"{bound}{number(robustness.impulse_50)}", "N s")
    return table


def show_run(console: Console, record: Record) -> None:
    """Prints what ends a run: its score and what each stage cost."""
    table = score_table(run_title(record), record.score)
    table.add_section()
    table.add_row("stage", "steps", "time", style="bold")
    for stage in record.stages:
        table.add_row(stage.name, f"{stage.steps:,}", duration(stage.seconds))
    console.print(table)
    show_rank(console, record.standard, record.score)


def show_places(console: Console, run: RunDirectory) -> None:
    """Prints where to look at a finished run next."""
    for what, where in (
        ("what came out", run.report_file),
        ("score it again", f"tsbench evaluate {run.path}"),
    ):
        console.print(f" {what:<17} {where}", markup=False, highlight=False, soft_wrap=True)


def show_rank(console: Console, standard: bool, score: Score) -> None:
    """Says why a score cannot be ranked with others, where it cannot."""
    reasons = [] if standard else ["the task's constants were changed"]
    if not score.origin.protocol.ranked:
        reasons.append(f"protocol {score.protocol} asks too little")
    if reasons:
        console.print(f" not to be ranked: {' and '.join(reasons)}", highlight=False)


def run_title(record: Record) -> str:
    return f"{record.task}, {record.method}, seed {record.seed}, budget {record.budget}"


def summary(score: Score) -> list[tuple[str, str]]:
    """Labels and values of a score in short, in words that need no explanation."""
    perturbed = score.perturbed
    solved, spoiled = counts(perturbed)
    return [
        ("of the largest possible reward", f"{score.normalized_reward:.1%}"),
        ("of the best motion at the planner's speed", f"{score.optimality:.1%}"),
        ("solved from other starts", f"{solved} of {perturbed.episodes}"),
        ("falls and collisions there", f"{spoiled} of {perturbed.episodes}"),
        *pushes(score),
    ]


def pushes(score: Score) -> list[tuple[str, str]]:
    """Labels and values of its robustness in short."""
    robustness = score.robustness
    bound = "over " if robustness.impulse_50_is_lower_bound else ""
    return [
        (f"pushes of {claim_force(score):.3g} N survived", f"{robustness.survival_100N:.0%}"),
        ("impulse that half survive", f"{bound}{number(robustness.impulse_50)} N s"),
    ]


def claim_force(score: Score) -> float:
    """Newtons of the pushes of `survival_100N` on this task's body."""
    return score.origin.protocol.claim * score.robustness.mass_scale


def counts(summary: Summary) -> tuple[int, int]:
    """Episodes solved, and spoiled on the way."""
    return round(summary.success * summary.episodes), round(summary.violations * summary.episodes)
