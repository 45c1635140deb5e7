"""Plans and reference motions: files in and out, damage found, frames and audits."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tsbench import TsbenchError
from tsbench.core.motion import Audit, AuditItem, Plan, ReferenceMotion

FLOATS = st.floats(allow_nan=False, allow_infinity=False)
# All examples of a test share a folder: each example overwrites the file.
FILES = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def plan(steps: int = 30, width: int = 3) -> Plan:
    rng = np.random.default_rng(0)
    return Plan("walk", 1, 0.1, rng.normal(size=(steps + 1, width)), rng.normal(size=steps))


def reference(steps: int = 20) -> ReferenceMotion:
    rng = np.random.default_rng(0)
    n = steps + 1
    return ReferenceMotion(
        "walk", 1, 1 / 30, rng.normal(size=(n, 19)), rng.normal(size=(n, 18)),
        {"feet": rng.normal(size=(n, 4, 3)), "contacts": rng.uniform(size=(n, 4)) < 0.5},
    )  # fmt: skip


def same(first: Any, second: Any) -> bool:
    if type(first) is not type(second):
        return False
    for name in ("task", "task_version", "timestep"):
        a, b = getattr(first, name), getattr(second, name)
        if (type(a), a) != (type(b), b):
            return False
    return first.arrays.keys() == second.arrays.keys() and all(
        (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
        for a, b in ((first.arrays[name], second.arrays[name]) for name in first.arrays)
    )


# Round trips


@settings(FILES, max_examples=40)
@given(
    task=st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20),
    version=st.integers(1, 2**31),
    timestep=st.floats(1e-6, 1e6),
    steps=st.integers(1, 5),
    width=st.integers(1, 4),
    data=st.data(),
)
def test_a_plan_comes_back_exactly(
    tmp_path: Path, task: str, version: int, timestep: float, steps: int, width: int, data: Any
) -> None:
    states = data.draw(arrays(np.float64, (steps + 1, width), elements=FLOATS))
    rewards = data.draw(arrays(np.float64, (steps,), elements=FLOATS))
    original = Plan(task, version, timestep, states, rewards)
    original.save(tmp_path / "plan.npz")
    assert same(Plan.load(tmp_path / "plan.npz"), original)


@settings(FILES, max_examples=25)
@given(steps=st.integers(1, 4), feet=st.integers(0, 4), data=st.data())
def test_a_reference_comes_back_exactly(tmp_path: Path, steps: int, feet: int, data: Any) -> None:
    n = steps + 1

    def draw(*shape: int) -> np.ndarray:
        return np.asarray(data.draw(arrays(np.float64, shape, elements=FLOATS)))

    original = ReferenceMotion(
        "walk", 3, 0.02, draw(n, 7), draw(n, 6),
        {"feet": draw(n, feet, 3), "contacts": data.draw(arrays(np.bool_, (n, feet)))},
    )  # fmt: skip
    original.save(tmp_path / "reference.npz")
    assert same(ReferenceMotion.load(tmp_path / "reference.npz"), original)


def test_a_file_appears_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "plan.npz"
    first, second = plan(), plan(steps=7)
    first.save(path)
    second.save(str(path))  # a path may be text; an older file is replaced
    assert same(Plan.load(str(path)), second)
    assert [file.name for file in tmp_path.iterdir()] == ["plan.npz"]

    def full(file: Any, **_: Any) -> None:
        file.write(b"half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space left"):
        first.save(path)
    assert same(Plan.load(path), second)  # the older file is untouched


# Damage


def refused(kind: type[Plan] | type[ReferenceMotion], path: Path, *words: str) -> None:
    """Loading fails with one line that names the file."""
    with pytest.raises(TsbenchError) as caught:
        kind.load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 400 + len(str(path))
    for word in words:
        assert word in message


def test_a_missing_file(tmp_path: Path) -> None:
    refused(Plan, tmp_path / "plan.npz", "no plan ")
    refused(ReferenceMotion, tmp_path / "nowhere" / "reference.npz", "no reference motion ")
    refused(Plan, tmp_path)  # a directory


def test_every_truncation(tmp_path: Path) -> None:
    path = tmp_path / "plan.npz"
    plan(steps=5).save(path)
    content = path.read_bytes()
    for length in [*range(0, len(content), 41), len(content) - 1]:
        path.write_bytes(content[:length])
        refused(Plan, path, "damaged plan file")


@pytest.mark.parametrize("kind", [Plan, ReferenceMotion])
def test_flipped_bytes(tmp_path: Path, kind: type[Plan] | type[ReferenceMotion]) -> None:
    """Loading finds the damage, or the damaged bytes carry no data and the content is unchanged."""
    path = tmp_path / "file.npz"
    original = plan() if kind is Plan else reference()
    original.save(path)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    messages = []
    for _ in range(300):
        damaged = bytearray(content)
        for position in rng.integers(len(content), size=rng.integers(1, 4)):
            damaged[position] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            loaded = kind.load(path)
        except TsbenchError as error:
            messages.append(str(error))
        else:
            assert same(loaded, original)
    assert len(messages) > 150
    assert all(str(path) in message and "\n" not in message for message in messages)


@pytest.mark.parametrize(
    "content",
    [b"", b"\0", b"no plan at all", b"PK\x03\x04", b"PK\x05\x06" + bytes(18), b"\x93NUMPY\x01\x00"],
)
def test_what_is_no_archive(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "plan.npz"
    path.write_bytes(content)
    refused(Plan, path)


@settings(FILES, max_examples=60)
@given(content=st.binary(max_size=300))
def test_random_bytes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "plan.npz"
    path.write_bytes(content)
    refused(Plan, path)


def test_a_bare_array(tmp_path: Path) -> None:
    path = tmp_path / "plan.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    refused(Plan, path)


class Trap:
    """An object that runs code when it is unpickled."""

    sprung = False

    def __reduce__(self) -> tuple[Callable[..., None], tuple[()]]:
        return spring, ()


def spring() -> None:
    Trap.sprung = True


def test_no_code_is_run(tmp_path: Path) -> None:
    path = tmp_path / "plan.npz"
    content = asdict(plan()) | {"states": np.array([[Trap()]], dtype=object)}
    with path.open("wb") as file:
        np.savez(file, kind="plan", allow_pickle=True, **content)
    refused(Plan, path, "damaged plan file")
    path.write_bytes(pickle.dumps(Trap()))
    refused(Plan, path)
    assert not Trap.sprung


def rewritten(path: Path, **changes: Any) -> None:
    """Writes a plan's file with some arrays replaced; None removes an array."""
    content: dict[str, Any] = {"kind": "plan"} | asdict(plan()) | changes
    with path.open("wb") as file:
        np.savez(file, **{name: value for name, value in content.items() if value is not None})


