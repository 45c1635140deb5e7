"""The report of a run: one page that says what was planned, what was executed, and how good it is.

It is made from the run's directory alone, and needs nothing else to be opened: the 3-D view and all
charts are inside.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tsbench.core.errors import TsbenchError
from tsbench.core.files import write_new
from tsbench.core.task import Task, plannable
from tsbench.core.words import duration, number
from tsbench.evaluation.score import Score
from tsbench.evaluation.words import FIGURES, claim_force, counts, episode_rows, pushes, verdict
from tsbench.runs.directory import RunDirectory
from tsbench.viewer import charts, curves, page
from tsbench.viewer.compose import foot_bands
from tsbench.viewer.recording import Recording, record_episode
from tsbench.viewer.show import EXECUTED_COLOUR, PLAN_COLOUR
from tsbench.viewer.subject import Subject, executed_in_words, planned_in_words, run_subject

Table = Sequence[Sequence[str]]  # rows of cells, the first one the header
LEADING = 2  # measures that the verdict tells


def write_pages(run: RunDirectory) -> None:
    """Makes those of a finished run's `learning_curves.png`, `view.html` and `report.html` that
    are missing.

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
    """
    Raises:
        TsbenchError: there is no finished run.
    """
    if not run.path.is_dir():
        raise TsbenchError(f"no run directory {run.path}")
    if not run.finished:
        reason = "only a finished run has a report"
        raise TsbenchError(f"{run.path} has no {run.score_file.name}: {reason}")


def _pages(run: RunDirectory) -> tuple[str, str]:
    """The page with the 3-D view, and the report that has it inside."""
    subject = run_subject(run)
    assert subject.policy is not None
    assert subject.score is not None
    learning = charts.learning(run.metrics_file) if run.has_metrics else None
    plan, recording = subject.plan(), record_episode(subject.task, subject.policy)
    view = page.render(subject.show_of(recording, plan))
    report = page.fill(
        "report.html",
        {
            "title": html.escape(subject.title),
            "plan": page.css(PLAN_COLOUR),
            "executed": page.css(EXECUTED_COLOUR),
            "answers": "".join(_answers(subject, recording, plan)),
            "view": html.escape(view),
            "sections": "".join(_sections(subject, run, recording, plan, learning)),
        },
    )
    return view, report


def _answers(subject: Subject, recording: Recording, plan: Recording | None) -> Iterator[str]:
    assert subject.score is not None
    score = subject.score.score
    planned = "Nothing: this method learns to act directly, without a plan."
    if plan is not None:
        planned = planned_in_words(plan) + " No physics binds it."
    for kind, title, text in (
        ("plan", "What was planned", planned),
        ("executed", "What was executed", executed_in_words(recording)),
        ("score", "How good it is", worth_in_words(score, subject.task)),
    ):
        leads = kind == "score"
        solved = f'<p class="verdict">{verdict(score.perturbed)}</p>' if leads else ""
        yield (
            f'<section class="{kind}"><h2>{title}</h2>{solved}<p>{html.escape(text)}</p></section>'
        )


def worth_in_words(score: Score, task: Task[Any]) -> str:
    """What the score says, what matters most first."""
    perturbed, robustness = score.perturbed, score.robustness
    solved, spoiled = counts(perturbed)
    text = (
        f"From {perturbed.episodes} starts a little different from the task's own the policy "
        f"solves the task {solved} times; {spoiled} episodes are spoiled by {task.mishap}."
    )
    for name, value in [*perturbed.measures.items()][:LEADING]:
        note = task.measure_notes.get(name)
        if value is not None:
            text += f" {name[0].upper()}{name[1:]}: {number(value)}"
            text += f" ({note})." if note else "."
    text += (
        f" It earns {score.normalized_reward:.1%} of the largest possible reward, "
        f"{number(score.against_plan)} times what the best plan would. Of all pushes of "
        f"{claim_force(score):.3g} N for {robustness.push_duration_s:g} s it survives "
        f"{robustness.survival_100N:.0%}, and solves the task after {robustness.recovery_100N:.0%}."
    )
    return text


