"""Entries and runs that somebody might make to break a reader, and what becomes of them.

    python tests/leaderboard/hostile.py entries     every entry of the corpus, through the verifier
    python tests/leaderboard/hostile.py runs        run directories, through the other verbs
    python tests/leaderboard/hostile.py fuzz N      N random changes of an entry's files

Each case makes one line of JSON: its name, whether it was accepted, the reader's line, CPU seconds,
and the most memory that the process had meanwhile. Nothing here judges: the tests do, and whoever
runs it by hand.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import shutil
import signal
import socket
import struct
import sys
import tempfile
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from tsbench import cli
from tsbench.core.errors import TsbenchError
from tsbench.core.files import encode_json
from tsbench.core.policy import encode_info
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.protocol import V1
from tsbench.leaderboard import submission, verify

BOARD = Path(__file__).parents[2] / "leaderboards"
PATIENCE = 60  # seconds after which a reader counts as hanging, on a machine with much to do
GIGABYTE = 2**30

Change = Callable[[Path], object]  # of the entry's or the run's directory


class HangError(Exception):
    """A reader has not come back."""


# Making entries


def intact(folder: Path) -> Path:
    """An entry made of the smallest kept run of seed 0 that has a plan and a roadmap, with every
    file that an entry may have."""
    runs = [path.parent for path in BOARD.glob("v1/*/*/seed0/roadmap.npz")]
    kept = min(runs, key=lambda run: sum(file.stat().st_size for file in run.iterdir()))
    run = folder / "run"
    shutil.copytree(kept, run)
    row = {"stage": "plan", "steps": 1, "seconds": 1.0, "episode_return": 1.0}
    (run / "metrics.jsonl").write_text(f"{json.dumps(row)}\n")
    described = submission.Described(
        "entry", ("A. Person",), "MIT", "https://example.org", "a PC", 0
    )
    packed = submission.pack([run], described, folder, V1, score=evaluate)
    return submission.place(packed, folder, V1, [run])


def signed(entry: Path, values: Any = None) -> None:
    """Writes the manifest so that its hashes are right, whatever it says."""
    path = entry / "manifest.json"
    values = json.loads(path.read_text()) if values is None else values
    for name in values["files"] if isinstance(values.get("files"), dict) else ():
        file = entry / name
        if ".." not in name and file.is_file() and not file.is_symlink():
            content = file.read_bytes()
            digest = hashlib.sha256(content).hexdigest()
            values["files"][name] = {"bytes": len(content), "sha256": digest}
    values["digest"] = ""
    blank = (json.dumps(values, indent=1) + "\n").encode()
    values["digest"] = hashlib.sha256(blank).hexdigest()
    path.write_text(json.dumps(values, indent=1) + "\n")


def replaced(name: str, before: str, after: str) -> Change:
    """A file with another text, where it is there."""

    def change(folder: Path) -> None:
        file = folder / name
        text = file.read_text()
        assert before in text, (name, before)
        file.write_text(text.replace(before, after, 1))

    return change


def written(name: str, content: bytes | Callable[[bytes], bytes]) -> Change:
    def change(folder: Path) -> None:
        file = folder / name
        before = file.read_bytes() if file.exists() else b""
        file.write_bytes(content if isinstance(content, bytes) else content(before))

    return change


# Kinds of files, each in the place of any file


def gone(file: Path) -> None:
    file.unlink()


def fifo(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def link_outside(file: Path) -> None:
    """To a file of the same content, so that only where it lies is wrong."""
    other = file.parents[3] / "outside"
    other.mkdir(exist_ok=True)
    file.rename(other / file.name)
    file.symlink_to(other / file.name)


def link_to_zeros(file: Path) -> None:
    file.unlink()
    file.symlink_to("/dev/zero")


def link_to_nothing(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.parent / "nothing")


def link_to_itself(file: Path) -> None:
    file.unlink()
    file.symlink_to(file)


def folder_there(file: Path) -> None:
    file.unlink()
    file.mkdir()


def bound_socket(file: Path) -> None:
    file.unlink()
    here = Path.cwd()
    os.chdir(file.parent)  # its path may be too long for a socket
    try:
        socket.socket(socket.AF_UNIX).bind(file.name)
    finally:
        os.chdir(here)


def sparse(file: Path) -> None:
    with file.open("r+b") as opened:
        opened.truncate(GIGABYTE)


def empty(file: Path) -> None:
    file.write_bytes(b"")


def noise(file: Path) -> None:
    file.write_bytes(np.random.default_rng(0).bytes(5000))


def half(file: Path) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])


KINDS = (
    gone, fifo, link_outside, link_to_zeros, link_to_nothing, link_to_itself, folder_there,
    bound_socket, sparse, empty, noise, half,
)  # fmt: skip


def of_kind(kind: Callable[[Path], None], name: str) -> Change:
    return lambda folder: kind(folder / name)


# What a parser might choke on

TEXTS = {
    "no text": b"\xff\xfe\x00",
    "nothing": b"",
    "NaN": b'{"a": NaN}',
    "infinity": b'{"a": 1e999}',
    "400 digits": b'{"a": 1' + b"0" * 400 + b"}",
    "5000 digits": b'{"a": 1' + b"0" * 5000 + b"}",
    "deep lists": b"[" * 100_000 + b"]" * 100_000,
    "deep mappings": b'{"a":' * 2_000 + b"1" + b"}" * 2_000,
    "a key twice": b'{"task": 1, "task": 2}',
    "a surrogate": b'{"task": "\\ud800"}',
    "a list": b"[1, 2]",
    "a number": b"1",
    "null": b"null",
    "escape sequences": b'{"\\u001b[31m\\u0007": 1}',
    "many keys": b"{" + b",".join(b'"k%d": 1' % i for i in range(30_000)) + b"}",
    "many lists": b"[" + b",".join([b"[]"] * 170_000) + b"]",
    "long text": b'{"task": "' + b"x" * 450_000 + b'"}',
}
ALIASES = b"a: &a [x, x, x, x, x, x, x, x, x]\n" + b"".join(
    b"%c: &%c [*%c, *%c, *%c, *%c, *%c, *%c, *%c, *%c, *%c]\n" % (i + 1, i + 1, *[i] * 9)
    for i in range(97, 110)
)
YAMLS = {
    "aliases": ALIASES,
    "merges": b"a: &a {x: 1}\nb: &b {<<: [*a, *a, *a, *a]}\nc: {<<: [*b, *b, *b, *b]}\n",
    "an alias of itself": b"&a [*a]\n",
    "a Python object": b"!!python/object/apply:os.system ['touch pwned']\n",
    "a binary": b"!!binary |\n aGVsbG8=\n",
    "a date that is none": b"seed: 2026-99-99\n",
    "hexadecimal": b"seed: 0x1" + b"0" * 5000 + b"\n",
    "base sixty": b"seed: 1" + b":59" * 3000 + b"\n",
    "deep": b"[" * 8000 + b"]" * 8000,
    "many keys": b"".join(b"k%d: 1\n" % i for i in range(1500)),
    "too many keys": b"".join(b"k%d: 1\n" % i for i in range(200_000)),
    "a tab": b"\t\n",
    "documents": b"--- 1\n--- 2\n",
    "long text": b"task: " + b"x" * 15_000 + b"\n",
    "no text": b"\xff\xfe\x00",
}


def npz(members: dict[str, bytes], *, packing: int = zipfile.ZIP_DEFLATED) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", packing) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return content.getvalue()


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def with_arrays(**changes: np.ndarray | None) -> Callable[[bytes], bytes]:
    """A recording with other arrays."""

    def change(content: bytes) -> bytes:
        arrays = dict(np.load(io.BytesIO(content), allow_pickle=False))
        for name, array in changes.items():
            arrays.pop(name, None)
            if array is not None:
                arrays[name] = array
        made = io.BytesIO()
        np.savez_compressed(made, **arrays)
        return made.getvalue()

    return change


def lying(_: bytes) -> bytes:
    """A member of many megabytes that the directory calls small."""
    size = 60 * 2**20
    return npz({"states.npy": b"\0" * size}).replace(
        struct.pack("<I", size), struct.pack("<I", 100)
    )


def flagged(content: bytes) -> bytes:
    """Members that say they are encrypted."""
    data = bytearray(content)
    for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.find(mark)
        data[at + place] |= 1
    return bytes(data)


def pickled(_: bytes) -> bytes:
    class Harm:
        def __reduce__(self) -> Any:
            return (os.system, ("touch pwned",))

    made = io.BytesIO()
    np.savez(made, states=np.array([Harm()], object))
    return made.getvalue()


F8 = "{'descr': '<f8', 'fortran_order': False, 'shape': %s}"
NPZS: dict[str, bytes | Callable[[bytes], bytes]] = {
    "a bomb": lambda _: npz({"states.npy": b"\0" * (64 * 2**20)}),
    "a bomb that lies": lying,
    "a pickle": pickled,
    "an encrypted member": flagged,
    "a path that climbs": npz({"../../states.npy": b""}),
    "100 members": npz({f"a{i}.npy": npy(F8 % "(0,)") for i in range(100)}),
    "50000 members": npz({f"{i}": b"" for i in range(40_000)}, packing=zipfile.ZIP_STORED),
    "a shape of 10^12": npz({"states.npy": npy(F8 % "(1000000000000,)")}),
    "a shape of 10^40": npz({"states.npy": npy(F8 % "(10**40,)")}),
    "a negative shape": npz({"states.npy": npy(F8 % "(-1, -1)", b"\0" * 8)}),
    "a shape with nothing": npz({"states.npy": npy(F8 % "(0, 1000000000000)")}),
    "a header that is code": npz({"states.npy": npy("__import__('os').system('touch pwned')")}),
    "a deep header": npz({"states.npy": npy("(" * 5000 + ")" * 5000)}),
    "a type of objects": npz({"states.npy": npy(F8.replace("<f8", "|O") % "(1,)", b"\0" * 8)}),
    "a record type": npz(
        {"states.npy": npy(F8.replace("'<f8'", "[('a','<f8')]") % "(1,)", b"0" * 8)}
    ),
    "no members": npz({}),
    "text": b"PK\x03\x04 nonsense",
    "no kind": with_arrays(kind=None),
    "another kind": with_arrays(kind=np.array("recipe")),
    "a kind of 4 MB": with_arrays(kind=np.array("x" * 10**6)),
    "an unknown array": with_arrays(extra=np.zeros(3)),
    "another task": with_arrays(task=np.array("cooking")),
    "a task with an escape": with_arrays(task=np.array("\x1b[31m")),
    "no time step": with_arrays(timestep=None),
    "a time step of zero": with_arrays(timestep=np.array(0.0)),
    "a negative time step": with_arrays(timestep=np.array(-1.0)),
    "a time step of NaN": with_arrays(timestep=np.array(np.nan)),
    "a time step of text": with_arrays(timestep=np.array("0.1")),
    "a version that is no number": with_arrays(task_version=np.array(1.0)),
}
ARRAYS = {
    "plan.npz": "states", "reference.npz": "qpos", "actions.npz": "actions", "roadmap.npz": "nodes",
}  # fmt: skip
RESHAPED = {
    "values that are not finite": lambda array: np.full(array.shape, np.inf),
    "float32": lambda array: array.astype(np.float32),
    "whole numbers": lambda array: array.astype(np.int64),
    "big endian": lambda array: array.astype(">f8"),
    "one axis less": lambda array: array[0],
    "no frame": lambda array: array[:0],
    "another width": lambda array: array[..., :1],
    "100000 frames": lambda array: np.zeros((100_000, *array.shape[1:])),
    "complex numbers": lambda array: array.astype(complex),
}


def with_array(file: str, make: Callable[[np.ndarray], np.ndarray]) -> Callable[[bytes], bytes]:
    name = ARRAYS[file]
    return lambda content: with_arrays(
        **{name: make(np.load(io.BytesIO(content), allow_pickle=False)[name])}
    )(content)


def tensors(change: Callable[[dict[str, np.ndarray]], object]) -> Callable[[bytes], bytes]:
    def changed(content: bytes) -> bytes:
        found = dict(load(content))
        change(found)
        return save(found)

    return changed


def lengthened(length: int) -> Callable[[bytes], bytes]:
    return lambda content: struct.pack("<Q", length) + content[8:]


def header(text: bytes) -> bytes:
    return struct.pack("<Q", len(text)) + text


SAFETENSORS: dict[str, bytes | Callable[[bytes], bytes]] = {
    "a header of 2^63": lengthened(2**63),
    "a header of 90 MB": lengthened(90 * 2**20),
    "a header of nothing": lengthened(0),
    "a deep header": header(b"[" * 10_000),
    "offsets beyond the end": header(
        b'{"mean": {"dtype": "F32", "shape": [10], "data_offsets": [0, 40000000000]}}'
    ),
    "a shape that overflows": header(
        b'{"mean": {"dtype": "F32", "shape": [4294967296, 4294967296], "data_offsets": [0, 4]}}'
    )
    + b"\0" * 4,
    "a negative offset": header(
        b'{"mean": {"dtype": "F32", "shape": [1], "data_offsets": [-4, 0]}}'
    ),
    "10000 tensors": tensors(
        lambda found: found.update({f"t{i}": np.zeros(1, np.float32) for i in range(10_000)})
    ),
    "a tensor more": tensors(lambda found: found.update(more=np.zeros(1, np.float32))),
    "a tensor less": tensors(lambda found: found.pop("bias_0")),
    "doubles": tensors(lambda found: found.update(mean=found["mean"].astype(float))),
    "NaN": tensors(lambda found: found["weight_0"].fill(np.nan)),
    "infinity": tensors(lambda found: found["bias_0"].fill(np.inf)),
    "a scale of zero": tensors(lambda found: found["scale"].fill(0.0)),
    "a negative scale": tensors(lambda found: found["scale"].fill(-1.0)),
    "another shape": tensors(lambda found: found.update(mean=np.zeros(3, np.float32))),
    "a long name": tensors(lambda found: found.update({"x" * 9000: np.zeros(1, np.float32)})),
    "weights of 3e38": tensors(
        lambda found: found.update({n: np.full_like(found[n], 3e38) for n in found if "w" in n})
    ),
}
POLICY_INFO: dict[str, list[Any]] = {
    "activation": ["x" * 8000, "sin", 3, None, "\x1b[2J"],
    "encoding": ["x" * 8000, "log"],
    "output": ["softmax", 1],
    "bound": [-1.0, 0.0, "1", 10**30],
    "layers": [
        [10],
        [],
        [10] * 2000,
        [10, 10**9, 2],
        [10, -1, 2],
        [0, 2],
        "10",
        [10, 2.5, 2],
        [True],
    ],
    "task": ["cooking", "../../../etc/passwd", "x" * 8000, 7],
    "task_version": [2, -1, "1", 2**70, 1.0],
    "physics": ["0" * 64, 5],
    "method": ["\x07", 5, "other"],
    "sha256": ["0" * 64, "", 3],
    "format": [2, "1"],
    "more": [1],
}
SCORE: dict[str, list[Any]] = {
    "task": ["cooking", 3], "task_version": [7, 1.5], "standard": [False, 1],
    "method": ["other", "\x1b[31m"], "seed": [5, -1, 2**40, 1.0], "budget": ["other", None],
    "stages": [[], 3, [{}]], "stages/0/steps": [1, -5, 10**12, 2**63],
    "stages/0/seconds": [1e308, -1.0, 0.5], "stages/0/budget": [10**12],
    "score/protocol": ["smoke", "x" * 5000], "score/solved_reward": [0.99, 10**300, -0.5],
    "score/success": [0.5, 2.0], "score/against_plan": [7.0],
    "score/perturbed/episodes": [100_000, 0, -1, 2**40], "score/perturbed/solved": [[1], [2] * 100],
    "score/perturbed/steps": [0.0, 1e9], "score/perturbed/violations": [1.5],
    "score/perturbed/measures": [{}, {"beauty": 1.0}, 3],
    "score/nominal/episodes": [2], "score/nominal/normalized_reward": [1.5],
    "score/changes": [{}, {"x": 1}], "score/robustness/survival_100N": [0.25, -1.0],
    "score/robustness/survival_impulse_50": [9e9], "score/robustness/mass_scale": [1e-9],
    "score/robustness/push_duration_s": [9.0], "score/robustness/surface/phases": [[], [1] * 16],
    "score/robustness/surface/forces_N": [[1.0] * 12],
    "score/robustness/surface/survived": [[], [[[2] * 16] * 16] * 12, [[[0] * 16] * 16] * 12],
    "score/robustness/surface/survived/0/0/0": [-1],
    "score/origin/protocol/seed": [1, 2**63], "score/origin/protocol/perturbed": [10],
    "score/origin/protocol/tolerance": [10.0], "score/origin/protocol/ranked": [False],
    "score/origin/protocol/forces": [[1.0] * 200_000], "score/origin/policy": ["0" * 64, None],
    "score/origin/constants": ["0" * 63, "x" * 64], "score/origin/mjcf": [""],
    "score/origin/model": ["G" * 64],
    "score/origin/task": ["cooking"], "score/origin/packages": [[], {"mujoco": 3}],
    "score/origin/machine": [None], "more": [1],
}  # fmt: skip
EDGES: dict[str, list[Any]] = {  # of numbers, for who draws them
    "score/robustness/surface/forces_N": [[0.0] * 12, [1e308] * 12, [-1.0] * 12, [5e-324] * 12],
    "score/robustness/surface/headings_rad": [[0.0] * 16, [1e308] * 16],
    "score/robustness/surface/phases": [[2**62] * 16, [-1] * 16, [0] * 16],
    "score/robustness/push_duration_s": [0.0, 1e308, -0.0],
    "score/robustness/mass_scale": [0.0, 1e308],
    "score/robustness/survival_impulse_50": [1e308, -1e308],
    "score/origin/protocol/claim": [0.0, 1e308], "score/origin/protocol/headings": [0, 2**62],
    "score/origin/protocol/duration": [0.0], "score/origin/protocol/forces": [[], [0.0]],
    "score/perturbed/goal_distance": [1e308], "score/perturbed/measures": [{"$x^$": 1e308}],
    "score/nominal/steps": [1e308], "stages/0/name": ["$\\frac", "<b>", ""],
    "stages/0/seconds": [1e300], "stages/0/steps": [2**63],
}  # fmt: skip
MANIFEST: dict[str, list[Any]] = {
    "schema": [2, "1", None, 2**70], "described/entry": ["other", "../entry", "", "A", "x" * 65],
    "described/authors": [[], [""], ["x" * 4001], ["\x1b[31m"], ["a"] * 101, [3]],
    "described/licence": ["", "\n", 5], "described/url": ["javascript:alert(1)", "x" * 400],
    "described/hardware": ["\x07", 3], "described/tuning_trials": [-1, 2.5, 2**60],
    "described/seeds_trained": [[], [1], [0, 0], [-1], [2**40]],
    "task": ["cooking", "../../x", "laikago_trot"], "task_version": [9],
    "protocol": ["v2", "smoke"], "method": ["other"], "budget": ["other"],
    "trainings": [[], [{}], 3],
    "trainings/0/seed": [1, -1, 2**32], "trainings/0/command": ["", "x\ny", "rm -rf /", "x" * 9000],
    "trainings/0/code": ["\x00"], "trainings/0/steps": [1, -1, 2**60],
    "trainings/0/physics_substeps": [0], "trainings/0/seconds": [0.0, -1.0, 1e300],
    "trainings/0/versions": [{"python": "2.7"}, {"x": "\x1b"}], "trainings/0/claimed": [{}],
    "trainings/0/claimed/solved_reward": [0.99, "1", None],
    "trainings/0/claimed/success": [0.0], "trainings/0/claimed/survival_100N": [0.5],
    "files": [{}, [], None], "files/..~1..~1secret": [{"bytes": 1, "sha256": "0" * 64}],
    "files/~1etc~1passwd": [{"bytes": 1, "sha256": "0" * 64}],
    "files/seed0~1run.py": [{"bytes": 1, "sha256": "0" * 64}],
    "files/seed1~1policy.json": [{"bytes": 1, "sha256": "0" * 64}], "more": [1],
}  # fmt: skip
CONFIG = {
    "another task": ("name: ", "name: cooking #"),
    "a constant": ("constants: {}", "constants: {distance: 1}"),
    "an unknown constant": ("constants: {}", "constants: {x: 1}"),
    "a constant of text": ("constants: {}", "constants: {distance: '1'}"),
    "another seed": ("\nseed: 0", "\nseed: 1"),
    "a huge seed": ("\nseed: 0", "\nseed: 99999999999999999999999"),
    "another budget": ("\nbudget: ", "\nbudget: x"),
    "a key more": ("\nseed: 0", "\nseed: 0\nmore: 1"),
    "another command": ("# tsbench run", "# rm -rf / #"),
}


def deep(values: Any, path: str, value: Any) -> None:
    parts = [part.replace("~1", "/") for part in path.split("/")]
    for part in parts[:-1]:
        values = values[int(part) if isinstance(values, list) else part]
    values[int(parts[-1]) if isinstance(values, list) else parts[-1]] = value


def altered(name: str, path: str, value: Any) -> Change:
    def change(folder: Path) -> None:
        values = json.loads((folder / name).read_text())
        deep(values, path, value)
        if name == "manifest.json":
            signed(folder, values)
        else:
            encode = encode_info if name.endswith("policy.json") else encode_json
            (folder / name).write_bytes(encode(values))

    return change


def entry_cases(entry: Path) -> Iterator[tuple[str, Change, bool]]:
    """Name, change, and whether the manifest is then made to fit."""
    files = sorted(path.relative_to(entry) for path in entry.rglob("*") if path.is_file())
    for file in map(str, files):
        for kind in KINDS:
            yield f"{file}: {kind.__name__}", of_kind(kind, file), False
    seed = "seed0"
    for name in ("score.json", "policy.json", "versions.json"):
        for what, content in TEXTS.items():
            yield f"{name}: {what}", written(f"{seed}/{name}", content), True
    for what, content in TEXTS.items():
        yield f"manifest.json: {what}", written("manifest.json", content), False
    for what, content in YAMLS.items():
        yield f"config.yaml: {what}", written(f"{seed}/config.yaml", content), True
    for what, (before, after) in CONFIG.items():
        yield f"config.yaml: {what}", replaced(f"{seed}/config.yaml", before, after), True
    for name in ARRAYS:
        for what, made in NPZS.items():
            yield f"{name}: {what}", written(f"{seed}/{name}", made), True
        for what, make in RESHAPED.items():
            yield f"{name}: {what}", written(f"{seed}/{name}", with_array(name, make)), True
    for what, made in SAFETENSORS.items():
        yield f"policy.safetensors: {what}", written(f"{seed}/policy.safetensors", made), True
    altered_files: dict[str, dict[str, list[Any]]] = {
        f"{seed}/policy.json": POLICY_INFO,
        f"{seed}/score.json": SCORE,
        "manifest.json": MANIFEST,
    }
    for name, changes in altered_files.items():
        for place, values in changes.items():
            for i, value in enumerate(values):
                yield f"{name} {place} {i}", altered(name, place, value), name != "manifest.json"
    yield "a file more", written(f"{seed}/run.py", b"import os"), True
    yield "a hidden file", written(".gitattributes", b"* filter=x"), True
    yield "a folder more", lambda folder: (folder / "seed7").mkdir(), True
    yield "a folder deeper", lambda folder: (folder / seed / "more").mkdir(), True
    yield "10000 files", many_files, True
    yield "a linked training", linked_training, True


def many_files(folder: Path) -> None:
    for number in range(10_000):
        (folder / f"{number}").touch()


def linked_training(folder: Path) -> None:
    (folder / "seed0").rename(folder.parents[2] / "elsewhere")
    (folder / "seed0").symlink_to(folder.parents[2] / "elsewhere")


# Runs, through the other verbs

READ_BY = {
    "evaluate": ("policy.json", "policy.safetensors", "config.yaml", "score.json", "actions.npz"),
    "view": (
        "policy.json", "policy.safetensors", "config.yaml", "score.json", "reference.npz",
        "roadmap.npz",
    ),
    "report": (
        "policy.json", "policy.safetensors", "config.yaml", "score.json", "reference.npz",
        "plan.npz", "roadmap.npz", "metrics.jsonl",
    ),
    "resume": ("config.yaml", "versions.json"),
    "submit": ("policy.json", "policy.safetensors", "config.yaml", "score.json", "actions.npz",
               "versions.json", "plan.npz", "reference.npz", "roadmap.npz", "metrics.jsonl"),
}  # fmt: skip
ABSENT = {  # whose absence is no fault
    ("gone", name) for name in ("config.yaml", "actions.npz", "plan.npz", "reference.npz",
                                "roadmap.npz", "metrics.jsonl", "versions.json", "score.json")
}  # fmt: skip


def run_cases(*, contents: bool) -> Iterator[tuple[str, str, Change]]:
    """Verb, name, change."""
    for verb in READ_BY:
        for name in READ_BY[verb]:
            for kind in KINDS:
                if (kind.__name__, name) in ABSENT or (name, kind) == ("metrics.jsonl", empty):
                    continue
                yield verb, f"{verb} {name}: {kind.__name__}", of_kind(kind, name)
            bad: dict[str, dict[str, Any]] = {
                "json": TEXTS, "yaml": YAMLS, "npz": NPZS, "safetensors": SAFETENSORS,
            }  # fmt: skip
            for what, content in bad.get(name.rpartition(".")[2], {}).items() if contents else ():
                if what in ("many keys", "a Python object") or verb in ("evaluate", "resume"):
                    yield verb, f"{verb} {name}: {what}", written(name, content)


def score_cases(chosen: dict[str, list[Any]]) -> Iterator[tuple[str, str, Change]]:
    """Scores that are not what a policy earns, or cannot be, as the report meets them. What it can
    show it shows: nobody says that it is true."""
    for place, values in chosen.items():
        for i, value in enumerate(values):
            yield "report", f"report score.json {place} {i}", altered("score.json", place, value)


def words_of(verb: str, run: Path, out: Path) -> list[str]:
    if verb == "resume":
        (run / "score.json").unlink(missing_ok=True)
        return ["run", f"resume={run}"]
    if verb == "submit":
        told = ["--name", "entry", "--author", "A", "--licence", "MIT", "--board", str(out)]
        return [verb, str(run), *told]
    if verb == "evaluate":
        return [verb, str(run)]
    return [verb, str(run), "--html", str(out / "page.html")]


# Running them


@contextlib.contextmanager
def patience() -> Iterator[None]:
    def hang(*_: object) -> None:
        raise HangError

    before = signal.signal(signal.SIGALRM, hang)
    signal.alarm(PATIENCE)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def clear_peak() -> None:
    """Lets the peak of this process's memory begin now, where Linux does that."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak() -> int:
    """Megabytes of memory at most since `clear_peak`."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM"))
    return int(line.split()[1]) // 1024


def tell(case: str, line: Callable[[], tuple[bool, str]]) -> None:
    """Prints what became of a case: whether it was accepted, and the reader's line."""
    clear_peak()
    began = time.process_time()
    try:
        with patience():
            accepted, said = line()
    except BaseException as error:  # whatever it is, it is a finding
        accepted, said = False, f"TRACEBACK {error!r:.200} {traceback.format_exc()[-600:]}"
    seconds = round(time.process_time() - began, 3)
    found = {"case": case, "accepted": accepted, "line": said, "seconds": seconds, "MB": peak()}
    sys.stdout.write(json.dumps(found) + "\n")
    sys.stdout.flush()


