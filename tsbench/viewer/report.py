"""The report of a run: one page with the plan, the executed motion and the score.

The report is made from the run's directory alone. The page contains the 3-D view and all charts,
and needs no other file.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tsbench.core.errors import TsbenchError
from tsbench.core.files import write_new
from tsbench.core.motion import Audit, AuditItem
from tsbench.core.task import Task, plannable
from tsbench.core.words import duration, number
from tsbench.evaluation.words import (
    FIGURES,
    claim_force,
    counts,
    episode_rows,
    pushes,
    unranked,
    verdict,
)
from tsbench.runs.directory import Record, RunDirectory
from tsbench.viewer import charts, curves, page
from tsbench.viewer.compose import foot_bands
from tsbench.viewer.pushes import headings
from tsbench.viewer.recording import Recording, record_episode
from tsbench.viewer.show import EXECUTED_COLOUR, PLAN_COLOUR
from tsbench.viewer.subject import Subject, executed_in_words, planned_in_words, run_subject

Table = Sequence[Sequence[str]]  # rows of cells, the first one the header
NOTE = "\n"  # in a cell, before the note that stands below the text
LEADING = 2  # number of measures that the sentences on the score give


def write_pages(run: RunDirectory) -> None:
    """Makes the missing ones of a finished run's `learning_curves.png`, `view.html` and
    `report.html`.

    Raises:
        TsbenchError: the run is not finished, a file in it is missing or damaged, or a page cannot
            be written.
    """
    check_finished(run)
    if run.metrics_file.exists() and not run.curves_file.exists():
        curves.draw(run.metrics_file, run.curves_file)
    missing = [path for path in (run.view_file, run.report_file) if not path.exists()]
    if missing:
        view, report = _pages(run)
        for path in missing:
            write_new(path, (view if path == run.view_file else report).encode())


def render(run: RunDirectory) -> str:
    """The report of a finished run.

    Raises:
        TsbenchError: the run is not finished, or a file in it is missing or damaged.
    """
    check_finished(run)
    return _pages(run)[1]


def check_finished(run: RunDirectory) -> None:
    """Checks that a run has ended with a score.

    Raises:
        TsbenchError: the directory does not exist, or the run in it is not finished.
    """
    if not run.path.is_dir():
        raise TsbenchError(f"no run directory {run.path}")
    if not run.finished:
        reason = "only a finished run has a report"
        raise TsbenchError(run.unfinished or f"{run.path} has no {run.score_file.name}: {reason}")


def _pages(run: RunDirectory) -> tuple[str, str]:
    """The page with the 3-D view, and the report, which contains that page."""
    subject = run_subject(run)
    assert subject.policy is not None
    assert subject.score is not None
    learning = charts.learning(run.metrics_file) if run.has_metrics else None
    plan, recording = subject.plan(), record_episode(subject.task, subject.policy)
    audit = _audit(subject, run)
    view = page.render(subject.show_of(recording, plan))
    report = page.fill(
        "report.html",
        {
            "title": html.escape(subject.title),
            "plan": page.css(PLAN_COLOUR),
            "executed": page.css(EXECUTED_COLOUR),
            "answers": "".join(_answers(subject, run, recording, plan, audit)),
            "view": html.escape(view),
            "sections": "".join(_sections(subject, run, recording, plan, learning, audit)),
        },
    )
    return view, report


def _audit(subject: Subject, run: RunDirectory) -> Audit | None:
    """The audit of the run's plan; None without a plan."""
    plan = run.plan(subject.task)
    if plan is None or subject.reference is None:
        return None
    return plannable(subject.task).audit(plan, subject.reference)


