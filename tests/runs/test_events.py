"""What loggers keep repeats the metrics, and no run depends on it."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.util.tensor_util import make_ndarray

from tsbench.cli import launch
from tsbench.core.errors import TsbenchError
from tsbench.runs import config, execute
from tsbench.runs.events import LOGGERS, Events

ROWS: list[dict[str, Any]] = [
    {"stage": stage, "steps": 10 * number, "seconds": 0.5 * number, "loss": number / 4, "std": 1.0}
    for stage in ("plan", "imitate")
    for number in range(1, 4)
]


def written(run: Path, rows: list[dict[str, Any]]) -> Path:
    """A run directory with these metrics."""
    (run / "metrics.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    return run


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
    events = Events(written(tmp_path, ROWS[:known]), pytest.fail)
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
    events = Events(written(tmp_path, rows), pytest.fail)
    events.close()
    assert read(tmp_path / "tensorboard")["plan/loss"] == [(0.5, 10, float("inf"))]


def test_a_run_goes_on_without_them(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """After its folder is removed, a run says so in one line and shows no error of a thread."""
    folder, told, hook = tmp_path / "tensorboard", list[str](), threading.excepthook
    events = Events(written(tmp_path, ROWS[:1]), told.append)
    shutil.rmtree(folder)
    for row in ROWS[1:]:
        events.add(row)
    events.close()
    (line,) = told
    assert line.startswith("tensorboard is not written any more: ")
    assert "No such file or directory" in line
    assert "\n" not in line
    assert capfd.readouterr() == ("", "")
    assert threading.excepthook == hook


def test_nowhere_to_write_from_the_start(tmp_path: Path) -> None:
    (tmp_path / "tensorboard").write_text("a file")
    told: list[str] = []
    events = Events(written(tmp_path, ROWS), told.append)
    events.add(ROWS[0])
    events.close()
    assert len(told) == 1
    assert "File exists" in told[0]


def test_errors_of_other_threads_are_not_kept(tmp_path: Path) -> None:
    seen: list[Any] = []
    before, threading.excepthook = threading.excepthook, seen.append
    try:
        events = Events(written(tmp_path, []), pytest.fail)

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
        Events(tmp_path, pytest.fail)
    assert "\n" not in str(caught.value)
    assert threading.excepthook == hook


def tags() -> dict[str, list[tuple[int, float]]]:
    return {
        f"{stage}/{name}": [(row["steps"], row[name]) for row in ROWS if row["stage"] == stage]
        for stage in ("plan", "imitate")
        for name in ("loss", "std")
    }


def begun(run: Path) -> Path:
    """A run directory with a configuration."""
    chosen = config.compose(["task=rocket_navigation", "method=monolithic", "budget=smoke"])
    content = yaml.safe_dump(asdict(chosen), sort_keys=False)
    (run / "config.yaml").write_text(f"# tsbench run task=rocket_navigation\n{content}")
    return run


def from_mlflow(uri: str) -> tuple[dict[str, list[tuple[int, float]]], dict[str, str], str]:
    """The figures, the parameters and the state of the one run of a store."""
    client = import_module("mlflow.tracking").MlflowClient(tracking_uri=uri)
    (experiment,) = [one for one in client.search_experiments() if one.name == "tsbench"]
    (run,) = client.search_runs([experiment.experiment_id])
    found = {
        tag: [(one.step, one.value) for one in client.get_metric_history(run.info.run_id, tag)]
        for tag in run.data.metrics
    }
    return found, run.data.params, run.info.status


@pytest.mark.parametrize("known", [0, 4])
def test_mlflow(known: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its local store has what the metrics have, once, also after a run was resumed."""
    pytest.importorskip("mlflow", reason="the extra mlflow is not installed")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    run = written(begun(tmp_path), ROWS[:known])
    Events(run, pytest.fail, ["mlflow"]).close()  # of before the interruption
    events = Events(run, pytest.fail, ["mlflow"])
    for row in ROWS[known:]:
        events.add(row)
    events.close()
    figures, about, state = from_mlflow((run / "mlflow").as_uri())
    assert figures == tags()
    assert about == {
        "task": "rocket_navigation", "method": "monolithic", "seed": "0", "budget": "smoke",
        "command": "tsbench run task=rocket_navigation",
    }  # fmt: skip
    assert state == "FINISHED"


