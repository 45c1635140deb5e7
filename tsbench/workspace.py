"""What a method reports while it trains: progress for the eye, and records in plain files."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from tsbench.record import EVENTS, LOG, METRICS
from tsbench.tables import duration, number

PLAIN_INTERVAL = 60.0  # seconds between lines where there is no terminal to draw a bar on
PLAIN_SHARE = 0.1  # or this share of the stage, whichever is first


@dataclass
class Stage:
    """What a stage has used so far.

    Attributes:
        name: as the method calls it.
        budget: environment steps it may use.
        steps: environment steps it has used.
        physics_substeps: steps of the physics under them; none in a kinematic stage.
        seconds: wall-clock.
    """

    name: str
    budget: int
    steps: int = 0
    physics_substeps: int = 0
    seconds: float = 0.0


@dataclass
class RunMonitor:
    """Takes a stage's figures, once for each iteration of its learner. A `methods.Monitor`."""

    workspace: RunWorkspace
    stage: Stage
    display: _Display
    began: float = field(default_factory=time.perf_counter)

    @property
    def physics_substeps(self) -> int:
        return self.stage.physics_substeps

    @physics_substeps.setter
    def physics_substeps(self, count: int) -> None:
        self.stage.physics_substeps = count

    def update(self, steps: int, metrics: Mapping[str, float]) -> None:
        """Records an iteration.

        Args:
            steps: environment steps of this stage so far.
            metrics: named scalars, such as episode_return; those that are not finite are dropped.
        """
        self.stage.steps = steps
        self.stage.seconds = time.perf_counter() - self.began
        finite = {name: float(value) for name, value in metrics.items() if math.isfinite(value)}
        self.workspace.record(self.stage, finite)
        self.display.show(self.stage, finite.get("episode_return"))


class RunWorkspace:
    """A run directory in use: `metrics.jsonl`, TensorBoard events and `log.txt`.

    A `methods.Workspace`. Everything is written at once, line by line, so that a run that is
    killed leaves what it had.
    """

    def __init__(self, directory: Path, console: Console) -> None:
        self.directory = directory
        self.stages: list[Stage] = []
        self._console = console
        self._began = time.perf_counter()
        self._log: IO[str] = (directory / LOG).open("a", encoding="utf-8")
        self._metrics: IO[str] = (directory / METRICS).open("a", encoding="utf-8")
        events = directory / EVENTS
        events.mkdir(exist_ok=True)
        # The record writer at the bottom of TensorBoard: no thread in which an error gets lost.
        self._events = RecordWriter((events / f"events.out.tfevents.{time.time_ns()}").open("ab"))
        self._write_event(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def close(self) -> None:
        for file in (self._log, self._metrics, self._events):
            file.close()

    def note(self, line: str) -> None:
        """Tells the user something in plain words, and keeps it in the log."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        self._log.write(f"{time.perf_counter() - self._began:10.1f} s  {line}\n")
        self._log.flush()

    @contextmanager
    def stage(self, name: str, steps: int) -> Iterator[RunMonitor]:
        """A stage of the method, with its progress bar.

        Args:
            name: e.g. "plan", "imitate".
            steps: environment steps that it may use.
        """
        stage = Stage(name, steps)
        self.stages.append(stage)
        with _Display(self._console, stage) as display:
            monitor = RunMonitor(self, stage, display)
            yield monitor
            stage.seconds = time.perf_counter() - monitor.began
        self.note(f"{name}: {stage.steps:,} steps in {duration(stage.seconds)}{display.figures}")

    def record(self, stage: Stage, metrics: Mapping[str, float]) -> None:
        """Appends an iteration's figures to `metrics.jsonl` and to the TensorBoard events."""
        row = {"stage": stage.name, "steps": stage.steps, "seconds": round(stage.seconds, 3)}
        self._metrics.write(json.dumps({**row, **metrics}) + "\n")
        self._metrics.flush()
        values = [
            Summary.Value(tag=f"{stage.name}/{name}", simple_value=value)
            for name, value in metrics.items()
        ]
        summary = Summary(value=values)
        self._write_event(Event(wall_time=time.time(), step=stage.steps, summary=summary))

    def stage_rows(self) -> list[dict[str, Any]]:
        """The stages as plain values, for `score.json`."""
        return [{**asdict(stage), "seconds": round(stage.seconds, 3)} for stage in self.stages]

    def _write_event(self, event: Event) -> None:
        self._events.write(event.SerializeToString())
        self._events.flush()


class _Display:
    """A progress bar on a terminal, elsewhere a line now and then."""

    def __init__(self, console: Console, stage: Stage) -> None:
        self._console = console
        self._bar: Progress | None = None
        self.figures = ""  # in words, as last shown
        self._shown_at = time.perf_counter()
        self._shown_steps = 0
        if console.is_terminal:
            columns = (
                TextColumn("{task.description:<10}"),
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[figures]}"),
            )
            self._bar = Progress(*columns, console=console, transient=True)
            self._row = self._bar.add_task(stage.name, total=stage.budget, figures="")

    def __enter__(self) -> _Display:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def show(self, stage: Stage, reward: float | None) -> None:
        """Draws the stage's progress; `reward` is the learner's mean return, where known."""
        rate = stage.steps / max(stage.seconds, 1e-9)
        left = max(stage.budget - stage.steps, 0) / max(rate, 1e-9)
        self.figures = f", reward {number(reward)}, {rate:,.0f} steps/s"
        line = f"{self.figures[2:]}, {duration(left)} left"
        if self._bar:
            self._bar.update(self._row, completed=stage.steps, figures=line)
            return
        now = time.perf_counter()
        far = stage.steps - self._shown_steps >= PLAIN_SHARE * stage.budget
        if far or now - self._shown_at >= PLAIN_INTERVAL:
            self._shown_at, self._shown_steps = now, stage.steps
            share = min(stage.steps / stage.budget, 1.0)
            self._console.print(
                f"{stage.name:<10} {share:4.0%}  {line}",
                markup=False,
                highlight=False,
                soft_wrap=True,
            )
