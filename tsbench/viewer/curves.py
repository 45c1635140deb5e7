"""Learning curves of a run, drawn from its `metrics.jsonl`."""

from __future__ import annotations

import io
import json
from pathlib import Path

from matplotlib.figure import Figure

from tsbench.core.errors import TsbenchError
from tsbench.core.files import write_new

MEASURE = "episode_return"


def figure(metrics: Path) -> Figure | None:
    """The return against environment steps, one panel for each stage.

    Args:
        metrics: a run's `metrics.jsonl`.

    Returns:
        The figure, or None if the metrics hold no returns.

    Raises:
        TsbenchError: the file is damaged.
    """
    curves: dict[str, tuple[list[int], list[float]]] = {}
    for line in metrics.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
            if MEASURE in row:
                steps, returns = curves.setdefault(row["stage"], ([], []))
                steps.append(row["steps"])
                returns.append(row[MEASURE])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise TsbenchError(f"damaged metrics {metrics}: {error}") from None
    if not curves:
        return None
    drawn = Figure(figsize=(4.5 * len(curves), 3.2), layout="constrained")
    panels = drawn.subplots(1, len(curves), squeeze=False)[0]
    for panel, (stage, (steps, returns)) in zip(panels, curves.items(), strict=True):
        panel.plot(steps, returns)
        panel.set(title=stage, xlabel="environment steps", ylabel="episode return of the stage")
        panel.grid(alpha=0.3)
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