def test_mlflow_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own variable names another store, which several runs share; more rows than fit into one
    call."""
    pytest.importorskip("mlflow", reason="the extra mlflow is not installed")
    (tmp_path / "run").mkdir()
    uri = (tmp_path / "store").as_uri()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    rows = [{"stage": "plan", "steps": i, "seconds": 0.5, "loss": i / 8} for i in range(1100)]
    Events(written(tmp_path / "run", rows), pytest.fail, ["mlflow"]).close()
    figures, about, _ = from_mlflow(uri)
    assert figures == {"plan/loss": [(row["steps"], row["loss"]) for row in rows]}
    assert about == {}
    assert not (tmp_path / "run" / "mlflow").exists()


def pieces(content: bytes) -> Iterator[bytes]:
    """The records of a .wandb file, which has LevelDB's format of logs after a header of 7 bytes:
    in blocks of 32 KiB, each piece after its checksum (4 bytes), length (2) and kind (1: whole, 2
    to 4: first, middle and last part)."""
    place, parts = 7, b""
    while place + 7 <= len(content):
        if 32768 - place % 32768 < 7:
            place += 32768 - place % 32768
            continue
        size, kind = int.from_bytes(content[place + 4 : place + 6], "little"), content[place + 6]
        parts += content[place + 7 : place + 7 + size]
        place += 7 + size
        if kind in (1, 4):
            yield parts
            parts = b""


def whole(file: Path) -> list[Any]:
    """The records of a .wandb file. W&B's own process may write the last of them, which says that
    the run has ended, after `finish` has returned."""
    made = import_module("wandb.proto.wandb_internal_pb2").Record.FromString
    latest = time.monotonic() + 60.0
    while True:
        records = [made(data) for data in pieces(file.read_bytes())]
        if records and records[-1].HasField("exit"):
            return records
        assert time.monotonic() < latest, "the run does not end"
        time.sleep(0.05)


def from_wandb(run: Path) -> tuple[dict[str, list[tuple[int, float]]], dict[str, Any]]:
    """The figures and the configuration of the one offline run in a run directory."""
    (file,) = run.glob("wandb/offline-run-*/run-*.wandb")
    figures: dict[str, list[tuple[int, float]]] = {}
    about: dict[str, Any] = {}
    for record in whole(file):
        if record.HasField("run"):
            about |= {one.key: json.loads(one.value_json) for one in record.run.config.update}
        row = {
            one.key or "/".join(one.nested_key): json.loads(one.value_json)
            for one in record.history.item
        }
        for tag, value in row.items():
            stage, _, name = tag.partition("/")
            if name and name not in ("steps", "seconds"):
                figures.setdefault(tag, []).append((row[f"{stage}/steps"], value))
    return figures, about


@pytest.mark.parametrize("known", [0, 4])
def test_wandb_offline(known: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One offline run, which `wandb sync` can send; nothing on the terminal, no connection."""
    pytest.importorskip("wandb", reason="the extra wandb is not installed")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    run = written(begun(tmp_path), ROWS[:known])
    Events(run, pytest.fail, ["wandb"]).close()
    events = Events(run, pytest.fail, ["wandb"])
    for row in ROWS[known:]:
        events.add(row)
    events.close()
    figures, about = from_wandb(run)
    assert figures == tags()
    assert about["method"] == "monolithic"
    assert about["command"] == "tsbench run task=rocket_navigation"


def test_one_logger_fails_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        def __init__(self, run: Path) -> None:
            pass

        def add(self, *_: Any) -> None:
            raise RuntimeError("the server\nis gone")

        def close(self) -> None:
            raise RuntimeError("twice")

    told: list[str] = []
    monkeypatch.setitem(LOGGERS, "mlflow", (Broken, "json"))
    events = Events(written(tmp_path, ROWS), told.append, ["mlflow", "tensorboard"])
    events.close()
    assert told == ["mlflow is not written any more: the server is gone"]
    assert read(tmp_path / "tensorboard").keys() == tags().keys()


@pytest.mark.parametrize(
    ("loggers", "line"),
    [
        ("[tensorboar]", "unknown logger 'tensorboar'; allowed: mlflow, tensorboard, wandb"),
        ("[wandb]", r"wandb is missing: pip install 'tsbench\[wandb\]'"),
        ("wandb", "loggers must be a list, not 'wandb'"),
    ],
)
def test_loggers_are_checked_first(
    loggers: str, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(LOGGERS, "wandb", (LOGGERS["wandb"][0], "no_such_package"))
    with pytest.raises(TsbenchError, match=line):
        execute.prepare(config.compose(["task=rocket_navigation", f"loggers={loggers}"]))


def test_loggers_are_no_part_of_a_run() -> None:
    """The same run with other loggers has the same name, identity and results."""
    words = ["task=rocket_navigation", "budget=smoke"]
    chosen = [config.compose([*words, f"loggers={some}"]) for some in ("[]", "[tensorboard]")]
    assert chosen[0].identity == chosen[1].identity
    places = {
        launch.directory(chosen[0], [*words, "loggers=[]"]),
        launch.directory(chosen[1], words),
    }
    assert len(places) == 1
