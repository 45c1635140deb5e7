"""The workspace of a run: shows a method's progress, and writes metrics, log and checkpoints."""

from __future__ import annotations

import json
import math
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from tsbench.core.errors import Stopped, TsbenchError, quoted
from tsbench.core.files import append, read_file
from tsbench.core.method import Monitor, Snapshot
from tsbench.core.typed import typed
from tsbench.core.words import duration, number
from tsbench.runs.checkpoint import Checkpoint, Checkpoints
from tsbench.runs.directory import CHECKPOINTS, LOG, MAX_METRICS, METRICS, MOST_STAGES, Stage
from tsbench.runs.events import Events

INTERVAL = 30.0  # seconds of training between checkpoints
PLAIN_INTERVAL = 60.0  # seconds between lines where no terminal can show a bar
PLAIN_SHARE = 0.1  # or a line after this share of the stage, whichever is first


@dataclass(frozen=True)
class Saved:
    """The content of a checkpoint.

    Attributes:
        run: hash that identifies the run.
        stages: the finished stages and the current one.
        sizes: bytes so far of each file that a resumed run appends to.
        learner: the snapshot that the current stage continues from.
    """

    run: str
    stages: list[Stage]
    sizes: dict[str, int]
    learner: dict[str, Any]


@dataclass
class RunMonitor:
    """Takes a stage's figures, once for each iteration of its learner.

    It implements `core.method.Monitor`.
    """

    workspace: RunWorkspace
    stage: Stage
    display: _Display
    saved: Snapshot | None
    began: float = field(init=False)

    def __post_init__(self) -> None:
        self.began = time.perf_counter() - self.stage.seconds

    @property
    def physics_substeps(self) -> int:
        return self.stage.physics_substeps

    @physics_substeps.setter
    def physics_substeps(self, count: int) -> None:
        self.stage.physics_substeps = count

    @property
    def warnings(self) -> dict[str, int]:
        return self.stage.warnings

    @warnings.setter
    def warnings(self, counts: dict[str, int]) -> None:
        self.stage.warnings = counts

    def update(
        self,
        steps: int,
        metrics: Mapping[str, float],
        snapshot: Callable[[], Snapshot] | None = None,
    ) -> None:
        """Records an iteration, and saves a checkpoint when one is due.

        Args:
            steps: environment steps of this stage so far.
            metrics: named scalars, such as episode_return; values that are not finite are dropped.
            snapshot: returns the state that the next iteration depends on.

        Raises:
            Stopped: a signal has arrived.
        """
        self.stage.steps = steps
        self.stage.seconds = time.perf_counter() - self.began
        finite = {name: float(value) for name, value in metrics.items() if math.isfinite(value)}
        self.workspace.record(self.stage, finite)
        self.display.show(self.stage, finite.get("episode_return"))
        if snapshot is not None:
            self.workspace.keep(self.stage, snapshot)


@dataclass
class Finished:
    """The monitor of a stage that was finished before the run was interrupted."""

    saved: Snapshot | None
    physics_substeps: int = 0
    warnings: dict[str, int] = field(default_factory=dict)

    def update(
        self,
        steps: int,
        metrics: Mapping[str, float],
        snapshot: Callable[[], Snapshot] | None = None,
    ) -> None:
        """Does nothing: the stage has been recorded."""


