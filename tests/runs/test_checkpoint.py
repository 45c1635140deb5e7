"""Checkpoints: a snapshot survives saving and loading unchanged, and damage is detected."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tsbench.core.files import write_whole
from tsbench.runs.checkpoint import Checkpoints, decode, encode

DTYPES = ("float32", "float64", "int64", "uint8", "bool")
SHAPES = arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)
ARRAYS = st.sampled_from(DTYPES).flatmap(lambda dtype: arrays.arrays(dtype, SHAPES))
PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
NAMES = st.text("abc_.0", min_size=1)
SNAPSHOTS = st.dictionaries(
    NAMES,
    st.recursive(
        PLAIN | st.lists(PLAIN) | ARRAYS, lambda inner: st.dictionaries(NAMES, inner), max_leaves=10
    ),
)


def same(one: Any, two: Any) -> bool:
    if isinstance(one, np.ndarray):
        equal = (one.dtype, one.shape, one.tobytes()) == (two.dtype, two.shape, two.tobytes())
        return isinstance(two, np.ndarray) and equal
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(
            same(value, two[name]) for name, value in one.items()
        )
    return type(one) is type(two) and one == two


@given(SNAPSHOTS)
def test_to_the_last_bit(content: dict[str, Any]) -> None:
    assert same(content, decode(encode(content)))


def test_a_view_of_other_memory_and_numbers_beyond_64_bits() -> None:
    state = np.random.default_rng(0).bit_generator.state
    assert state["state"]["state"] > 2**64
    grid = np.arange(12.0).reshape(3, 4).T
    again = decode(encode({"rng": state, "grid": grid, "rate": 1e-3 / 1.5**7}))
    assert again["rng"] == state
    assert again["rate"] == 1e-3 / 1.5**7
    np.testing.assert_array_equal(again["grid"], grid)


@given(st.binary(max_size=300))
def test_rubbish_is_told_from_a_checkpoint(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        decode(data)


@settings(max_examples=50)
@given(data=st.data())
def test_one_changed_or_missing_byte_is_noticed(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("damage")
    said: list[str] = []
    checkpoints = Checkpoints(folder, said.append)
    for steps in (1, 2):
        checkpoints.save(0, "plan", steps, {"steps": steps, "values": np.arange(3.0)})
    newest = checkpoints.newest()
    assert newest is not None
    content = bytearray(newest.path.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[place] ^= data.draw(st.integers(1, 255))
    else:
        del content[place:]
    newest.path.write_bytes(content)
    assert not said
    before = checkpoints.newest()
    assert before is not None
    assert before.content["steps"] == 1
    assert len(said) == 1
    assert said[0].startswith(f"damaged checkpoint {newest.path} (")
    assert "\n" not in said[0]


def test_the_last_two_of_each_stage_are_kept(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path / "checkpoints", pytest.fail)
    assert checkpoints.newest() is None
    for stage, name in enumerate(("plan", "imitate")):
        for steps in (5, 10, 100):
            checkpoints.save(stage, name, steps, {"steps": steps})
    kept = [checkpoint.name for checkpoint in sorted((tmp_path / "checkpoints").iterdir())]
    assert [name.rpartition("-")[0] for name in kept] == [
        "00-plan-000000000010",
        "00-plan-000000000100",
        "01-imitate-000000000010",
        "01-imitate-000000000100",
    ]
    newest, planned = checkpoints.newest(), checkpoints.newest(0)
    assert newest is not None
    assert planned is not None
    assert (newest.stage, newest.name, newest.steps) == (1, "imitate", 100)
    assert (planned.stage, planned.name, planned.content) == (0, "plan", {"steps": 100})
    assert checkpoints.newest(2) is None


def test_another_format_is_refused() -> None:
    other = encode({}).replace(b'\\"format\\": 1', b'\\"format\\": 2')
    with pytest.raises(ValueError, match="its format is 2, not 1"):
        decode(other)


def test_a_name_that_is_no_checkpoint_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.safetensors").write_text("precious")
    checkpoints = Checkpoints(tmp_path, pytest.fail)
    assert checkpoints.newest() is None
    checkpoints.save(0, "plan", 1, {})
    assert (tmp_path / "notes.safetensors").read_text() == "precious"


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "kept.json"
    write_whole(path, b"old")

    def refuse(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", refuse)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_whole(path, json.dumps({"new": 1}).encode())
    assert caught.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["kept.json"]