def judged(entry: Path) -> tuple[bool, str]:
    verdict = verify.verify(entry, verify.Asked(rescore=False))
    last = verdict.reasons[-1]
    return verdict.passed, last


def entries(folder: Path) -> None:
    whole = intact(folder / "whole")
    tell("intact", lambda: judged(whole))
    for case, change, sign in entry_cases(whole):
        board = Path(tempfile.mkdtemp(dir=folder))
        entry = board / "v1" / whole.parent.name / whole.name
        shutil.copytree(whole, entry)
        change(entry)
        if sign:
            signed(entry)
        tell(case, partial(judged, entry))
        shutil.rmtree(board, ignore_errors=True)


def once(make: Callable[..., Any]) -> Callable[..., Any]:
    """A function that is called the first time alone, and returns that result ever after."""
    made: list[Any] = []

    def again(*given: Any) -> Any:
        if not made:
            made.append(make(*given))
        return made[0]

    return again


def draw_once() -> None:
    """Records and draws once what no score changes, since every case is of the same run."""
    from tsbench.viewer import charts, report  # matplotlib, which a reader's memory lacks

    names = [(charts, name) for name in ("learning", "contacts", "rewards", "joints")]
    for module, name in [(report, "record_episode"), *names]:
        setattr(module, name, once(getattr(module, name)))