def _answers(
    subject: Subject,
    run: RunDirectory,
    recording: Recording,
    plan: Recording | None,
    audit: Audit | None,
) -> Iterator[str]:
    assert subject.score is not None
    score = subject.score.score
    planned = "Nothing: this method trains a policy without a plan."
    if plan is not None:
        planned = planned_in_words(plan) + " A plan ignores physics."
    if audit is not None and not audit.passed:
        planned = f"{failures_in_words(audit)} {planned}"
    worth = worth_in_words(subject.score, subject.task)
    if more := run.overspent(subject.score):
        worth = f"Over the budget, so no leaderboard takes this run: {more}. {worth}"
    for kind, title, text in (
        ("plan", "What was planned", planned),
        ("executed", "What was executed", executed_in_words(recording)),
        ("score", "How good it is", worth),
    ):
        leads = kind == "score"
        solved = f'<p class="verdict">{verdict(score.perturbed)}</p>' if leads else ""
        yield (
            f'<section class="{kind}"><h2>{title}</h2>{solved}<p>{html.escape(text)}</p></section>'
        )


def failures_in_words(audit: Audit) -> str:
    """A sentence on what a plan fails its audit by."""
    found = [
        f"{item.what} {measured}, allowed {allowed}"
        for item in audit.failures
        for measured, allowed in [_amounts(item)]
    ]
    return f"The plan fails its audit: {'; '.join(found)}."


def _amounts(item: AuditItem) -> tuple[str, str]:
    """What was measured and what is allowed, with their unit."""
    return f"{item.value:.3g} {item.unit}".rstrip(), f"{item.limit:.3g} {item.unit}".rstrip()


def worth_in_words(record: Record, task: Task[Any]) -> str:
    """The score in sentences, the main figures first."""
    score = record.score
    perturbed, robustness = score.perturbed, score.robustness
    solved, spoiled = counts(perturbed)
    reasons = unranked(score, standard=record.standard)
    text = f"Not ranked: {reasons}. " if reasons else ""
    text += (
        f"The policy solves the task from {solved} of {perturbed.episodes} perturbed starts. "
        f"Spoiled by {task.mishap}: {spoiled} of {perturbed.episodes}."
    )
    for name, value in [*perturbed.measures.items()][:LEADING]:
        note = task.measure_notes.get(name)
        if value is not None:
            text += f" {name[0].upper()}{name[1:]}: {number(value)}"
            text += f" ({note})." if note else "."
    text += (
        f" The policy earns {score.normalized_reward:.1%} of the largest possible reward, which is "
        f"{number(score.against_plan)} times the reward of the best plan. Of all "
        f"pushes of {claim_force(score):.3g} N for {robustness.push_duration_s:g} s it survives "
    )
    if not robustness.survival_100N:
        return f"{text}none."
    recovered = f"{robustness.recovery_100N:.1%}" if robustness.recovery_100N else "none"
    return f"{text}{robustness.survival_100N:.1%} and solves the task after {recovered}."


def _sections(
    subject: Subject,
    run: RunDirectory,
    recording: Recording,
    plan: Recording | None,
    learning: str | None,
    audit: Audit | None,
) -> Iterator[str]:
    assert subject.score is not None
    duration = max(r.duration for r in (recording, plan) if r is not None)
    robot = subject.task.drawing().robot
    first, _, second, _ = headings(subject.task).values()
    if recording.task.drawing().feet:
        bands = foot_bands(plan or recording, recording)
        yield _section(
            "Foot contacts",
            "Blue: the schedule, by which each foot stands on the ground. Orange: the contacts of "
            f"the foot in full physics. {agreement_in_words(recording)}",
            charts.contacts(bands, duration),
        )
    planned = f"Blue: the reward of the plan, as if the {robot} followed it exactly. "
    yield _section(
        "Reward of each step",
        f"The reward of the task and its terms. {planned if plan else ''}Orange: the reward of the "
        "executed motion.",
        charts.rewards(recording, plan),
    )
    if plan is not None:
        yield _section(
            "Joints" if recording.task.drawing().feet else "Position and angle",
            "Blue: the plan. Orange: the executed motion. The typical error is the root mean "
            "square of their difference at equal times.",
            charts.joints(recording, plan),
        )
    yield _section(
        "Robustness",
        f"Each push of the protocol acts on the {robot} once. Survived: the episode went on "
        f"without {subject.task.mishap} and without straying. Recovered: the push was survived and "
        "the task solved.",
        charts.robustness(
            subject.score.score.robustness.surface,
            subject.task.timestep,
            f"0 {first}, 90 {second}",
        ),
    )
    if run.begun:
        kept = "" if learning else " The directory holds no metrics, so there are no curves."
        yield _section(
            "How it was made",
            f"By this command, seed {subject.score.seed} of the training.{kept}",
            f"<code>{html.escape(run.command)}</code>",
        )
    if learning:
        yield _section(
            "How it learned",
            "The return of training episodes. Each stage has its own reward.",
            learning,
        )
    yield _section(
        "Numbers",
        f"Everything on this page comes from {run.path.name}/. The command tsbench evaluate makes "
        "the score again. config.yaml and versions.json tell how the run was made.",
        f'<div class="tables">{"".join(_tables(subject, plan, audit))}</div>',
    )


