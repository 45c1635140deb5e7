"""Results as the user sees them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Table

from tsbench.evaluation.flips import Flips
from tsbench.evaluation.references import beside
from tsbench.evaluation.score import Score, Summary
from tsbench.record import Record, RunDirectory
from tsbench.task import Task

HEADLINES = ("solved_reward", "normalized_reward", "against_plan")
FIGURES = {  # what each says, in words
    "solved_reward": "the reward as a share of the largest possible, 0 where not solved",
    "normalized_reward": "the same, solved or not",
    "against_plan": "the reward over that of the best plan; a policy may pass 1",
    "success": "share of the episodes that were solved",
}


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


def score_table(title: str, score: Score, task: Task[Any]) -> Table:
    """A score: perturbed starts beside the task's own, changed physics, and pushes."""
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
    table.add_row("pushes", "survived", "and solved", style="bold")
    for label, survived, recovered in _push_rows(score):
        table.add_row(label, survived, recovered)
    return table


def verdict(summary: Summary) -> str:
    """In capitals: how many episodes were solved."""
    return f"SOLVED {counts(summary)[0]} of {summary.episodes}"


def episode_rows(score: Score, task: Task[Any]) -> Iterator[tuple[str, str, str]]:
    """Labels, and values from perturbed starts and from the task's own."""
    own, other = score.nominal, score.perturbed
    yield "solved_reward", number(score.solved_reward), number(own.solved_reward)
    yield "normalized_reward", number(score.normalized_reward), number(own.normalized_reward)
    yield "against_plan", number(score.against_plan), ""
    yield "success", number(other.success), number(own.success)
    for name, value in other.measures.items():
        yield name, number(value), number(own.measures[name])
    yield f"spoiled by {task.mishap}", number(other.violations), number(own.violations)
    yield "steps", number(other.steps), number(own.steps)
    yield "distance at the end, m", number(other.goal_distance), number(own.goal_distance)


def _push_rows(score: Score) -> Iterator[tuple[str, str, str]]:
    """Labels, and values of survival and of recovery."""
    robustness = score.robustness
    yield (
        f"of {claim_force(score):.3g} N (survival_100N, recovery_100N)",
        f"{robustness.survival_100N:.1%}",
        f"{robustness.recovery_100N:.1%}",
    )
    for name, row in beside(score).items():
        share, solved = row["survival_100N"], row["recovery_100N"]
        yield f"  by the policy {name}", f"{share:.1%}", f"{solved:.1%}"
    yield "withstood by half (impulse_50)", *_impulses(score)


def _impulses(score: Score) -> tuple[str, str]:
    """The impulses that half of the pushes survive and recover from, in words."""
    robustness = score.robustness
    return (
        _impulse(robustness.survival_impulse_50, robustness.survival_impulse_50_is_lower_bound),
        _impulse(robustness.recovery_impulse_50, robustness.recovery_impulse_50_is_lower_bound),
    )


def _impulse(value: float, is_lower_bound: bool) -> str:
    return f"{'over ' if is_lower_bound else ''}{number(value)} N s"


def flips_table(physics: str, found: Sequence[Flips]) -> Table:
    """How many verdicts are others in another physics."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(f"verdicts that flip in physics {physics}")
    table.add_column("flipped", justify="right")
    table.add_column("share", justify="right")
    for one in found:
        table.add_row(one.verdict, f"{one.flipped} of {one.verdicts}", f"{one.share:.1%}")
    return table


def show_run(console: Console, record: Record, task: Task[Any]) -> None:
    """Prints what ends a run: its score and what each stage cost."""
    table = score_table(run_title(record), record.score, task)
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


def summary(score: Score, task: Task[Any]) -> list[tuple[str, str]]:
    """Labels and values of a score in short, in words that need no explanation."""
    perturbed = score.perturbed
    solved, spoiled = counts(perturbed)
    return [
        ("solved from other starts", f"{solved} of {perturbed.episodes}"),
        *((name, number(value)) for name, value in perturbed.measures.items()),
        (f"spoiled by {task.mishap}", f"{spoiled} of {perturbed.episodes}"),
        ("share of the largest possible reward", f"{score.normalized_reward:.1%}"),
        ("the same, only where it was solved", f"{score.solved_reward:.1%}"),
        ("reward over that of the best plan", number(score.against_plan)),
        *pushes(score),
    ]


def pushes(score: Score) -> list[tuple[str, str]]:
    """Labels and values of its robustness in short."""
    robustness = score.robustness
    survival, recovery = _impulses(score)
    force = f"{claim_force(score):.3g} N"
    return [
        (f"pushes of {force} survived", f"{robustness.survival_100N:.0%}"),
        *(
            (f"  the same by the policy {name}", f"{row['survival_100N']:.0%}")
            for name, row in beside(score).items()
        ),
        (f"pushes of {force} survived and solved", f"{robustness.recovery_100N:.0%}"),
        ("impulse that half of the pushes survive", survival),
        ("impulse at which half survive and solve", recovery),
    ]


def claim_force(score: Score) -> float:
    """Newtons of the pushes of `survival_100N` on this task's body."""
    return score.origin.protocol.claim * score.robustness.mass_scale


def counts(summary: Summary) -> tuple[int, int]:
    """Episodes solved, and spoiled on the way."""
    return round(summary.success * summary.episodes), round(summary.violations * summary.episodes)
