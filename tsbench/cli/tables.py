"""The tables and lines that show results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tsbench import tasks
from tsbench.cli.rows import Section, show_rows, show_sections
from tsbench.core.task import Task
from tsbench.core.words import command, duration, number, short
from tsbench.evaluation.flips import Flips
from tsbench.evaluation.score import Score
from tsbench.evaluation.statistics import PROVISIONAL_SEEDS, RANKED_SEEDS, iqm
from tsbench.evaluation.words import (
    FIGURES,
    counts,
    episode_rows,
    push_rows,
    reference_rows,
    unranked,
    verdict,
)
from tsbench.leaderboard.submission import kept_manifests
from tsbench.runs.directory import Record, RunDirectory

if TYPE_CHECKING:
    from tsbench.runs.results import Results
    from tsbench.viewer.comparison import Pair
    from tsbench.viewer.paper import scores

HEADLINES = ("solved_reward", "normalized_reward", "against_plan")


def show_score(console: Console, title: str, score: Score, task: Task[Any], *more: Section) -> None:
    """Prints a score: perturbed starts, the task's own start, changed physics and pushes; then
    references to compare it with, and what the figures mean.

    Args:
        console: the terminal.
        title: above the table.
        score: of a policy.
        task: that the score is of.
        more: further sections.
    """
    perturbed = score.perturbed
    headers = (f"protocol {score.protocol}", f"{perturbed.episodes} perturbed starts", "own start")
    changes = [
        (name, f"{counts(change)[0]} of {change.episodes}", number(change.normalized_reward))
        for name, change in score.changes.items()
    ]
    sections = [
        Section(headers, list(episode_rows(score, task)), verdict(perturbed)),
        Section(("changed physics", "solved", "normalized_reward"), changes),
        Section(("pushes", "survived", "task solved"), list(push_rows(score))),
    ]
    if beside := [*reference_rows(score), *(kept_rows(task) if tasks.standard(task) else ())]:
        headers = ("for comparison, by protocol v1", "solved_reward", "success")
        sections.append(Section(headers, beside))
    show_sections(console, [*sections, *more], title=title)
    for name in HEADLINES:
        console.print(f"{name}: {FIGURES[name]}", style="italic", highlight=False)


def kept_rows(task: Task[Any]) -> Iterator[tuple[str, str, str]]:
    """Rows of a kept entry's name, its `solved_reward` (the interquartile mean over its trainings,
    as on the board) and its mean `success`, of the entries for a task."""
    for name, manifest in kept_manifests().items():
        if (manifest.task, manifest.task_version) == (task.name, task.version):
            claims = [training.claimed for training in manifest.trainings]
            label = f"kept {name}" + (f" ({len(claims)} seeds)" if len(claims) > 1 else "")
            reward = iqm([np.array([one.solved_reward for one in claims])])
            success = sum(one.success for one in claims) / len(claims)
            yield label, number(reward), number(success)


def show_flips(console: Console, physics: str, found: Sequence[Flips]) -> None:
    """Prints the numbers of verdicts that change in other physics."""
    rows = [(one.verdict, f"{one.flipped} of {one.verdicts}", f"{one.share:.1%}") for one in found]
    show_rows(console, (f"verdicts that change in physics {physics}", "flipped", "share"), rows)


def show_run(console: Console, record: Record, task: Task[Any]) -> None:
    """Prints the score of a finished run and the cost of each stage."""
    stages = [(one.name, f"{one.steps:,}", duration(one.seconds)) for one in record.stages]
    cost = Section(("stage", "steps", "time"), stages)
    show_score(console, record.title, record.score, task, cost)
    show_rank(console, record.standard, record.score)


def show_scores(console: Console, lines: Sequence[scores.Line]) -> None:
    """Prints the scores of many runs: a table for each task, a column for each method."""
    from tsbench.viewer.paper import scores  # draws, and so loads slowly

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


def show_runs(
    console: Console, runs: Mapping[str, Results], names: Mapping[tuple[str, ...], str]
) -> None:
    """Prints a row for each run: its figures and what it used.

    Args:
        console: the terminal.
        runs: what was found under each word of the command line.
        names: of each run's group, by the words of the run.
    """
    rows: dict[str, list[Sequence[str]]] = {}
    for word, found in runs.items():
        for row in found.rows.values():
            label = word
            if len(found.rows) > 1:
                folder = f"{word}: " if len(runs) > 1 else ""
                label = f"{folder}{names[row.words]}, seed {row.seed}"
            seconds = sum(stage.seconds for stage in row.stages)
            solved, survived = "no policy", "-"
            if row.score is not None:
                summary = row.score.perturbed
                solved = f"{counts(summary)[0]} of {summary.episodes}"
                survived = f"{row.score.robustness.survival_100N:.1%}"
            reward = number(row.solved_reward)
            used = (short(row.steps), duration(seconds))
            rows.setdefault(row.task, []).append((label, solved, reward, survived, *used))
    headers = ("run", "solved", "solved_reward", "100 N", "steps", "time")
    for task, members in rows.items():
        show_rows(console, headers, members, title=task)


def show_pairs(console: Console, pairs: Sequence[Pair], *, incomparable: bool) -> None:
    """Prints the differences of `solved_reward` between groups of runs, and how sure they are. One
    or two seeds say nothing of the methods, so their mean is not shown.

    Args:
        console: the terminal.
        pairs: of groups of one task.
        incomparable: whether others were left out.
    """
    rows: dict[str, list[Sequence[str]]] = {}
    for pair in pairs:
        mean = interval = "-"
        if (found := pair.difference) is not None and pair.seeds >= PROVISIONAL_SEEDS:
            mean = f"{found.mean:+.4f}"
            if found.interval is not None:
                interval = f"{found.interval[0]:+.4f} to {found.interval[1]:+.4f}"
        p_value = "-" if pair.p_value is None else f"{pair.p_value:.3g}"
        cells = (f"{pair.first} less {pair.second}", str(pair.seeds), mean, interval, p_value)
        rows.setdefault(pair.task, []).append(cells)
    headers = ("solved_reward of", "seeds", "mean", "95 % interval", "p (Holm)")
    for task, members in rows.items():
        show_rows(console, headers, members, title=f"{task}, seed by seed")
    if any(pair.difference is None or pair.difference.interval is None for pair in pairs):
        line = f"Over the seeds that both have; a mean needs {PROVISIONAL_SEEDS} of them, "
        line += f"an interval {RANKED_SEEDS}."
        console.print(line, highlight=False)
    if incomparable:
        line = "Scores by other protocols, versions or constants of a task are not compared."
        console.print(line, highlight=False)


def show_places(console: Console, run: RunDirectory) -> None:
    """Prints the report's path and the command that makes the score again."""
    for label, place in (
        ("report", run.report_file),
        ("score again", command("evaluate", run.path)),
    ):
        console.print(f" {label:<12} {place}", markup=False, highlight=False, soft_wrap=True)


def show_rank(console: Console, standard: bool, score: Score) -> None:
    """Prints why a score is not ranked, if so."""
    if reasons := unranked(score, standard=standard):
        console.print(f" not ranked: {reasons}", highlight=False)