def bad(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.flat[3] = value
    return array


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kind": "reference motion"}, ["is not a plan file", "reference motion"]),
        ({"kind": None}, ["is not a plan file", "unknown"]),
        ({"rewards": None}, ["missing or unknown rewards"]),
        ({"task": None, "extra": 1}, ["missing or unknown extra, task"]),
        ({"states": bad(plan().states, np.nan)}, ["states", "not finite"]),
        ({"rewards": bad(plan().rewards, np.inf)}, ["rewards", "not finite"]),
        ({"rewards": plan().rewards[:-1]}, ["31 states and 29 rewards do not match"]),
        ({"states": plan().states[:1], "rewards": np.zeros(0)}, ["1 states and 0 rewards"]),
        ({"states": plan().states[0]}, ["states must be an array of 2 dimensions"]),
        ({"states": 1.0}, ["states"]),
        ({"states": plan().states.astype(complex)}, ["states", "complex128"]),
        ({"states": plan().states.astype(np.float32)}, ["states", "float32"]),
        ({"states": np.full((31, 3), "a")}, ["states"]),
        ({"timestep": 0.0}, ["time step is 0.0, it must be positive"]),
        ({"timestep": -0.1}, ["time step"]),
        ({"timestep": np.nan}, ["time step"]),
        ({"timestep": "often"}, []),
        ({"timestep": np.ones(3)}, []),
        ({"task": 5}, ["task"]),
        ({"task": np.array(["walk", "trot"])}, ["task"]),
        ({"task_version": "one"}, ["task_version"]),
        ({"task_version": np.arange(2)}, ["task_version"]),
        ({"task_version": 1.5}, ["task_version"]),
    ],
)
def test_content_that_makes_no_plan(
    tmp_path: Path, changes: dict[str, Any], words: list[str]
) -> None:
    path = tmp_path / "plan.npz"
    rewritten(path)
    assert same(Plan.load(path), plan())
    rewritten(path, **changes)
    refused(Plan, path, *words)


@pytest.mark.parametrize(
    "change",
    [
        {"qvel": reference().qvel[:-1]},
        {"tracked": {"com": np.zeros((5, 3))}},
        {"tracked": {"feet": bad(reference().tracked["feet"], np.nan)}},
        {"tracked": {"feet": np.array(1.0)}},
        {"tracked": {"feet": [1.0] * 21}},
        {"tracked": {"contacts": reference().tracked["contacts"].astype(int)}},
    ],
)
def test_references_that_make_no_sense(change: dict[str, Any]) -> None:
    with pytest.raises(
        TsbenchError,
        match=f"^not a valid reference motion: .*{next(iter(change.get('tracked', change)))}",
    ):
        replace(reference(), **change)


def test_a_member_that_is_no_array(tmp_path: Path) -> None:
    path = tmp_path / "plan.npz"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("states.npy", b"no array")
        archive.writestr("kind", b"plan")
    path.write_bytes(buffer.getvalue())
    refused(Plan, path)


def test_an_array_that_claims_to_be_huge(tmp_path: Path) -> None:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d, 3), }" % 10**15
    header += b" " * (117 - len(header)) + b"\n"
    path = tmp_path / "plan.npz"
    with zipfile.ZipFile(path, "w") as archive:
        array = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        archive.writestr("states.npy", array)
    refused(Plan, path)


# Times and frames


def test_times() -> None:
    np.testing.assert_allclose(plan(steps=3).times, [0.0, 0.1, 0.2, 0.3])
    motion = reference(steps=6)
    assert motion.steps == 6
    assert motion.duration == pytest.approx(0.2)


def test_frames() -> None:
    """The nearest frame, despite the rounding of summed times; the last frame beyond the end."""
    motion = reference(steps=20)
    time, clock = 0.0, []
    for _ in range(25):
        clock.append(time)
        time += 1 / 30
    frames = motion.frame(np.array(clock))
    assert frames.tolist() == [*range(21), 20, 20, 20, 20]
    assert motion.frame(np.array([0.016, 0.017, 0.0])).tolist() == [0, 1, 0]


def test_audit() -> None:
    good, border = AuditItem("slip", 0.01, 0.03, "m"), AuditItem("speed", 5.0, 5.0, "m/s")
    bad_item = AuditItem("joint speed", 20.0, 12.8, "rad/s")
    assert Audit((good, border)).passed
    audit = Audit((good, bad_item, border))
    assert not audit.passed
    assert audit.failures == (bad_item,)
    assert str(good) == "slip: 0.01 m (at most 0.03) ok"
    assert str(bad_item) == "joint speed: 20 rad/s (at most 12.8) TOO MUCH"
    assert not AuditItem("speed", float("nan"), 5.0, "m/s").passed
