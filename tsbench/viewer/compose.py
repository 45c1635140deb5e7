"""Makes shows from recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tsbench.core.drawing import Drawing, Lines
from tsbench.core.errors import TsbenchError
from tsbench.core.motion import Roadmap
from tsbench.viewer.framing import reach
from tsbench.viewer.props import balance_marks, contact_marks, flames, planned_marks, push_arrows
from tsbench.viewer.pushes import headings
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
    ROADMAP_COLOUR,
    WAY_COLOUR,
    Actor,
    Band,
    Curve,
    Entry,
    Figures,
    Prop,
    Rgb,
    Show,
)
from tsbench.viewer.stage import stage

LANE = 2.0  # robot sizes between two robots that are shown side by side

MOST_EDGES = 4000  # of a roadmap that are drawn
ROADMAP_NOTE = f"straight ways that are free, the shortest {MOST_EDGES:,} at most"

EXECUTED_NOTE = "the policy's motion in full physics; its path is orange"
PLAN_NOTE = "the planned motion, without physics; translucent"
PAIR_NOTE = "its motion in full physics; the path in this colour"

STAND_PLANNED = Entry("planned contact", PLAN_COLOUR, "where a foot should stand now")
STAND = Entry("contact", EXECUTED_COLOUR, "where a foot presses on the ground now")
MASS = Entry("centre of mass", INK, "black dot, below the robot")
PRESSURE = Entry("centre of pressure", PAPER, "white dot, mean point of the ground's pressure")
PUSH = Entry("push", PUSH_COLOUR, "an external force, while it acts")
FLAMES = Entry("flames", FLAME_COLOUR[:3], "their length shows the engine's throttle")
GLOW = Entry("glow", (1.0, 0.75, 0.08), "reward at this place; red is a penalty")
BORDER = Entry("border", INK, "the edge of the world, where an episode ends")


def compose(
    recording: Recording,
    plan: Recording | None,
    *,
    title: str,
    verdict: str = "",
    tables: Sequence[Figures] = (),
    roadmap: Roadmap | None = None,
) -> Show:
    """The show of one policy and the plan that it follows. Without a plan, the scheduled contacts
    are drawn below the feet of the robot.

    Args:
        recording: the executed motion.
        plan: the planned motion.
        title, verdict, tables: see `Show`.
        roadmap: that the plan was made with.
    """
    name, guide = "executed", plan or recording
    actors = [_executed_actor(name, recording, EXECUTED_COLOUR, EXECUTED_NOTE)]
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
    legend += _of_world(drawing)
    arrows = push_arrows(name, recording)
    legend += [PUSH] if arrows else []
    drawn = roadmap_lines(roadmap)
    legend += [Entry(one.name, one.colour, one.note) for one in drawn]
    return Show(
        model=stage(recording, lines=drawn),
        actors=actors,
        title=title,
        verdict=verdict,
        tables=tables,
        props=props + arrows,
        legend=legend,
        timeline=[*foot_bands(guide, recording), *_curves(lines)],
        robot=drawing.robot,
        headings=list(headings(recording.task).items()),
    )


def compose_plan(
    plan: Recording, *, title: str, verdict: str = "", roadmap: Roadmap | None = None
) -> Show:
    """The show of a plan alone, or with the roadmap that it was made with."""
    drawing = plan.task.drawing()
    marks = planned_marks("plan", plan) if drawing.feet else []
    drawn = roadmap_lines(roadmap)
    legend = [Entry(one.name, one.colour, one.note) for one in drawn]
    return Show(
        model=stage(plan, lines=drawn),
        actors=[_plan_actor(plan)],
        title=title,
        verdict=verdict,
        props=marks,
        legend=[STAND_PLANNED] * bool(marks) + _of_world(drawing) + legend,
        timeline=[*foot_bands(plan, None), *_curves([(PLAN_COLOUR, plan)])],
        robot=drawing.robot,
    )


def roadmap_lines(roadmap: Roadmap | None) -> list[Lines]:
    """The roadmap's shortest edges, and the way through it."""
    if roadmap is None:
        return []
    edges = roadmap.nodes[roadmap.edges]
    order = np.argsort(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1), kind="stable")
    way = np.stack([roadmap.path[:-1], roadmap.path[1:]], axis=1)
    return [
        Lines("roadmap", ROADMAP_NOTE, ROADMAP_COLOUR, edges[order[:MOST_EDGES]], 0.0005),
        Lines("way", "the way through the roadmap that the plan follows", WAY_COLOUR, way, 0.0015),
    ]


def _of_world(drawing: Drawing) -> list[Entry]:
    """The legend's lines for the reward map and for the world's border."""
    return [GLOW] * (drawing.worth is not None) + [BORDER] * (drawing.bounds is not None)


def _executed_actor(
    name: str, recording: Recording, colour: Rgb, note: str, lane: float = 0.0
) -> Actor:
    ending = f"{recording.ending} at {recording.duration:.2f} s"
    step = recording.task.timestep
    return Actor(name, recording.qpos, step, colour, note, lane=lane, ending=ending)


def _plan_actor(plan: Recording) -> Actor:
    return Actor("plan", plan.qpos, plan.task.timestep, PLAN_COLOUR, PLAN_NOTE, ghost=True)


def compose_pair(
    first: Recording,
    second: Recording,
    names: tuple[str, str] = ("A", "B"),
    *,
    title: str,
    verdict: str,
    tables: Sequence[Figures] = (),
) -> Show:
    """The show of two policies of one task. Robots with feet are shown side by side, others at
    their own positions.

    Args:
        first, second: the executed motions.
        names: of the policies.
        title, verdict, tables: see `Show`.

    Raises:
        TsbenchError: the recordings are of different tasks or constants.
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
        (names[0], first, EXECUTED_COLOUR, 0.0),
        (names[1], second, OTHER_COLOUR, lane),
    ):
        actors.append(_executed_actor(name, recording, colour, PAIR_NOTE, aside))
        props += flames(name, recording) + push_arrows(name, recording, aside)
    drawing, pushed = first.task.drawing(), first.forces.any() or second.forces.any()
    legend = [FLAMES] * bool(drawing.flames) + _of_world(drawing) + [PUSH] * bool(pushed)
    return Show(
        model=stage(first, lane),
        actors=actors,
        title=title,
        verdict=verdict,
        tables=tables,
        props=props,
        legend=legend,
        timeline=_curves([(OTHER_COLOUR, second), (EXECUTED_COLOUR, first)]),
        robot=drawing.robot,
        headings=list(headings(first.task).items()),
    )


def spans(times: Array, on: NDArray[np.bool_]) -> list[list[float]]:
    """[begin, end] in seconds of the intervals in which a condition holds.

    Args:
        times: seconds at which steps begin, shape (K,).
        on: whether the condition holds in each step, shape (K,).
    """
    edges = np.diff(np.concatenate([[False], on, [False]]).astype(int))
    ends = np.append(times, times[-1])
    return [
        [round(float(times[begin]), 4), round(float(ends[end]), 4)]
        for begin, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True)
    ]


def foot_bands(planned: Recording, executed: Recording | None) -> list[Band]:
    """The contact times of each foot: scheduled, at the times of `planned`, and executed."""
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
