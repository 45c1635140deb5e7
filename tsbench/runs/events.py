"""TensorBoard's events of a run, made from its `metrics.jsonl`."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from tensorboard.summary import Writer

from tsbench.core.errors import TsbenchError
from tsbench.runs.directory import read_metrics

FILES = "events.out.tfevents.*"  # the file names of TensorBoard's writer
_PLACE = ("stage", "steps", "seconds")  # keys of a row that are no figures
# Raised by a row of another format.
_DAMAGED = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)


class Events:
    """Writes the figures of a run's iterations for TensorBoard, under the tags STAGE/NAME.

    The metrics hold all of these figures, so no run depends on its events: a resumed run makes them
    again, and a run that cannot write them continues without them. The time of an event is the
    training time of its stage in seconds.
    """

    def __init__(self, folder: Path, metrics: Path, failed: Callable[[str], None]) -> None:
        """
        Args:
            folder: the folder of the event files; existing event files are replaced.
            metrics: the run's `metrics.jsonl`, with the rows so far.
            failed: takes one line that says why the events cannot be written; called once.

        Raises:
            TsbenchError: the metrics are damaged.
        """
        self._failed = failed
        self._error: BaseException | None = None
        self._writer: Writer | None = None
        # TensorBoard writes in its own thread, whose errors Python would print on the terminal.
        self._hook = threading.excepthook
        threading.excepthook = self._noticed
        try:
            folder.mkdir(exist_ok=True)
            for path in folder.glob(FILES):
                path.unlink()
            self._writer = Writer(str(folder))
        except (OSError, RuntimeError) as error:  # RuntimeError: no thread can be started
            self._error = error
        try:
            for row in read_metrics(metrics):
                self.add(row)
        except TsbenchError:
            self.close()
            raise
        except _DAMAGED as error:
            self.close()
            raise TsbenchError(f"damaged metrics {metrics}: {error}") from None
        self._tell()

    def add(self, row: Mapping[str, Any]) -> None:
        """Adds a row of the metrics."""
        if self._writer is None:
            return
        try:
            with np.errstate(over="ignore"):  # float32 cannot hold every figure
                for name, value in row.items():
                    if name not in _PLACE:
                        tag = f"{row['stage']}/{name}"
                        self._writer.add_scalar(tag, value, row["steps"], wall_time=row["seconds"])
            self._writer.flush()
        except OSError as error:
            self._error = error
        self._tell()

    def close(self) -> None:
        """Writes the remaining events and ends TensorBoard's thread."""
        if self._writer is not None:
            try:
                self._writer.close()
            except OSError as error:
                self._error = error
            self._tell()
            self._writer = None
        if threading.excepthook == self._noticed:
            threading.excepthook = self._hook

    def _noticed(self, failure: threading.ExceptHookArgs) -> None:
        """Keeps an error of TensorBoard's thread; passes all others to the previous hook."""
        if type(failure.thread).__module__.partition(".")[0] == "tensorboard":
            self._error = failure.exc_value
        else:
            self._hook(failure)

    def _tell(self) -> None:
        if self._error is not None:
            reason = " ".join(str(self._error).split())
            self._failed(f"TensorBoard's events are not written any more: {reason}")
            self._error = self._writer = None