def agreement_in_words(recording: Recording) -> str:
    """A sentence on how often contact and schedule agree at the ends of control steps."""
    if recording.scheduled is None:
        return ""
    share = np.mean(recording.scheduled[1:] == recording.support.contacts[1:])
    return f"Contacts and schedule agree {share:.0%} of the time."


def _tables(subject: Subject, planned: Recording | None, audit: Audit | None) -> Iterator[str]:
    assert subject.score is not None
    yield _table(_score_rows(subject, planned))
    changes = [
        (name, f"{counts(change)[0]} of {change.episodes}",
         number(change.normalized_reward))
        for name, change in subject.score.score.changes.items()
    ]  # fmt: skip
    yield _table([("changed physics", "solved", "normalized_reward"), *changes])
    yield _table([("pushes", ""), *pushes(subject.score.score)])
    costs = [
        (stage.name, f"{stage.steps:,}", f"{stage.physics_substeps:,}",
         duration(stage.seconds))
        for stage in subject.score.stages
    ]  # fmt: skip
    yield _table([("stage", "environment steps", "physics steps", "time"), *costs])
    if audit is not None:
        items = [
            (item.what, *_amounts(item), "ok" if item.passed else "too much")
            for item in audit.items
        ]
        yield _table([("can physics follow the plan?", "measured", "allowed", ""), *items])


def _score_rows(subject: Subject, plan: Recording | None) -> Table:
    """The figures of all episodes, beside the figures of the reference motion."""
    assert subject.score is not None
    score, notes = subject.score.score, {**FIGURES, **subject.task.measure_notes}
    planned = {} if plan is None else plan.measures
    beside = ("reference motion",) if planned else ()
    rows = [("score", f"{score.perturbed.episodes} perturbed starts", "task's own start", *beside)]
    for name, value, own in episode_rows(score, subject.task):
        reference = (number(planned[name]) if name in planned else "",) if planned else ()
        label = f"{name}{NOTE}{notes[name]}" if name in notes else name
        rows.append((label, value, own, *reference))
    return rows


def _table(rows: Table) -> str:
    def line(cells: Sequence[str], kind: str) -> str:
        bad = ' class="bad"' if cells[-1] == "too much" else ""
        inside = "".join(f"<{kind}{bad}>{with_note(cell)}</{kind}>" for cell in cells)
        return f"<tr>{inside}</tr>"

    def with_note(cell: str) -> str:
        text, found, note = cell.partition(NOTE)
        return html.escape(text) + (f"<small>{html.escape(note)}</small>" if found else "")

    head, *body = rows
    return f"<table>{line(head, 'th')}{''.join(line(cells, 'td') for cells in body)}</table>"


def _section(title: str, text: str, content: str) -> str:
    return f"<section><h2>{title}</h2><p>{html.escape(text)}</p>{content}</section>"
