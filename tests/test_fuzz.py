"""Random input of every kind: it is valid or refused in one line, and stays unchanged."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.files import write_json
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.policy import Policy, PolicyInfo
from tsbench.evaluation import words
from tsbench.evaluation.evaluate import check_fit
from tsbench.runs import config, execute
from tsbench.runs.checkpoint import Checkpoints
from tsbench.runs.directory import Record, RunDirectory

NAME = "rocket_navigation"

KEYS = st.sampled_from([
    "task", "method", "budget", "seed", "threads", "directory", "checkpoint", "method.finetune",
    "method.explore", "method.imitation", "task.constants.distance", "task.training.plan.clip",
    "task.training.imitate.hidden", "task.budgets.smoke.plan", "task.budgets.smoke", "task.name",
    "hydra.run.dir", "resume", "", "~seed", "+seed", "++task.x.y", "task@x", "seed:",
])  # fmt: skip
VALUES = (
    st.sampled_from([
        NAME, "laikago_walk", "monolithic", "smoke", "null", "true", "[]", "{}", "[1,2]", "{a:1}",
        "1e400", "nan", "-0", "''", '"', "${seed}", "${oc.env:HOME}", "???", "a,b", "range(3)", "=",
        "interval(0,1)", "glob(*)", "\\", "\n", "../..", "1_000", "0x10", "é", "[[", "a b",
    ])
    | st.integers(-(2**70), 2**70).map(str)
    | st.floats().map(str)
    | st.text(max_size=8)
)  # fmt: skip
WORDS = st.lists(st.builds("{}={}".format, KEYS, VALUES) | st.text(max_size=12), max_size=4)

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


def right_or_refused(call: Callable[[], Any]) -> None:
    """Anything but a TsbenchError of one line fails the test."""
    line = "fine"
    try:
        call()
    except TsbenchError as error:
        line = str(error)
    assert line
    assert "\n" not in line


@settings(max_examples=50)
@given(WORDS)
def test_words(words: list[str]) -> None:
    right_or_refused(lambda: execute.prepare(config.compose([f"task={NAME}", *words])))


@pytest.fixture(scope="session")
def intact(
    tmp_path_factory: pytest.TempPathFactory,
    naive_plan: Callable[[str], Plan],
    naive_reference: Callable[[str], ReferenceMotion],
    invented_record: Callable[[str], Record],
) -> Path:
    """A run directory with a file of every kind, which no test may change."""
    folder = tmp_path_factory.mktemp("intact")
    task, rng = tasks.make(NAME), np.random.default_rng(0)
    naive_plan(NAME).save(folder / "plan.npz")
    naive_reference(NAME).save(folder / "reference.npz")
    layers = (task.observation_size, 4, task.action_size)
    Policy(
        info=PolicyInfo(NAME, task.version, "physics", "test", "elu", layers),
        mean=np.zeros(layers[0], np.float32),
        scale=np.ones(layers[0], np.float32),
        weights=tuple(
            rng.normal(size=shape).astype(np.float32) for shape in ((4, layers[0]), (layers[2], 4))
        ),
        biases=(np.zeros(4, np.float32), np.zeros(layers[2], np.float32)),
    ).save(folder)
    chosen = config.compose([f"task={NAME}", "budget=smoke"])
    (folder / "config.yaml").write_text(yaml.safe_dump(asdict(chosen)))
    write_json(folder / "score.json", invented_record(NAME).as_dict())
    Checkpoints(folder / "checkpoints", pytest.fail).save(0, "plan", 1, {"values": np.ones(3)})
    return folder


def read_score(folder: Path) -> None:
    content = RunDirectory(folder).record()
    assert content.title
    assert words.summary(content.score, tasks.make(content.task))


def read_policy(folder: Path) -> None:
    policy = RunDirectory(folder).policy()
    task = RunDirectory(folder).task(policy.info.task)
    right_or_refused(lambda: check_fit(policy, task))
    assert np.isfinite(policy(np.zeros((2, policy.info.layers[0])))).all()


READERS: dict[str, Callable[[Path], Any]] = {
    "plan.npz": lambda folder: Plan.load(folder / "plan.npz"),
    "reference.npz": lambda folder: ReferenceMotion.load(folder / "reference.npz"),
    "policy.safetensors": read_policy,
    "policy.json": read_policy,
    "config.yaml": lambda folder: execute.prepare(RunDirectory(folder).config()),
    "score.json": read_score,
}


@pytest.mark.parametrize("name", READERS)
def test_intact_files_are_read(name: str, intact: Path) -> None:
    READERS[name](intact)


def damaged(data: st.DataObject, content: bytes) -> bytes:
    """The content with some bytes replaced, removed or inserted."""
    start = data.draw(st.integers(0, len(content)))
    end = data.draw(st.integers(start, min(start + 40, len(content))) | st.just(len(content)))
    return content[:start] + data.draw(st.binary(max_size=8)) + content[end:]


@settings(max_examples=30)
@given(data=st.data())
@pytest.mark.parametrize("name", READERS)
def test_files_with_damage(
    name: str, data: st.DataObject, intact: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    for path in intact.iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    content = damaged(data, (intact / name).read_bytes())
    (folder / name).write_bytes(content)
    right_or_refused(lambda: READERS[name](folder))
    assert (folder / name).read_bytes() == content


def altered(data: st.DataObject, value: Any) -> Any:
    """The value with another one in one place of its nested mappings and lists."""
    if isinstance(value, dict) and value and data.draw(st.booleans()):
        key = data.draw(st.sampled_from(sorted(value)))
        if data.draw(st.integers(0, 5)) == 0:
            return {name: inner for name, inner in value.items() if name != key}
        return {**value, key: altered(data, value[key])}
    if isinstance(value, list) and value and data.draw(st.booleans()):
        index = data.draw(st.integers(0, len(value) - 1))
        return [*value[:index], altered(data, value[index]), *value[index + 1 :]]
    return data.draw(JSON)


@settings(max_examples=40)
@given(data=st.data())
@pytest.mark.parametrize("name", ["policy.json", "config.yaml", "score.json"])
def test_files_with_something_else_in_them(
    name: str, data: st.DataObject, intact: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("altered")
    for path in intact.iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    content = yaml.safe_load((intact / name).read_text())
    dump = yaml.safe_dump if name.endswith("yaml") else json.dumps
    (folder / name).write_text(dump(altered(data, content)), encoding="utf-8")
    right_or_refused(lambda: READERS[name](folder))
