"""What other programs show of a run while it trains, made from its `metrics.jsonl`.

TensorBoard by default; Weights & Biases and MLflow by choice (`loggers=[tensorboard,wandb]`).
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from tensorboard.summary import Writer

from tsbench.core.errors import TsbenchError, unknown
from tsbench.runs.directory import EVENTS, METRICS, RunDirectory, read_metrics

FILES = "events.out.tfevents.*"  # the file names of TensorBoard's writer
PROJECT = "tsbench"  # of Weights & Biases and MLflow, unless their own variables say otherwise
BATCH = 500  # figures that are sent to MLflow at once; it takes 1,000 at most
_PLACE = ("stage", "steps", "seconds")  # keys of a row that are no figures
# Raised by a row of another format.
_DAMAGED = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)


class Logger(Protocol):
    """One program's way of keeping figures. What it raises ends its use, not the run: it is then
    closed and dropped.

    A logger is made with the run directory, and keeps there what it keeps on this machine.
    """

    def add(self, stage: str, steps: int, seconds: float, figures: Mapping[str, float]) -> None:
        """Keeps the figures of an iteration under the tags STAGE/NAME.

        Args:
            stage: the stage's name.
            steps: environment steps of the stage so far.
            seconds: training time of the stage so far.
            figures: by name.
        """

    def close(self) -> None:
        """Writes what remains."""


class TensorBoard:
    """Events in the folder `tensorboard`. The time of an event is the training time of its stage
    in seconds."""

    def __init__(self, run: Path) -> None:
        self._error: BaseException | None = None
        folder = run / EVENTS
        folder.mkdir(exist_ok=True)
        for path in folder.glob(FILES):
            path.unlink()
        # TensorBoard writes in its own thread, whose errors Python would print on the terminal.
        self._hook = threading.excepthook
        threading.excepthook = self._noticed
        try:
            self._writer = Writer(str(folder))
        except BaseException:
            threading.excepthook = self._hook
            raise

    def add(self, stage: str, steps: int, seconds: float, figures: Mapping[str, float]) -> None:
        with np.errstate(over="ignore"):  # float32 cannot hold every figure
            for name, value in figures.items():
                self._writer.add_scalar(f"{stage}/{name}", value, steps, wall_time=seconds)
        self._do(self._writer.flush)

    def close(self) -> None:
        try:
            self._do(self._writer.close)
        finally:
            if threading.excepthook == self._noticed:
                threading.excepthook = self._hook

    def _do(self, what: Callable[[], object]) -> None:
        """Does something with the writer, if its thread still runs; raises the thread's error."""
        if self._error is None:
            what()
        if self._error is not None:
            raise self._error

    def _noticed(self, failure: threading.ExceptHookArgs) -> None:
        """Keeps an error of TensorBoard's thread; passes all others to the previous hook."""
        if type(failure.thread).__module__.partition(".")[0] == "tensorboard":
            self._error = failure.exc_value
        else:
            self._hook(failure)


class WeightsAndBiases:
    """An offline run in the folder `wandb`, which `wandb sync` sends; with WANDB_MODE=online, a run
    on the server."""

    def __init__(self, run: Path) -> None:
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        wandb, mode = import_module("wandb"), os.environ.get("WANDB_MODE", "offline")
        if mode == "offline":
            shutil.rmtree(run / "wandb", ignore_errors=True)
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            name=_name(run),
            config=_about(run),
            dir=str(run),
            mode=mode,
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off", disable_git=True),
        )
        self._known: set[str] = set()

    def add(self, stage: str, steps: int, seconds: float, figures: Mapping[str, float]) -> None:
        if stage not in self._known:  # every stage counts its own steps
            self._known.add(stage)
            self._run.define_metric(f"{stage}/*", step_metric=f"{stage}/steps")
        row = {"steps": steps, "seconds": seconds, **figures}
        self._run.log({f"{stage}/{name}": value for name, value in row.items()})

    def close(self) -> None:
        self._run.finish()


