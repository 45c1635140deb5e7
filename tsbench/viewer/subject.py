"""What can be looked at: a run, a plan, a task, or two runs beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.motion import Plan, ReferenceMotion, Roadmap, read_motion
from tsbench.core.policy import Policy
from tsbench.core.task import Task, plannable
from tsbench.evaluation.words import summary
from tsbench.runs.directory import Record, RunDirectory
from tsbench.sim.kinematic import naive_plan
from tsbench.sim.push import Push
from tsbench.viewer.compose import compose, compose_pair, compose_plan
from tsbench.viewer.pushes import parse_push
from tsbench.viewer.recording import Recording, record_episode, record_motion
from tsbench.viewer.show import Show


@dataclass(frozen=True)
class Subject:
    """A task, with what was planned and learned for it.

    Attributes:
        title: what it is.
        task: that it is about.
        policy: what executes it, if there is one.
        reference: the plan as full poses, if there is one. One of the two there is.
        score: the content of `score.json`, if there is one.
        roadmap: that the plan was made with, if there is one.
    """

    title: str
    task: Task[Any]
    policy: Policy | None
    reference: ReferenceMotion | None
    score: Record | None = None
    roadmap: Roadmap | None = None

    def plan(self) -> Recording | None:
        return None if self.reference is None else record_motion(self.task, self.reference)

    def show(self, push: str | None = None) -> Show:
        """
        Args:
            push: on the robot, as `parse_push` reads it.

        Raises:
            TsbenchError: a push on what no policy holds up, after the end or out of the task's
                plane, or a policy for another task.
        """
        force = None if push is None else parse_push(push, self.task)
        plan = self.plan()
        if self.policy is None:
            if force is not None:
                raise TsbenchError("only what a policy executes can be pushed, not a plan")
            assert plan is not None
            verdict = planned_in_words(plan)
            return compose_plan(plan, title=self.title, verdict=verdict, roadmap=self.roadmap)
        recording = record_episode(self.task, self.policy, force)
        check_pushed(force, [recording])
        return self.show_of(recording, plan)

    def show_of(self, recording: Recording, plan: Recording | None) -> Show:
        """What was executed beside what was planned."""
        sentences = [] if plan is None else [planned_in_words(plan)]
        return compose(
            recording,
            plan,
            title=self.title,
            verdict=" ".join([*sentences, executed_in_words(recording)]),
            summary=summary(self.score.score, self.task) if self.score else (),
            roadmap=self.roadmap,
        )


def subject(word: str) -> Subject:
    """What a word of the command line names: task=NAME, a run's directory, or a plan's file.

    Raises:
        TsbenchError: it names nothing, or what is there is damaged.
    """
    if word.startswith("task="):
        return task_subject(tasks.make(word.removeprefix("task=")))
    path = Path(word)
    if path.is_dir() or not path.exists():
        return run_subject(RunDirectory(path))
    return plan_subject(path)


def task_subject(task: Task[Any]) -> Subject:
    """A task, shown by the plan that its hand-made planner makes."""
    title = f"{task.name}, planned by hand"
    planned = plannable(task)
    return Subject(title, task, None, planned.reference(naive_plan(planned)))


def run_subject(run: RunDirectory) -> Subject:
    """A run, of which nothing but the policy must be there.

    Raises:
        TsbenchError: there is no such directory, or a file in it is missing or damaged.
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
    """A plan or reference motion, with the constants of the run in whose directory it lies.

    Raises:
        TsbenchError: the file is neither, damaged, or for another version of its task.
    """
    motion, run = read_motion(path), RunDirectory(path.parent)
    task = plannable(run.task(motion.task))
    task.check_fit(motion)
    if isinstance(motion, Plan):
        motion = task.reference(motion)
    title = f"{task.name}, {path.name}"
    return Subject(title, task, None, motion, roadmap=run.roadmap(task))


def pair(runs: Sequence[str], push: str | None = None) -> Show:
    """Two runs of one task beside each other.

    Raises:
        TsbenchError: they are for different tasks, one of them is damaged, or the push comes after
            the end of both.
    """
    subjects = [run_subject(RunDirectory(Path(word))) for word in runs]
    force = None if push is None else parse_push(push, subjects[0].task)
    recordings = [record_episode(s.task, cast(Policy, s.policy), force) for s in subjects]
    check_pushed(force, recordings)
    verdict = " ".join(
        f"{name} is {one.title}. {executed_in_words(recording)}"
        for name, one, recording in zip("AB", subjects, recordings, strict=True)
    )
    title = f"{subjects[0].task.name}: two policies"
    a, b = recordings
    return compose_pair(a, b, title=title, verdict=verdict)


def check_pushed(push: Push | None, recordings: Sequence[Recording]) -> None:
    """
    Raises:
        TsbenchError: the push comes when every episode has ended, so that nobody would see it.
    """
    end = max(recording.duration for recording in recordings)
    if push is not None and (begins := float(np.min(push.time))) >= end:
        raise TsbenchError(f"a push at {begins:g} s comes after the episode's end at {end:.3g} s")


def planned_in_words(plan: Recording) -> str:
    distance = plan.goal_distance
    return (
        f"The plan starts {distance[0]:.2f} m from the goal and ends {distance[-1]:.2f} m from it "
        f"after {plan.duration:.1f} s."
    )


def executed_in_words(recording: Recording) -> str:
    end = f"{recording.goal_distance[-1]:.2f} m from the goal after {recording.duration:.1f} s"
    if recording.violated:
        return f"In full physics the policy ends {end}, spoiled by {recording.task.mishap}."
    verdict = "which solves the task" if recording.solved else "which does not solve the task"
    return f"In full physics the policy ends {end}, {verdict}."
