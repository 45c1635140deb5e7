"""Learning curves of a run, drawn from its `metrics.jsonl`."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tsbench.core.files import write_new
from tsbench.runs.directory import curve_points

Curve = tuple[list[float], list[float]]  # environment steps, returns

MEASURE = "episode_return"


def read_curves(metrics: Path) -> dict[str, Curve]:
    """The return against environment steps, by stage; none if the metrics hold no returns.

    Args:
        metrics: a run's `metrics.jsonl`.

    Raises:
        TsbenchError: the file is damaged.
    """
    curves: dict[str, Curve] = {}
    for stage, point in curve_points(metrics):
        if MEASURE in point:
            steps, returns = curves.setdefault(stage, ([], []))
            steps.append(point["steps"])
            returns.append(point[MEASURE])
    return curves


def draw_curve(panel: Axes, stage: str, curve: Curve) -> None:
    """Draws a stage's curve on a panel."""
    panel.plot(*curve)
    panel.set_title(stage[:40], parse_math=False)
    panel.set(xlabel="environment steps", ylabel="episode return of the stage")
    panel.grid(alpha=0.3)


def figure(metrics: Path) -> Figure | None:
    """All curves of a run's `metrics.jsonl`, one panel for each stage; None without any.

    Raises:
        TsbenchError: the file is damaged.
    """
    curves = read_curves(metrics)
    if not curves:
        return None
    drawn = Figure(figsize=(4.5 * len(curves), 3.2), layout="constrained")
    panels = drawn.subplots(1, len(curves), squeeze=False)[0]
    for panel, curve in zip(panels, curves.items(), strict=True):
        draw_curve(panel, *curve)
    return drawn


def draw(metrics: Path, picture: Path) -> None:
    """Writes the learning curves as a PNG, if the metrics hold returns.

    Args:
        metrics: a run's `metrics.jsonl`.
        picture: the PNG to write, a new file.

    Raises:
        TsbenchError: the metrics are damaged, or the picture exists or cannot be written.
    """
    if drawn := figure(metrics):
        content = io.BytesIO()
        drawn.savefig(content, dpi=120)
        write_new(picture, content.getvalue())
