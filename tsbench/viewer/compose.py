"""From recordings to what is to be seen of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tsbench.core.errors import TsbenchError
from tsbench.viewer.framing import reach
from tsbench.viewer.props import balance_marks, contact_marks, flames, planned_marks, push_arrows
from tsbench.viewer.recording import Recording
from tsbench.viewer.scene import Array
from tsbench.viewer.show import (
    EXECUTED_COLOUR,
    FLAME_COLOUR,
    INK,
    OTHER_COLOUR,
    PAPER,
    PLAN_COLOUR,
    PUSH_COLOUR,
    Actor,
    Band,
    Curve,
    Entry,
    Prop,
    Rgb,
    Show,
)
from tsbench.viewer.stage import stage

LANE = 2.0  # sizes of the robot between two that walk side by side

EXECUTED_NOTE = "what the policy did, in full physics; its path is orange"
PLAN_NOTE = "what it was to do, planned without physics; translucent"
PAIR_NOTE = "what this policy did, in full physics; its path in this colour"

STAND_PLANNED = Entry("planned contact", PLAN_COLOUR, "where a foot should stand now")
STAND = Entry("contact", EXECUTED_COLOUR, "where a foot presses on the ground now")
MASS = Entry("centre of mass", INK, "black dot, below the robot")
PRESSURE = Entry("centre of pressure", PAPER, "white dot, where the ground pushes back")
PUSH = Entry("push", PUSH_COLOUR, "a force from outside, while it lasts")
FLAMES = Entry("flames", FLAME_COLOUR[:3], "as long as the engine is strong")
GLOW = Entry("glow", (1.0, 0.75, 0.08), "where the reward can be felt; red is a penalty")


def compose(
    recording: Recording,
    plan: Recording | None,
    *,
    title: str,
    verdict: str = "",
    summary: Sequence[tuple[str, str]] = (),
) -> Show:
    """The show of one policy and the plan that it was to follow. Without a plan, the contacts
    that the task's schedule asks for are shown where the feet are.

    Args:
        recording: what was executed.
        plan: what was planned, as full poses.
        title, verdict, summary: see `Show`.
    """
    name, guide = "executed", plan or recording
    actors = [Actor(name, recording.qpos, recording.task.timestep, EXECUTED_COLOUR, EXECUTED_NOTE)]
    lines = [(EXECUTED_COLOUR, recording)]
    if plan is not None:
        actors.append(_plan_actor(plan))
        lines.insert(0, (PLAN_COLOUR, plan))
    props, legend = [], []
    drawing = recording.task.drawing()
    if drawing.feet:
        props += planned_marks(name if plan is None else "plan", guide)
        legend += [STAND_PLANNED] if props else []
        props += contact_marks(name, recording) + balance_marks(name, recording)
        legend += [STAND, MASS, PRESSURE]
    props += flames(name, recording)
    legend += [FLAMES] if drawing.flames else []
    legend += [GLOW] if drawing.worth else []
    arrows = push_arrows(name, recording)
    legend += [PUSH] if arrows else []
    return Show(
        model=stage(recording),
        actors=actors,
        title=title,
        verdict=verdict,
        summary=summary,
        props=props + arrows,
        legend=legend,
        timeline=[*foot_bands(guide, recording), *_curves(lines)],
    )


def compose_plan(plan: Recording, *, title: str, verdict: str = "") -> Show:
    """The show of a plan alone."""
    drawing = plan.task.drawing()
    marks = planned_marks("plan", plan) if drawing.feet else []
    return Show(
        model=stage(plan),
        actors=[_plan_actor(plan)],
        title=title,
        verdict=verdict,
        props=marks,
        legend=([STAND_PLANNED] if marks else []) + ([GLOW] if drawing.worth else []),
        timeline=[*foot_bands(plan, None), *_curves([(PLAN_COLOUR, plan)])],
    )


def _plan_actor(plan: Recording) -> Actor:
    return Actor("plan", plan.qpos, plan.task.timestep, PLAN_COLOUR, PLAN_NOTE, ghost=True)


def compose_pair(first: Recording, second: Recording, *, title: str, verdict: str) -> Show:
    """The show of two policies of one task, called A and B: on the ground side by side, in a flat
    world, where there is no aside, on top of each other.

    Raises:
        TsbenchError: they are for different tasks.
    """
    if first.task != second.task:
        constants = " with other constants" if first.task.name == second.task.name else ""
        raise TsbenchError(
            "only policies for one task can be compared, "
            f"not for {first.task.name} and {second.task.name}{constants}"
        )
    size = reach(first.task.spec().compile(), first.qpos[0])[0]
    lane = LANE * size if first.task.drawing().feet else 0.0
    actors: list[Actor] = []
    props: list[Prop] = []
    for name, recording, colour, aside in (
        ("A", first, EXECUTED_COLOUR, 0.0),
        ("B", second, OTHER_COLOUR, lane),
    ):
        step = recording.task.timestep
        actors.append(Actor(name, recording.qpos, step, colour, PAIR_NOTE, lane=aside))
        props += flames(name, recording) + push_arrows(name, recording, aside)
    return Show(
        model=stage(first, lane),
        actors=actors,
        title=title,
        verdict=verdict,
        props=props,
        legend=[PUSH] if first.forces.any() or second.forces.any() else [],
        timeline=_curves([(OTHER_COLOUR, second), (EXECUTED_COLOUR, first)]),
    )


def spans(times: Array, on: NDArray[np.bool_]) -> list[list[float]]:
    """[begin, end] of the times (K,) for which something held (K,); a time stands for the step
    that begins there."""
    edges = np.diff(np.concatenate([[False], on, [False]]).astype(int))
    ends = np.append(times, times[-1])
    return [
        [round(float(times[begin]), 4), round(float(ends[end]), 4)]
        for begin, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True)
    ]


def foot_bands(planned: Recording, executed: Recording | None) -> list[Band]:
    """When each foot was to be on the ground, by the clock of `planned`, and when it was."""
    drawing = planned.task.drawing()
    scheduled = planned.scheduled
    return [
        Band(
            f"{foot.replace('_', ' ')} stands",
            [] if scheduled is None else spans(planned.times, scheduled[:, index]),
            [] if executed is None else spans(executed.times, executed.support.contacts[:, index]),
        )
        for index, foot in enumerate(drawing.feet)
    ]


def _curves(lines: Sequence[tuple[Rgb, Recording]]) -> list[Curve]:
    return [
        Curve("distance to goal, m", tuple((c, r.times, r.goal_distance) for c, r in lines)),
        Curve(
            "reward of each step",
            tuple((c, r.times[1:], r.reward_terms["reward"]) for c, r in lines),
        ),
    ]
