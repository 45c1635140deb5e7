"""The report's charts, as SVG: the plan in blue, the execution in orange, as in the 3-D view."""

from __future__ import annotations

import html
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tsbench.evaluation.robustness import Surface
from tsbench.viewer import curves
from tsbench.viewer.recording import Array, Recording
from tsbench.viewer.show import EXECUTED_COLOUR, PLAN_COLOUR, Band, Rgb

WIDTH = 11.0  # inches
STYLE = {
    "svg.fonttype": "none",  # keeps text as text, which can be searched
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.0,
}
SCALAR_JOINTS = {mujoco.mjtJoint.mjJNT_HINGE: "rad", mujoco.mjtJoint.mjJNT_SLIDE: "m"}

Line = tuple[Rgb, Array, Array]  # colour, seconds (K,), values (K,)


def svg(figure: Figure, name: str, timed: Sequence[Axes] = ()) -> str:
    """A figure as an element of an HTML page.

    Args:
        figure: the figure.
        name: name of the chart, unique in the page.
        timed: panels whose x axis is the show's time; the page draws a playhead on them.
    """
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": name}):
        text = io.StringIO()
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(text, format="svg", metadata=nothing)
    frames = []
    for panel in timed:
        box, (begin, end) = panel.get_position(), panel.get_xlim()
        frames.append([box.x0, 1.0 - box.y1, box.x1, 1.0 - box.y0, begin, end])
    drawn = text.getvalue()
    return (
        f'<div class="chart" data-panels="{html.escape(json.dumps(frames))}">'
        f"{drawn[drawn.index('<svg') :]}</div>"
    )


def contacts(bands: Sequence[Band], duration: float) -> str:
    """The planned and the executed contact times of each foot, planned above executed."""
    figure, panel = _figure(0.34 * len(bands) + 0.7)
    for row, band in enumerate(bands):
        for spans, colour, low in (
            (band.planned, PLAN_COLOUR, row - 0.4),
            (band.executed, EXECUTED_COLOUR, row),
        ):
            widths = [(begin, end - begin) for begin, end in spans]
            panel.broken_barh(widths, (low, 0.36), facecolors=[colour])
    panel.set(xlim=(0.0, duration), ylim=(len(bands) - 0.5, -0.5), xlabel="time, s")
    panel.set_yticks(range(len(bands)), [band.text for band in bands])
    return svg(figure, "contacts", [panel])


def rewards(recording: Recording, plan: Recording | None) -> str:
    """The reward of each step and its terms, executed beside planned."""
    names = list(recording.reward_terms)
    lines = [(EXECUTED_COLOUR, recording)]
    if plan is not None:
        lines.insert(0, (PLAN_COLOUR, plan))
    return _panels(
        "rewards",
        {
            name: [(colour, r.times[1:], r.reward_terms[name]) for colour, r in lines]
            for name in names
        },
        columns=min(len(names), 3),
    )


def joints(recording: Recording, plan: Recording) -> str:
    """The planned and executed position of every joint with one degree of freedom."""
    model = recording.task.spec().compile()
    lines: dict[str, list[Line]] = {}
    for index in range(model.njnt):
        joint = model.joint(index)
        unit = SCALAR_JOINTS.get(mujoco.mjtJoint(int(joint.type[0])))
        if unit is None:
            continue
        column = int(joint.qposadr[0])
        shared = min(len(plan.qpos), len(recording.qpos))
        error = recording.qpos[:shared, column] - plan.qpos[:shared, column]
        typical = math.sqrt(float(np.mean(error**2)))
        lines[f"{joint.name}, {unit} (typical error {typical:.2g} {unit})"] = [
            (PLAN_COLOUR, plan.times, plan.qpos[:, column]),
            (EXECUTED_COLOUR, recording.times, recording.qpos[:, column]),
        ]
    return _panels("joints", lines, columns=3)


def robustness(surface: Surface, timestep: float) -> str:
    """The shares of survived pushes (above) and of recovered pushes (below), by force and direction
    (left) and by force and time (right).

    Args:
        surface: every push, with its outcome.
        timestep: seconds of a control step.
    """
    phases = [f"{phase * timestep:.2f}" for phase in surface.phases]
    forces, headings = surface.forces_N, np.degrees(surface.headings_rad)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 6.0), layout="constrained")
        grid = figure.subplots(2, 2)
    for row, held, what in (
        (grid[0], surface.survived, "survived"),
        (grid[1], surface.recovered, "recovered"),
    ):
        shares = np.asarray(held, float)
        for panel, share, ticks, label in (
            (row[0], shares.mean(axis=2), [f"{h:.0f}" for h in headings],
             "direction of the push, degrees (0 ahead, 90 left or up)"),
            (row[1], shares.mean(axis=1), phases, "beginning of the push, s"),
        ):  # fmt: skip
            image = panel.imshow(
                share, origin="lower", aspect="auto", vmin=0.0, vmax=1.0, cmap="cividis"
            )
            every = -(-len(ticks) // 8)  # more than eight labels would overlap
            panel.set_xticks(range(0, len(ticks), every), ticks[::every])
            panel.set_yticks(range(len(forces)), [f"{force:.3g}" for force in forces])
            panel.set(xlabel=label, ylabel="force, N")
        figure.colorbar(image, ax=list(row), label=f"share of pushes {what}")
    return svg(figure, "robustness")


def learning(metrics: Path) -> str | None:
    """The learning curves, or None if the metrics hold no returns."""
    with matplotlib.rc_context(STYLE):
        figure = curves.figure(metrics)
    if figure is None:
        return None
    figure.set_size_inches(WIDTH, 2.6)
    return svg(figure, "learning")


def _figure(height: float) -> tuple[Figure, Axes]:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        return figure, figure.subplots()


def _panels(name: str, curves: Mapping[str, Sequence[Line]], columns: int) -> str:
    """A grid of small charts over time, each under its title."""
    rows = -(-len(curves) // columns)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.5 * rows + 0.3), layout="constrained")
        grid = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
        for panel, (title, lines) in zip(grid, curves.items(), strict=False):
            for colour, times, values in lines:
                panel.plot(times, values, color=colour, linewidth=1.2)
            panel.set_title(title, loc="left")
            panel.grid(alpha=0.3)
            panel.margins(x=0.0)
        for panel in grid[len(curves) :]:
            panel.set_visible(False)
        figure.supxlabel("time, s", fontsize=9.0)
    return svg(figure, name, list(grid[: len(curves)]))
