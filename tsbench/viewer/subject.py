"""The subjects of the viewer: a run, a plan, a task, or two runs side by side."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.motion import Plan, ReferenceMotion, Roadmap, read_motion
from tsbench.core.policy import Policy
from tsbench.core.task import Task, plannable
from tsbench.core.words import number
from tsbench.evaluation.words import summary
from tsbench.runs.directory import Record, RunDirectory
from tsbench.sim.kinematic import naive_plan
from tsbench.sim.push import Push
from tsbench.viewer.compose import compose, compose_pair, compose_plan
from tsbench.viewer.pushes import parse_push, push_in_words
from tsbench.viewer.recording import Recording, record_episode, record_motion
from tsbench.viewer.show import Figures, Show


@dataclass(frozen=True)
class Subject:
    """A task, with a policy or a plan for it.

    A subject has a policy, a reference motion, or both.

    Attributes:
        title: the title of its page.
        task: the task.
        policy: the policy, or None.
        reference: the plan as full poses, or None.
        score: the content of `score.json`, or None.
        roadmap: the roadmap that the plan was made with, or None.
    """

    title: str
    task: Task[Any]
    policy: Policy | None
    reference: ReferenceMotion | None
    score: Record | None = None
    roadmap: Roadmap | None = None

    def plan(self) -> Recording | None:
        """The reference motion as a recording; None without one."""
        return None if self.reference is None else record_motion(self.task, self.reference)

    def show(self, push: str | None = None) -> Show:
        """Plays the policy, or shows the plan of a subject without a policy.

        Args:
            push: a push on the robot, as `parse_push` reads it.

        Raises:
            TsbenchError: the push acts on a plan, comes after the end of the episode or leaves the
                task's plane, or the policy is for another task.
        """
        force = None if push is None else parse_push(push, self.task)
        plan = self.plan()
        if self.policy is None:
            if force is not None:
                raise TsbenchError("a plan cannot be pushed, only a policy")
            assert plan is not None
            verdict = planned_in_words(plan)
            return compose_plan(plan, title=self.title, verdict=verdict, roadmap=self.roadmap)
        recording = record_episode(self.task, self.policy)
        if force is None:
            return self.show_of(recording, plan)
        pushed = record_episode(self.task, self.policy, force)
        check_pushed(force, [pushed])
        words = push_in_words(force, self.task)
        return compose(
            pushed,
            plan,
            title=f"{self.title}, pushed by {words}",
            verdict=f"A push of {words} acts on the {self.task.pushed}. "
            f"{executed_in_words(pushed)} Without the push: {recording.ending}.",
            tables=[episode_table({"pushed": pushed, "not pushed": recording})],
            roadmap=self.roadmap,
        )

    def show_of(self, recording: Recording, plan: Recording | None) -> Show:
        """The executed motion beside the plan."""
        sentences = [] if plan is None else [planned_in_words(plan)]
        score = self.score and self.score.score
        return compose(
            recording,
            plan,
            title=self.title,
            verdict=" ".join([*sentences, executed_in_words(recording)]),
            tables=[Figures(("score", ""), summary(score, self.task))] if score else [],
            roadmap=self.roadmap,
        )


def subject(word: str) -> Subject:
    """The subject that a word of the command line names: task=NAME, a run's directory, or a plan's
    file.

    Raises:
        TsbenchError: the task, directory or file does not exist, or is damaged.
    """
    if word.startswith("task="):
        return task_subject(tasks.checked(word.removeprefix("task=")))
    path = Path(word)
    if path.is_dir() or not path.exists():
        return run_subject(RunDirectory(path))
    return plan_subject(path)


def task_subject(task: Task[Any]) -> Subject:
    """A task with the plan of its hand-made planner."""
    title = f"{task.name}, planned by hand"
    planned = plannable(task)
    return Subject(title, task, None, planned.reference(naive_plan(planned)))


def run_subject(run: RunDirectory) -> Subject:
    """A run. Only its policy is required.

    Raises:
        TsbenchError: the directory does not exist, its policy is missing, or a file in it is
            damaged.
    """
    policy = run.policy()
    task = run.task(policy.info.task)
    score = run.record() if run.finished else None
    return Subject(
        title=score.title if score else task.name,
        task=task,
        policy=policy,
        reference=run.reference(task),
        score=score,
        roadmap=run.roadmap(task),
    )


def plan_subject(path: Path) -> Subject:
    """A plan or reference motion, with the constants of the run in whose directory the file lies.

    Raises:
        TsbenchError: the file is damaged, holds neither a plan nor a reference motion, or is for
            another version of its task.
    """
    motion, run = read_motion(path), RunDirectory(path.parent)
    task = plannable(run.task(motion.task))
    task.check_fit(motion)
    if isinstance(motion, Plan):
        motion = task.reference(motion)
    title = f"{task.name}, {path.name}"
    return Subject(title, task, None, motion, roadmap=run.roadmap(task))


def pair(runs: Sequence[str], push: str | None = None) -> Show:
    """Two runs of one task side by side.

    Raises:
        TsbenchError: the runs are for different tasks, one of them is damaged, or the push comes
            after the end of both episodes.
    """
    subjects = [run_subject(RunDirectory(Path(word))) for word in runs]
    force = None if push is None else parse_push(push, subjects[0].task)
    recordings = [record_episode(s.task, cast(Policy, s.policy), force) for s in subjects]
    check_pushed(force, recordings)
    first, second = (f"{a}: {name}" for a, name in zip("AB", names(subjects, runs), strict=True))
    title, verdict = f"{subjects[0].task.name}: {first}, {second}", ""
    if force is not None:
        words = push_in_words(force, subjects[0].task)
        title, verdict = f"{title}, pushed by {words}", f"Both are pushed by {words}. "
    a, b = recordings
    verdict += f"A is {subjects[0].title}: {a.ending}. B is {subjects[1].title}: {b.ending}."
    scores = [main_figures(one) for one in subjects]
    scored = force is None and any(scores)  # a score says nothing of a pushed episode
    tables = [episode_table({"A": a, "B": b}, measures=not scored)]
    if scored:
        tables.append(table_of(("score", "A", "B"), scores))
    return compose_pair(a, b, (first, second), title=title, verdict=verdict, tables=tables)


def main_figures(subject: Subject) -> dict[str, str]:
    """The main figures of a run's score by label, none without a score. The rows of policies that
    it is compared with, which are indented, are left out."""
    rows = summary(subject.score.score, subject.task) if subject.score else []
    return {label: value for label, value in rows if not label.startswith(" ")}


def names(subjects: Sequence[Subject], runs: Sequence[str]) -> list[str]:
    """What distinguishes runs: method, seed and budget, or else the parts of their paths."""
    parts = [list(Path(run).resolve().parts) for run in runs]
    if all(one.score for one in subjects):
        described = [one.title.split(", ")[1:] for one in subjects]
        if any(one != described[0] for one in described):
            parts = described
    columns = list(itertools.zip_longest(*parts, fillvalue=""))
    telling = [column for column in columns if len(set(column)) > 1] or columns[-1:]
    return [", ".join(filter(None, words)) for words in zip(*telling, strict=True)]


def episode_table(recordings: Mapping[str, Recording], *, measures: bool = True) -> Figures:
    """The figures of single episodes, by their name, with or without the task's measures."""
    columns = [
        {
            "ends": recording.ending,
            "after, s": f"{recording.duration:.2f}",
            "distance to the goal, m": f"{recording.goal_distance[-1]:.2f}",
            "reward, of the largest possible": f"{recording.outcome.normalized:.1%}",
            **{name: number(value) for name, value in recording.measures.items() if measures},
        }
        for recording in recordings.values()
    ]
    return table_of(("this episode", *recordings), columns)


