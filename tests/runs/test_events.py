"""TensorBoard's events: they repeat the metrics, and no run depends on them."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.util.tensor_util import make_ndarray

from tsbench.core.errors import TsbenchError
from tsbench.runs.events import Events

ROWS: list[dict[str, Any]] = [
    {"stage": stage, "steps": 10 * number, "seconds": 0.5 * number, "loss": number / 4, "std": 1.0}
    for stage in ("plan", "imitate")
    for number in range(1, 4)
]


def written(path: Path, rows: list[dict[str, Any]]) -> Path:
    path.write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    return path


def read(folder: Path) -> dict[str, list[tuple[float, int, float]]]:
    events = EventAccumulator(str(folder))
    events.Reload()
    return {
        tag: [
            (event.wall_time, event.step, make_ndarray(event.tensor_proto).item())
            for event in events.Tensors(tag)
        ]
        for tag in events.Tags()["tensors"]
    }


@pytest.mark.parametrize("known", [0, 4, 6])
def test_rows_of_before_and_of_now(known: int, tmp_path: Path) -> None:
    folder = tmp_path / "tensorboard"
    folder.mkdir()
    (folder / "events.out.tfevents.1.before").write_text("of an interrupted run")
    (folder / "notes").write_text("precious")
    events = Events(folder, written(tmp_path / "metrics.jsonl", ROWS[:known]), pytest.fail)
    for row in ROWS[known:]:
        events.add(row)
    expected = {
        f"{stage}/{name}": [
            (row["seconds"], row["steps"], row[name]) for row in ROWS if row["stage"] == stage
        ]
        for stage in ("plan", "imitate")
        for name in ("loss", "std")
    }
    assert read(folder) == expected  # before `close`: users look at them while the run trains
    events.close()
    assert read(folder) == expected
    assert len(list(folder.iterdir())) == 2
    assert (folder / "notes").read_text() == "precious"


def test_a_number_beyond_float32(tmp_path: Path) -> None:
    rows = [{**ROWS[0], "loss": 1e300}]
    events = Events(tmp_path / "events", written(tmp_path / "metrics.jsonl", rows), pytest.fail)
    events.close()
    assert read(tmp_path / "events")["plan/loss"] == [(0.5, 10, float("inf"))]


def test_a_run_goes_on_without_them(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """After its folder is removed, a run says so in one line and shows no error of a thread."""
    folder, told, hook = tmp_path / "tensorboard", list[str](), threading.excepthook
    events = Events(folder, written(tmp_path / "metrics.jsonl", ROWS[:1]), told.append)
    shutil.rmtree(folder)
    for row in ROWS[1:]:
        events.add(row)
    events.close()
    (line,) = told
    assert line.startswith("TensorBoard's events are not written any more: ")
    assert "No such file or directory" in line
    assert "\n" not in line
    assert capfd.readouterr() == ("", "")
    assert threading.excepthook == hook


def test_nowhere_to_write_from_the_start(tmp_path: Path) -> None:
    (tmp_path / "tensorboard").write_text("a file")
    told: list[str] = []
    metrics = written(tmp_path / "metrics.jsonl", ROWS)
    events = Events(tmp_path / "tensorboard", metrics, told.append)
    events.add(ROWS[0])
    events.close()
    assert len(told) == 1
    assert "File exists" in told[0]


def test_errors_of_other_threads_are_not_kept(tmp_path: Path) -> None:
    seen: list[Any] = []
    before, threading.excepthook = threading.excepthook, seen.append
    try:
        events = Events(tmp_path / "events", written(tmp_path / "m", []), pytest.fail)

        def fail() -> None:
            raise OSError("of somebody else")

        thread = threading.Thread(target=fail)
        thread.start()
        thread.join()
        events.close()
    finally:
        threading.excepthook = before
    assert [type(failure.exc_value) for failure in seen] == [OSError]


@pytest.mark.parametrize(
    "content",
    [
        b"{",
        b"[1]",
        b'{"loss": 1}',
        b'{"stage": "plan", "steps": 1, "seconds": 1, "loss": "much"}',
        b'{"stage": "plan", "steps": 1%s, "seconds": 1, "loss": 1}' % (b"0" * 400),
        b"\xff",
    ],
)
def test_damaged_metrics(content: bytes, tmp_path: Path) -> None:
    path, hook = tmp_path / "metrics.jsonl", threading.excepthook
    path.write_bytes(content + b"\n")
    with pytest.raises(TsbenchError, match=r"damaged metrics .*metrics\.jsonl: ") as caught:
        Events(tmp_path / "events", path, pytest.fail)
    assert "\n" not in str(caught.value)
    assert threading.excepthook == hook
