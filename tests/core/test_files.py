"""Reads and writes of files that somebody may have prepared."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from tsbench.core import files
from tsbench.core.errors import TsbenchError


def test_json_has_lists_on_a_line_and_texts_as_they_are() -> None:
    content = {"a": [1, [2, 3]], "b": 'x [1,   2] "y [3,  4]', "c": ["p", []], "d": ""}
    text = files.encode_json(content).decode()
    assert json.loads(text) == content
    assert "[ 2, 3 ]" in text


def test_a_write_follows_no_link(tmp_path: Path) -> None:
    """Neither where the file is to be, nor where a temporary one was under a fixed name."""
    outside = tmp_path / "outside"
    outside.write_text("mine")
    for name in ("report.html", "report.html.part", ".report.html.part"):
        (tmp_path / name).symlink_to(outside)
    files.write_whole(tmp_path / "report.html", b"page")
    assert outside.read_text() == "mine"
    assert not (tmp_path / "report.html").is_symlink()
    assert (tmp_path / "report.html").read_bytes() == b"page"
    with pytest.raises(TsbenchError, match="is a link: nothing is written through it"):
        files.append(tmp_path / "report.html.part")
    with pytest.raises(TsbenchError, match="exists and nothing is overwritten"):
        files.write_new(tmp_path / ".report.html.part", b"page")


def test_a_users_own_files_are_no_leftovers(tmp_path: Path) -> None:
    own = ["out.html.part", ".out.html.part", "a.part", f".out.html.{'0' * 31}.part"]
    for name in own:
        (tmp_path / name).write_text("mine")
    ours = tmp_path / f".out.html.{'0' * 32}.part"
    ours.write_text("half")
    files.write_whole(tmp_path / "out.html", b"page")
    assert list(files.leftovers(tmp_path)) == [(ours, "out.html")]
    assert all((tmp_path / name).read_text() == "mine" for name in own)


def test_a_temporary_name_cannot_be_guessed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[str] = []
    replace = Path.replace

    def seen(self: Path, target: Path) -> Path:
        used.append(self.name)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", seen)
    for _ in range(2):
        files.write_whole(tmp_path / "out", b"")
    assert len(set(used)) == 2
    assert all(list(files.leftovers(tmp_path)) == [] for _ in used)


def test_a_full_disk_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that another try finds nothing in its way."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(TsbenchError, match=r"out: No space left on device"):
            files.write_new(tmp_path / "out", b"content")
    assert not list(tmp_path.iterdir())
    files.write_new(tmp_path / "out", b"content")
    assert (tmp_path / "out").read_bytes() == b"content"


@pytest.mark.parametrize("kind", ["link", "fifo", "folder", "device"])
def test_only_regular_files_are_appended_to(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "log.txt"
    if kind == "link":
        path.symlink_to(tmp_path / "other")
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path = Path("/dev/null")
    with pytest.raises(TsbenchError, match=str(path)):
        files.append(path)
    assert not (tmp_path / "other").exists()