class MLflow:
    """A local store in the folder `mlflow`; with MLFLOW_TRACKING_URI, a run there."""

    def __init__(self, run: Path) -> None:
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # else refused as an old format
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        self._entities = import_module("mlflow.entities")
        place = os.environ.get("MLFLOW_TRACKING_URI")
        if place is None:
            for path in (run / "mlflow").glob("[!.]*"):  # within a process MLflow knows the store
                shutil.rmtree(path)
            place = (run / "mlflow").absolute().as_uri()
        self._client = import_module("mlflow.tracking").MlflowClient(tracking_uri=place)
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        known = self._client.get_experiment_by_name(name)
        experiment = known.experiment_id if known else self._client.create_experiment(name)
        self._id = self._client.create_run(experiment, run_name=_name(run)).info.run_id
        about = [self._entities.Param(name, str(value)) for name, value in _about(run).items()]
        self._client.log_batch(self._id, params=about)
        self._held: list[Any] = []

    def add(self, stage: str, steps: int, seconds: float, figures: Mapping[str, float]) -> None:
        self._held += [
            self._entities.Metric(f"{stage}/{name}", value, int(1000 * seconds), steps)
            for name, value in figures.items()
        ]
        if len(self._held) >= BATCH:
            self._send()

    def close(self) -> None:
        self._send()
        self._client.set_terminated(self._id)

    def _send(self) -> None:
        while self._held:
            self._client.log_batch(self._id, metrics=self._held[:BATCH])
            del self._held[:BATCH]


def _name(run: Path) -> str:
    """The last three parts of a run directory's path: by default task, method, and the rest."""
    return "/".join(run.absolute().parts[-3:])


def _about(run: Path) -> dict[str, Any]:
    """What the run is, in a few words; nothing where it has no configuration."""
    directory = RunDirectory(run)
    if not directory.begun:
        return {}
    config = directory.config()
    return {
        "task": config.task.name,
        "method": config.method["name"],
        "seed": config.seed,
        "budget": config.budget,
        "command": directory.command,
    }


# The loggers, and the packages that they need.
LOGGERS: dict[str, tuple[Callable[[Path], Logger], str]] = {
    "tensorboard": (TensorBoard, "tensorboard"),
    "wandb": (WeightsAndBiases, "wandb"),
    "mlflow": (MLflow, "mlflow"),
}


def check(loggers: Sequence[str]) -> None:
    """Checks, before a run begins, that its loggers can be used.

    Raises:
        TsbenchError: a logger is unknown or not installed.
    """
    for name in loggers:
        if name not in LOGGERS:
            raise unknown("logger", name, LOGGERS)
        if find_spec(LOGGERS[name][1]) is None:
            raise TsbenchError(f"{name} is missing: pip install 'tsbench[{name}]'")


class Events:
    """Hands the figures of a run's iterations to its loggers.

    The metrics hold all of these figures, so no run depends on its loggers: a resumed run makes
    what they keep again, and a run that cannot use one continues without it.
    """

    def __init__(
        self,
        run: Path,
        failed: Callable[[str], None],
        loggers: Sequence[str] = ("tensorboard",),
    ) -> None:
        """
        Args:
            run: the run directory, with the rows so far in its `metrics.jsonl`.
            failed: takes one line that says why a logger cannot be used; called once for each.
            loggers: names in `LOGGERS`.

        Raises:
            TsbenchError: the metrics are damaged.
        """
        self._failed = failed
        self._loggers: dict[str, Logger] = {}
        for name in loggers:
            try:
                self._loggers[name] = LOGGERS[name][0](run)
            except Exception as error:  # other libraries raise anything
                self._tell(name, error)
        path = run / METRICS
        try:
            for row in read_metrics(path):
                self.add(row)
        except TsbenchError:
            self.close()
            raise
        except _DAMAGED as error:
            self.close()
            raise TsbenchError(f"damaged metrics {path}: {error}") from None

    def add(self, row: Mapping[str, Any]) -> None:
        """Adds a row of the metrics.

        Raises:
            ValueError, KeyError, TypeError, AttributeError, OverflowError: it is of another format.
        """
        figures = {name: float(value) for name, value in row.items() if name not in _PLACE}
        place = str(row["stage"]), int(row["steps"]), float(row["seconds"])
        self._each(lambda logger: logger.add(*place, figures))

    def close(self) -> None:
        """Writes what remains, and ends the loggers' threads and processes."""
        self._each(lambda logger: logger.close())
        self._loggers.clear()

    def _each(self, do: Callable[[Logger], None]) -> None:
        for name, logger in list(self._loggers.items()):
            try:
                do(logger)
            except Exception as error:  # other libraries raise anything
                del self._loggers[name]
                with suppress(Exception):
                    logger.close()
                self._tell(name, error)

    def _tell(self, name: str, error: Exception) -> None:
        reason = " ".join(str(error).split())
        self._failed(f"{name} is not written any more: {reason}")
