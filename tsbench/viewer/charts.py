"""The report's charts, as SVG: the plan in blue, the execution in orange, as in the 3-D view."""

from __future__ import annotations

import html
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tsbench.evaluation.robustness import Surface
from tsbench.viewer.curves import Curve, draw_curve, read_curves
from tsbench.viewer.recording import Array, Recording
from tsbench.viewer.show import EXECUTED_COLOUR, PLAN_COLOUR, Band, Rgb

BROAD, NARROW, SMALL = 11.0, 4.6, 3.7  # inches: of a window, of a phone, of one of several panels
LINE = 9.0  # points, of text
TEXT_COLOUR = (
    "#123456"  # stands for the page's colour of text, which depends on the reader's scheme
)
STYLE = {
    "svg.fonttype": "none",  # keeps text as text, which can be searched
    "text.parse_math": False,  # names may have a $
    "font.family": "sans-serif",
    "font.size": LINE,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": LINE,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    **dict.fromkeys(
        ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"),
        TEXT_COLOUR,
    ),
}
SCALAR_JOINTS = {mujoco.mjtJoint.mjJNT_HINGE: "rad", mujoco.mjtJoint.mjJNT_SLIDE: "m"}

Line = tuple[str, Rgb, Array, Array]  # whose, colour, seconds (K,), values (K,)


@dataclass(frozen=True)
class Chart:
    """A chart in words, for readers who cannot see it.

    Attributes:
        name: unique in the page.
        title: names it.
        text: what it shows.
    """

    name: str
    title: str
    text: str


def svg(figure: Figure, chart: Chart, panel: Axes | None = None, shown: str = "") -> str:
    """A figure as an element of an HTML page.

    Args:
        figure: the figure.
        chart: the figure in words.
        panel: whose x axis is the show's time; the page draws a playhead on it.
        shown: the class of an element that only windows or only phones show.
    """
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": chart.name}):
        text = io.StringIO()
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(text, format="svg", metadata=nothing)
    frame = []
    if panel is not None:
        box, (begin, end) = panel.get_position(), panel.get_xlim()
        frame = [box.x0, 1.0 - box.y1, box.x1, 1.0 - box.y0, begin, end]
    drawn = text.getvalue().replace(TEXT_COLOUR, "var(--ink)")
    drawn = drawn[drawn.index("<svg") :]
    words = (
        f'<title id="{chart.name}-title">{html.escape(chart.title)}</title>'
        f'<desc id="{chart.name}-text">{html.escape(chart.text)}</desc>'
    )
    role = f'role="img" aria-labelledby="{chart.name}-title {chart.name}-text" '
    head, inside = drawn[len("<svg ") :].split(">", 1)
    return (
        f'<div class="chart {shown}" data-panel="{html.escape(json.dumps(frame))}">'
        f"<svg {role}{head}>{words}{inside}</div>"
    )


def grid(charts: Iterable[str], size: str = "") -> str:
    """Charts beside and below each other, as many columns as fit; fewer of the size "large"."""
    return f'<div class="grid {size}">{"".join(charts)}</div>'


def contacts(bands: Sequence[Band], duration: float) -> str:
    """The planned and the executed contact times of each foot, planned above executed."""
    return "".join(
        _contacts(bands, duration, width, shown)
        for width, shown in ((BROAD, "broad"), (NARROW, "narrow"))
    )


@matplotlib.rc_context(STYLE)
def _contacts(bands: Sequence[Band], duration: float, width: float, shown: str) -> str:
    figure, panel = _figure(width, 0.34 * len(bands) + 0.7)
    words = []
    for row, band in enumerate(bands):
        for spans, colour, low in (
            (band.planned, PLAN_COLOUR, row - 0.4),
            (band.executed, EXECUTED_COLOUR, row),
        ):
            widths = [(begin, end - begin) for begin, end in spans]
            panel.broken_barh(widths, (low, 0.36), facecolors=[colour])
        planned, executed = (sum(end - begin for begin, end in spans) for spans in
                             (band.planned, band.executed))  # fmt: skip
        words.append(f"{band.text} {planned:.2f} s in the plan, {executed:.2f} s executed")
    panel.set(xlim=(0.0, duration), ylim=(len(bands) - 0.5, -0.5), xlabel="time, s")
    panel.set_yticks(range(len(bands)), [band.text for band in bands])
    chart = Chart(f"contacts-{shown}", "Foot contacts over time", "; ".join(words))
    return svg(figure, chart, panel, shown)


def rewards(recording: Recording, plan: Recording | None) -> str:
    """The reward of each step and its terms, executed beside planned. A term that is the whole
    reward is not drawn twice."""
    lines = [("executed", EXECUTED_COLOUR, recording)]
    if plan is not None:
        lines.insert(0, ("plan", PLAN_COLOUR, plan))

    def whole(name: str) -> bool:
        return all(
            np.array_equal(r.reward_terms[name], r.reward_terms["reward"]) for _, _, r in lines
        )

    names = list(recording.reward_terms)
    titles = {name: name for name in names if not whole(name)}
    titles["reward"] = " = ".join(filter(whole, names))
    return grid(
        _panel(
            f"reward-{number}",
            title,
            [(what, colour, r.times[1:], r.reward_terms[name]) for what, colour, r in lines],
        )
        for number, (name, title) in enumerate(titles.items())
    )