def table_of(heads: tuple[str, ...], columns: Sequence[Mapping[str, str]]) -> Figures:
    """A table of columns of figures by label; a dash for a figure that a column lacks."""
    labels = dict.fromkeys(itertools.chain(*columns))
    rows = [(label, *(column.get(label, "-") for column in columns)) for label in labels]
    return Figures(heads, rows)


def check_pushed(push: Push | None, recordings: Sequence[Recording]) -> None:
    """Checks that a push comes before the end of at least one episode.

    Raises:
        TsbenchError: every episode ends before the push.
    """
    end = max(recording.duration for recording in recordings)
    if push is not None and (begins := float(np.min(push.time))) >= end:
        raise TsbenchError(f"a push at {begins:g} s comes after the episode's end at {end:.3g} s")


def planned_in_words(plan: Recording) -> str:
    """A sentence on the course of a plan."""
    distance = plan.goal_distance
    return (
        f"The plan starts {distance[0]:.2f} m from the goal and ends {distance[-1]:.2f} m from it "
        f"after {plan.duration:.1f} s."
    )


def executed_in_words(recording: Recording) -> str:
    """A sentence on the end of an executed episode."""
    end = f"{recording.goal_distance[-1]:.2f} m from the goal after {recording.duration:.1f} s"
    if recording.violated:
        return f"In full physics the policy ends {end}, spoiled by {recording.task.mishap}."
    verdict = "which solves the task" if recording.solved else "which does not solve the task"
    return f"In full physics the policy ends {end}, {verdict}."