def _sections(
    subject: Subject,
    run: RunDirectory,
    recording: Recording,
    plan: Recording | None,
    learning: str | None,
) -> Iterator[str]:
    assert subject.score is not None
    duration = max(r.duration for r in (recording, plan) if r is not None)
    if recording.task.drawing().feet:
        bands = foot_bands(plan or recording, recording)
        yield _section(
            "Foot contacts",
            "Blue: when each foot was to stand on the ground. Orange: when it pressed on it, in "
            f"full physics. {agreement_in_words(recording)}",
            charts.contacts(bands, duration),
        )
    yield _section(
        "Reward of each step",
        "What the task pays, and the terms that it is made of. Blue: what the plan would earn if "
        "it were followed exactly. Orange: what was executed.",
        charts.rewards(recording, plan),
    )
    if plan is not None:
        yield _section(
            "Joints" if recording.task.drawing().feet else "Position and angle",
            "Planned in blue, executed in orange; the typical error is the root of the mean "
            "square, at equal times.",
            charts.joints(recording, plan),
        )
    yield _section(
        "Robustness",
        f"Pushes on its body, each tried once. Survived: the episode went on without "
        f"{subject.task.mishap} and without straying. Recovered: the task was solved as well.",
        charts.robustness(subject.score.score.robustness.surface, subject.task.timestep),
    )
    if learning:
        yield _section(
            "How it learned",
            "Return of the episodes during training, of each stage by the reward of that stage.",
            learning,
        )
    yield _section(
        "Numbers",
        f"Everything in this page comes from {run.path.name}/; the same score again: tsbench "
        "evaluate. How the run was made is in config.yaml and versions.json.",
        f'<div class="tables">{"".join(_tables(subject, run, plan))}</div>',
    )


def agreement_in_words(recording: Recording) -> str:
    """How often the feet did what the schedule asks for where each step ends."""
    if recording.scheduled is None:
        return ""
    share = np.mean(recording.scheduled[1:] == recording.support.contacts[1:])
    return f"They did as scheduled {share:.0%} of the time."


def _tables(subject: Subject, run: RunDirectory, planned: Recording | None) -> Iterator[str]:
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
    plan = run.plan(subject.task)
    if plan is not None and subject.reference is not None:
        audit = plannable(subject.task).audit(plan, subject.reference)
        items = [
            (item.what, f"{item.value:.3g} {item.unit}", f"{item.limit:.3g} {item.unit}",
             "ok" if item.passed else "too much")
            for item in audit.items
        ]  # fmt: skip
        yield _table([("can physics follow the plan?", "measured", "allowed", ""), *items])


def _score_rows(subject: Subject, plan: Recording | None) -> Table:
    """The figures of all episodes, beside what the reference motion would have."""
    assert subject.score is not None
    score, notes = subject.score.score, {**FIGURES, **subject.task.measure_notes}
    planned = {} if plan is None else plan.measures
    beside = ("reference motion",) if planned else ()
    rows = [("score", f"{score.perturbed.episodes} other starts", "task's own start", *beside, "")]
    for name, value, own in episode_rows(score, subject.task):
        reference = (number(planned[name]) if name in planned else "",) if planned else ()
        rows.append((name, value, own, *reference, notes.get(name, "")))
    return rows


def _table(rows: Table) -> str:
    def line(cells: Sequence[str], kind: str) -> str:
        bad = ' class="bad"' if cells[-1] == "too much" else ""
        inside = "".join(f"<{kind}{bad}>{html.escape(cell)}</{kind}>" for cell in cells)
        return f"<tr>{inside}</tr>"

    head, *body = rows
    return f"<table>{line(head, 'th')}{''.join(line(cells, 'td') for cells in body)}</table>"


def _section(title: str, text: str, content: str) -> str:
    return f"<section><h2>{title}</h2><p>{html.escape(text)}</p>{content}</section>"