def joints(recording: Recording, plan: Recording) -> str:
    """The planned and executed position of every joint with one degree of freedom."""
    model = recording.task.spec().compile()
    drawn = []
    for index in range(model.njnt):
        joint = model.joint(index)
        unit = SCALAR_JOINTS.get(mujoco.mjtJoint(int(joint.type[0])))
        if unit is None:
            continue
        column = int(joint.qposadr[0])
        shared = min(len(plan.qpos), len(recording.qpos))
        error = recording.qpos[:shared, column] - plan.qpos[:shared, column]
        typical = math.sqrt(float(np.mean(error**2)))
        lines = [
            ("plan", PLAN_COLOUR, plan.times, plan.qpos[:, column]),
            ("executed", EXECUTED_COLOUR, recording.times, recording.qpos[:, column]),
        ]
        title = f"{joint.name}, {unit} (typical error {typical:.2g} {unit})"
        drawn.append(_panel(f"joint-{index}", title, lines))
    return grid(drawn)


def robustness(surface: Surface, timestep: float, headings: str) -> str:
    """The shares of survived pushes (above) and of recovered pushes (below), by force and direction
    (left) and by force and time (right).

    Args:
        surface: every push, with its outcome.
        timestep: seconds of a control step.
        headings: what the directions mean, in words.
    """
    phases = [f"{phase * timestep:.2f}" for phase in surface.phases]
    angles = [f"{heading:.0f}" for heading in np.degrees(surface.headings_rad)]
    return grid(
        (
            _shares(what, np.asarray(held, float).mean(axis=axis), surface.forces_N, ticks, label)
            for what, held in (("survived", surface.survived), ("recovered", surface.recovered))
            for axis, ticks, label in (
                (2, angles, f"direction, degrees ({headings})"),
                (1, phases, "beginning of the push, s"),
            )
        ),
        "large",
    )


@matplotlib.rc_context(STYLE)
def _shares(
    what: str, share: Array, forces: Sequence[float], ticks: Sequence[str], label: str
) -> str:
    """The share of pushes by force and by what else, shape (forces, ticks)."""
    figure, panel = _figure(NARROW, 2.4)
    image = panel.imshow(share, origin="lower", aspect="auto", vmin=0.0, vmax=1.0, cmap="cividis")
    every = -(-len(ticks) // 8)  # more than eight labels would overlap
    panel.set_xticks(range(0, len(ticks), every), ticks[::every])
    every = -(-len(forces) // 8)
    panel.set_yticks(range(0, len(forces), every), [f"{force:.3g}" for force in forces[::every]])
    panel.set(xlabel=label, ylabel="force, N")
    figure.colorbar(image, ax=panel, label=f"share of pushes {what}")
    rows = zip(forces, share.mean(axis=1), strict=True)
    words = "; ".join(f"{mean:.0%} at {force:.3g} N" for force, mean in rows)
    title = f"Share of pushes {what}, by force and {label.split(',')[0]}"
    return svg(figure, Chart(f"{what}-{label[:4]}", title, words))


def learning(metrics: Path) -> str | None:
    """The learning curves, or None if the metrics hold no returns."""
    found = read_curves(metrics)
    if not found:
        return None
    drawn = (_learning(number, *curve) for number, curve in enumerate(found.items()))
    return grid(drawn, "large")


@matplotlib.rc_context(STYLE)
def _learning(number: int, stage: str, curve: Curve) -> str:
    figure, panel = _figure(NARROW, 2.6)
    draw_curve(panel, stage, curve)
    returns = curve[1]
    words = f"from {returns[0]:.3g} to {returns[-1]:.3g} in {curve[0][-1]:,} steps"
    return svg(figure, Chart(f"learning-{number}", f"Return of the stage {stage}", words))


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    """An empty chart of a size in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


@matplotlib.rc_context(STYLE)
def _panel(name: str, title: str, lines: Sequence[Line]) -> str:
    """A small chart over time, under its title."""
    figure, panel = _figure(SMALL, 1.7)
    words = []
    for what, colour, times, values in lines:
        panel.plot(times, values, color=colour, linewidth=1.2)
        low, high = np.min(values), np.max(values)
        words.append(f"{what}: from {low:.3g} to {high:.3g}, at the end {values[-1]:.3g}")
    panel.set_title(title, loc="left")
    panel.grid(alpha=0.3)
    panel.margins(x=0.0)
    panel.set_xlabel("time, s")
    return svg(figure, Chart(name, f"{title} over time", "; ".join(words)), panel)
