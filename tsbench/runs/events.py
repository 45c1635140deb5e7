"""TensorBoard's events of a run, made from its `metrics.jsonl`."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from tensorboard.summary import Writer

from tsbench.core.errors import TsbenchError

FILES = "events.out.tfevents.*"  # what TensorBoard's writer names its files
_PLACE = ("stage", "steps", "seconds")  # of a row: where it belongs
# What a row of another kind causes.
_DAMAGED = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)


class Events:
    """The figures of a run's iterations for TensorBoard, under the tags STAGE/NAME.

    All of them stand in the metrics too, so no run depends on its events: a resumed run makes them
    anew, and a run that cannot write them goes on without. An event's time is the training time of
    its stage.
    """

    def __init__(self, folder: Path, metrics: Path, failed: Callable[[str], None]) -> None:
        """
        Args:
            folder: of the event files; those that are there are replaced.
            metrics: the run's `metrics.jsonl`, with the rows so far.
            failed: is told, once and in one line, why the events cannot be written.

        Raises:
            TsbenchError: the metrics are damaged.
        """
        self._failed = failed
        self._error: BaseException | None = None
        self._writer: Writer | None = None
        # TensorBoard writes in a thread of its own. Python would print that thread's errors.
        self._hook = threading.excepthook
        threading.excepthook = self._noticed
        try:
            folder.mkdir(exist_ok=True)
            for path in folder.glob(FILES):
                path.unlink()
            self._writer = Writer(str(folder))
        except (OSError, RuntimeError) as error:  # the latter where no thread can be started
            self._error = error
        try:
            for line in metrics.read_text(encoding="utf-8").splitlines():
                self.add(json.loads(line))
        except _DAMAGED as error:
            self.close()
            raise TsbenchError(f"damaged metrics {metrics}: {error}") from None
        self._tell()

    def add(self, row: Mapping[str, Any]) -> None:
        """Adds a row of the metrics."""
        if self._writer is None:
            return
        try:
            with np.errstate(over="ignore"):  # of numbers that float32 cannot hold
                for name, value in row.items():
                    if name not in _PLACE:
                        tag = f"{row['stage']}/{name}"
                        self._writer.add_scalar(tag, value, row["steps"], wall_time=row["seconds"])
            self._writer.flush()
        except OSError as error:
            self._error = error
        self._tell()

    def close(self) -> None:
        """Writes what is left, and ends the thread."""
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
        """Keeps an error of TensorBoard's thread; leaves others to whoever had them before."""
        if type(failure.thread).__module__.partition(".")[0] == "tensorboard":
            self._error = failure.exc_value
        else:
            self._hook(failure)

    def _tell(self) -> None:
        if self._error is not None:
            reason = " ".join(str(self._error).split())
            self._failed(f"TensorBoard's events are not written any more: {reason}")
            self._error = self._writer = None