class RunWorkspace:
    """A run directory in use: `metrics.jsonl`, what loggers show, `log.txt` and checkpoints.

    It implements `core.method.Workspace`. Every line is written immediately. When a run is resumed,
    metrics and events are cut back to the newest checkpoint, and the iterations after it are
    repeated.
    """

    def __init__(
        self,
        directory: Path,
        console: Console,
        *,
        interval: float = INTERVAL,
        run: str = "",
        loggers: Sequence[str] = ("tensorboard",),
    ) -> None:
        """
        Args:
            directory: the run directory.
            console: shows progress.
            interval: seconds of training between checkpoints.
            run: hash that identifies this run; checkpoints of other runs are refused.
            loggers: what shows the metrics elsewhere (`runs.events.LOGGERS`).

        Raises:
            TsbenchError: the checkpoints are another run's, or the metrics are damaged or shorter
                than the checkpoint says.
        """
        self.directory = directory
        self.stages: list[Stage] = []
        self._console = console
        self._interval = interval
        self._run = run
        self._began = time.perf_counter()
        self._stopped_by: int | None = None  # a signal that has arrived
        self._learning = False  # whether there is an iteration to finish and a state to save
        with ExitStack() as files:
            self._log = files.enter_context(append(directory / LOG))
            self._checkpoints = Checkpoints(directory / CHECKPOINTS, self.note)
            self._number, self._saved = self._newest()
            self._metrics = files.enter_context(append(directory / METRICS))
            self._rewind()
            self._events = Events(directory, self.note, loggers)
            files.callback(self._events.close)
            self._files = files.pop_all()

    def _newest(self) -> tuple[int, Saved | None]:
        """Number of the stage to continue and its checkpoint; -1 and None if there is none."""
        checkpoint = self._checkpoints.newest()
        if checkpoint is None:
            return -1, None
        saved = _read(checkpoint)
        if saved.run != self._run:
            raise TsbenchError(f"{checkpoint.path} is a checkpoint of another run")
        return checkpoint.stage, saved

    def _rewind(self) -> None:
        """Cuts the metrics back to the newest checkpoint."""
        path, size = self.directory / METRICS, self._saved.sizes[METRICS] if self._saved else 0
        if self._metrics.tell() < size:
            raise TsbenchError(f"{path} has been cut since the last checkpoint")
        lost = read_file(path, MAX_METRICS, "metrics")[size:].count(b"\n")
        self._metrics.truncate(size)
        self._metrics.seek(0, os.SEEK_END)
        if self._saved:
            stage = self._saved.stages[-1]
            self.note(f"resumed: {stage.name} goes on at {stage.steps:,} steps")
        if lost:
            self.note(f"{lost} iterations after the last checkpoint are done again")

    def close(self) -> None:
        self._files.close()

    def note(self, line: str) -> None:
        """Shows the user a line, and adds it to the log."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        self._log.write(f"{time.perf_counter() - self._began:10.1f} s  {line}\n".encode())
        self._log.flush()

    def stop(self, signal: int) -> None:
        """Asks the run to stop once the current iteration is done and saved.

        Raises:
            Stopped: immediately, if no iteration is running or if the run was asked before.
        """
        if self._stopped_by is not None or not self._learning:
            raise Stopped(signal)
        self._stopped_by = signal

    @contextmanager
    def stage(self, name: str, steps: int) -> Iterator[Monitor]:
        """A stage of the method, with its progress bar.

        Args:
            name: the stage's name, such as "plan" or "imitate".
            steps: environment steps that the stage may use.

        Raises:
            TsbenchError: the name cannot be that of a checkpoint, or there are too many stages.
        """
        number, learner = len(self.stages), None
        if not re.fullmatch(r"[A-Za-z0-9_]+", name):
            raise TsbenchError(f"a stage has a name of letters, digits and _, not {quoted(name)}")
        if number == MOST_STAGES:
            raise TsbenchError(f"a run has at most {MOST_STAGES} stages")
        stage = Stage(name, steps)
        if self._saved and number <= self._number:
            stage = self._saved.stages[number]
            checkpoint = self._checkpoints.newest(number)
            learner = _read(checkpoint).learner if checkpoint else None
        self.stages.append(stage)
        # Whether it was finished when the run was interrupted; one may end below its budget.
        if number < self._number or stage.steps >= stage.budget:
            yield Finished(learner)
            return
        stage.interruptions += learner is not None
        self._saved_at = time.perf_counter()
        with _Display(self._console, stage) as display:
            monitor = RunMonitor(self, stage, display, learner)
            yield monitor
            stage.seconds = time.perf_counter() - monitor.began
        self._learning = False
        self.note(f"{name}: {stage.steps:,} steps in {duration(stage.seconds)}{display.figures}")
        for kind, count in stage.warnings.items():
            self.note(f"{name}: mujoco warned {count:,} times of {kind}")

    def record(self, stage: Stage, metrics: Mapping[str, float]) -> None:
        """Appends an iteration's figures to `metrics.jsonl`, and hands them to the loggers."""
        row = {"stage": stage.name, "steps": stage.steps, "seconds": round(stage.seconds, 3)}
        row |= metrics
        self._metrics.write((json.dumps(row) + "\n").encode())
        self._metrics.flush()
        self._events.add(row)

    def keep(self, stage: Stage, snapshot: Callable[[], Snapshot]) -> None:
        """Saves a checkpoint after each interval, at the stage's end and before a stop.

        Raises:
            Stopped: a signal has arrived.
        """
        self._learning = True
        due = time.perf_counter() - self._saved_at >= self._interval
        if due or stage.steps >= stage.budget or self._stopped_by is not None:
            os.fsync(self._metrics.fileno())
            saved = Saved(
                run=self._run,
                stages=self.stages,
                sizes={METRICS: self._metrics.tell()},
                learner=dict(snapshot()),
            )
            number = len(self.stages) - 1
            self._checkpoints.save(number, stage.name, stage.steps, asdict(saved))
            self._saved_at = time.perf_counter()
        if self._stopped_by is not None:
            raise Stopped(self._stopped_by)


def _read(checkpoint: Checkpoint) -> Saved:
    try:
        saved: Saved = typed(Saved, checkpoint.content, "")
        if len(saved.stages) != checkpoint.stage + 1 or saved.sizes.keys() != {METRICS}:
            raise TsbenchError("it lacks stages or records")
    except TsbenchError as error:
        raise TsbenchError(f"damaged checkpoint {checkpoint.path}: {error}") from None
    return saved


class _Display:
    """Shows a progress bar on a terminal, and a line at intervals elsewhere."""

    def __init__(self, console: Console, stage: Stage) -> None:
        self._console = console
        self._bar: Progress | None = None
        self.figures = ""  # the text last shown
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
        """Shows the stage's progress; `reward` is the learner's mean return, None if unknown."""
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