def runs(folder: Path, only: str | None = None) -> None:
    whole = intact(folder / "whole") / "seed0"
    found = run_cases(contents=only is None)
    if only in ("scores", "edges"):
        draw_once()
        edges = {place: values[-1:] for place, values in EDGES.items()}
        found = score_cases(edges if only == "edges" else {**SCORE, **EDGES})
    for verb, case, change in found:
        out = Path(tempfile.mkdtemp(dir=folder))
        run = out / "a" / "b" / "run"
        shutil.copytree(whole, run)
        change(run)
        words = words_of(verb, run, out)

        def line(words: list[str] = words) -> tuple[bool, str]:
            errors = io.StringIO()
            with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
                status = cli.main(words)
            return status == 0, f"{status} {errors.getvalue().strip()}"

        tell(case, line)
        shutil.rmtree(out, ignore_errors=True)


def fuzz(folder: Path, count: int, start: int) -> None:
    """Random changes of random files, half of them with a manifest that fits them."""
    whole = intact(folder / "whole")
    files = sorted(path.relative_to(whole) for path in whole.rglob("*") if path.is_file())
    contents = {file: (whole / file).read_bytes() for file in files}
    for number in range(start, start + count):
        rng = np.random.default_rng(number)
        file = files[rng.integers(len(files))]
        content = mutated(contents[file], rng)
        (whole / file).write_bytes(content)
        sign = bool(rng.integers(2)) and file.name != "manifest.json"
        if sign:
            signed(whole)
        if content != contents[file]:
            case = f"fuzz {number} {file}{' signed' if sign else ''}"
            tell(case, partial(readable, whole))
        (whole / file).write_bytes(contents[file])
        (whole / "manifest.json").write_bytes(contents[Path("manifest.json")])


