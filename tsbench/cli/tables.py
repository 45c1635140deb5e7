"""Results as the user sees them."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tsbench.core.words import duration, number
from tsbench.evaluation.score import Score
from tsbench.evaluation.words import claim_force
from tsbench.runs.directory import Record, RunDirectory


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
    table = score_table(record.title, record.score)
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
