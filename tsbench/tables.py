"""Results as the user sees them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from tsbench.record import REPORT


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


def score_table(title: str, score: Mapping[str, Any]) -> Table:
    """A score: the task's own start beside the perturbed ones, changed physics, and pushes.

    Args:
        title: what was scored.
        score: `Score.as_dict()`.
    """
    nominal, perturbed = score["nominal"], score["perturbed"]
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(f"protocol {score['protocol']}")
    table.add_column("task's own start", justify="right")
    table.add_column(f"{perturbed['episodes']} perturbed starts", justify="right")
    table.add_row(
        "normalized_reward",
        number(score["normalized_reward"]),
        number(perturbed["normalized_reward"]),
    )
    table.add_row("optimality", number(score["optimality"]))
    for name in nominal:
        if name not in ("episodes", "normalized_reward"):
            table.add_row(name, number(nominal[name]), number(perturbed[name]))
    table.add_section()
    table.add_row("changed physics", "normalized_reward", "success", style="bold")
    for name, change in score["changes"].items():
        table.add_row(name, number(change["normalized_reward"]), number(change["success"]))
    robustness = score["robustness"]
    low, high = robustness["survival_100N_interval"]
    bound = "at least " if robustness["impulse_50_is_lower_bound"] else ""
    table.add_section()
    table.add_row("pushes", style="bold")
    table.add_row(
        "survival_100N", number(robustness["survival_100N"]), f"95 %: {low:.3f} to {high:.3f}"
    )
    table.add_row("impulse_50", f"{bound}{number(robustness['impulse_50'])}", "N s")
    return table


def show_run(console: Console, record: Mapping[str, Any], directory: Path) -> None:
    """Prints what ends a run: its score, what each stage cost, and where to look next.

    Args:
        console: to print on.
        record: the content of `score.json`.
        directory: of the run.
    """
    table = score_table(run_title(record), record["score"])
    table.add_section()
    table.add_row("stage", "steps", "time", style="bold")
    for stage in record["stages"]:
        table.add_row(stage["name"], f"{stage['steps']:,}", duration(stage["seconds"]))
    console.print(table)
    for what, where in (
        ("what came out", directory / REPORT),
        ("score it again", f"tsbench evaluate {directory}"),
    ):
        console.print(f" {what:<17} {where}", markup=False, highlight=False, soft_wrap=True)


def run_title(record: Mapping[str, Any]) -> str:
    return "{task}, {method}, seed {seed}, budget {budget}".format(**record)


def summary(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Labels and values of a run's score in short, in words that need no explanation."""
    score = record["score"]
    perturbed = score["perturbed"]
    episodes = perturbed["episodes"]
    solved, spoiled = (round(perturbed[name] * episodes) for name in ("success", "violations"))
    rows = [
        ("of the largest possible reward", f"{score['normalized_reward']:.1%}"),
        ("of the best known reward", f"{score['optimality']:.1%}"),
        ("solved from other starts", f"{solved} of {episodes}"),
        ("falls and collisions there", f"{spoiled} of {episodes}"),
    ]
    if robustness := score.get("robustness"):
        rows.append(("pushes of 100 N survived", f"{robustness['survival_100N']:.0%}"))
        bound = "over " if robustness["impulse_50_is_lower_bound"] else ""
        impulse = f"{bound}{number(robustness['impulse_50'])} N s"
        rows.append(("impulse that half survive", impulse))
    return rows