def readable(entry: Path) -> tuple[bool, str]:
    """As `judged`, without playing an episode."""
    try:
        submission.read_entry(entry)
    except TsbenchError as error:
        return False, str(error)
    return True, "read"


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """One to four bytes replaced, a part removed, doubled or moved, or a number made extreme."""
    data = bytearray(content)
    kind = rng.integers(6)
    at = int(rng.integers(len(data)))
    length = int(rng.integers(1, 64))
    if kind == 0:
        for place in rng.integers(len(data), size=int(rng.integers(1, 5))):
            data[place] ^= int(rng.integers(1, 256))
    elif kind == 1:
        del data[at : at + length]
    elif kind == 2:
        data[at:at] = data[at : at + length]
    elif kind == 3:
        data[at:at] = rng.bytes(length)
    elif kind == 4:
        data[at : at + length] = b"\xff" * length
    else:
        digits = [i for i in range(len(data)) if 48 <= data[i] < 58]
        extreme = [b"1e999", b"NaN", b"-0.0", b"9" * 40, b"null", b'"\\ud800"', b"[[[[", b"1e-400"]
        if digits:
            place = digits[int(rng.integers(len(digits)))]
            data[place : place + 1] = extreme[int(rng.integers(len(extreme)))]
    return bytes(data)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("entries", "runs", "fuzz"))
    parser.add_argument("count", nargs="?", type=int, default=300)
    parser.add_argument("--start", type=int, default=0, help="of the random numbers")
    parser.add_argument("--only", choices=("kinds", "scores", "edges"), help="of the runs")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hostile-") as folder:
        os.chdir(folder)
        if options.what == "fuzz":
            fuzz(Path(folder), options.count, options.start)
        elif options.what == "runs":
            runs(Path(folder), options.only)
        else:
            entries(Path(folder))
        assert not list(Path(folder).rglob("pwned")), "code of an entry ran"


if __name__ == "__main__":
    main()
