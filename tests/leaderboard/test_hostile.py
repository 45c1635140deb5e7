"""Entries and runs made to break a reader: each is refused in one line, soon and in little memory.

The bounds on seconds are of processor time, so that a busy machine does not matter. Ten thousand
random changes: python tests/leaderboard/hostile.py fuzz 10000.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).with_name("hostile.py")
SECONDS, MEGABYTES = 2.0, 300


def cases(*words: str) -> list[dict[str, Any]]:
    done = subprocess.run([sys.executable, SCRIPT, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def check_refused(case: dict[str, Any]) -> None:
    line = case["line"]
    assert not case["accepted"], case
    assert "TRACEBACK" not in line, line
    assert "\n" not in line
    assert line.isprintable()
    assert len(line) < 2200
    assert case["seconds"] < SECONDS, case
    assert case["MB"] < MEGABYTES, case


@pytest.fixture(scope="module")
def entries() -> list[dict[str, Any]]:
    return cases("entries")


def test_no_hostile_entry_is_accepted(entries: list[dict[str, Any]]) -> None:
    whole, *hostile = entries
    assert whole["accepted"], whole
    assert len(hostile) >= 500
    for case in hostile:
        check_refused(case)


def test_a_refusal_names_the_file(entries: list[dict[str, Any]]) -> None:
    for case in entries[1:]:
        name, found, _ = case["case"].partition(": ")
        if found and "mixes several runs" not in case["line"]:
            assert name.rpartition("/")[2] in case["line"], case


def test_random_changes_of_an_entry() -> None:
    """A change that the manifest does not know of is always noticed. With a manifest that fits, a
    hash, a platform or a figure of a learning curve may be another one of the same form, and so may
    the origin of a score and what an archive's directory says beside its members: the first are
    claims, the second is refused when the actions are replayed, the third is read by nobody."""
    found = cases("fuzz", "200", "--start", "1000000")
    assert len(found) > 150
    for case in found:
        _, _, file, *signed = case["case"].split()
        told = file.endswith(("versions.json", "score.json", ".npz", "metrics.jsonl"))
        if not (case["accepted"] and told and signed):
            check_refused(case)
    assert sum(case["accepted"] for case in found) <= 3


@pytest.fixture(scope="module")
def kinds() -> list[dict[str, Any]]:
    return cases("runs", "--only", "kinds")


@pytest.mark.parametrize("verb", ["evaluate", "view", "report", "resume", "submit"])
def test_no_hostile_run_is_read(kinds: list[dict[str, Any]], verb: str) -> None:
    found = [case for case in kinds if case["case"].startswith(f"{verb} ")]
    assert len(found) >= 20
    # The first one loads what its verb needs; beside mujoco some load torch or matplotlib.
    for case in [found[0] | {"seconds": 0.0}, *found[1:]]:
        check_refused(case | {"MB": 0})
        assert case["line"].startswith("2 tsbench: "), case


def test_numbers_and_texts_at_their_edges_are_drawn_or_refused() -> None:
    """Whatever a score.json holds, the report of it is a page or one line."""
    first, *found = cases("runs", "--only", "edges")
    assert len(found) >= 10
    for case in [first | {"seconds": 0.0}, *found]:
        line = case["line"]
        assert "TRACEBACK" not in line, line
        assert case["accepted"] or line.startswith("2 tsbench: ")
        assert "\n" not in line
        assert case["seconds"] < 5 * SECONDS, case  # a page takes longer than a refusal
