"""The board as tables and as a site."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tsbench import cli
from tsbench.core.errors import TsbenchError
from tsbench.core.files import encode_json
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.protocol import V1
from tsbench.leaderboard import page, submission, verify
from tsbench.leaderboard.submission import Described
from tsbench.runs.directory import RunDirectory
from tsbench.runs.schema import identity_hash

BOARD = Path(__file__).parents[2] / "leaderboards"
RUN = min(BOARD.glob("v1/*/*/seed*"), key=lambda run: (run / "actions.npz").stat().st_size)
TASK = json.loads((RUN / "score.json").read_text())["task"]
EVIL = "<script>alert(1)</script>"


def add(board: Path, name: str, runs: list[Path], hardware: str = "a PC") -> Path:
    url = "https://example.org/?a=1&b='\"><b>"
    described = Described(name, (EVIL,), "MIT", url, hardware, tuning_trials=7)
    packed = submission.pack(runs, described, board, V1, score=evaluate)
    return submission.place(packed, board, V1, [])


def of_seed(folder: Path, seed: int) -> Path:
    """A copy of the kept run that says it is of another seed."""
    run = folder / f"run{seed}"
    shutil.copytree(RUN, run)
    score = json.loads((run / "score.json").read_text())
    before, score["seed"] = score["seed"], seed
    (run / "score.json").write_bytes(encode_json(score))
    text = (run / "config.yaml").read_text()
    for word in ("\nseed: ", "seed="):
        text = text.replace(f"{word}{before}", f"{word}{seed}")
    (run / "config.yaml").write_text(text)
    directory = RunDirectory(run)
    versions = directory.versions() | {"configuration": identity_hash(directory.settings())}
    directory.versions_file.write_bytes(encode_json(versions))
    return run


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    add(folder, "one", [RUN])
    add(folder, "ten", [of_seed(folder.parent, seed) for seed in range(10)], EVIL)
    taken_back = add(folder, "gone", [RUN])
    verify.record(folder, taken_back, verify.retracted(taken_back, "a bug"))
    checked = verify.verify(folder / "v1" / TASK / "one", verify.Asked(rescore=False))
    verify.record(folder, folder / "v1" / TASK / "one", replace(checked, state="re-scored"))
    return folder


def test_rows_are_sorted_and_say_how_sure_they_are(board: Path) -> None:
    tables, left_out = page.tables(board)
    (table,) = (table for table in tables if table.rows)
    rows = {row.name: row for row in table.rows}
    assert set(rows) == {"one", "ten"}
    claimed = rows["one"].entry.kept[0].training.claimed
    assert rows["one"].reward.iqm == claimed.solved_reward
    assert rows["one"].reward.interval is None
    assert "too few" in rows["one"].standing
    low, high = rows["ten"].reward.interval or (0.0, 0.0)
    assert low == pytest.approx(high)  # ten equal trainings
    assert low == pytest.approx(claimed.solved_reward)
    best = max(table.best, claimed.solved_reward)
    assert rows["one"].share == pytest.approx(claimed.solved_reward / best)
    assert rows["one"].state == "re-scored"
    assert rows["ten"].state == "submitted"
    assert left_out == [f"v1/{TASK}/gone: retracted: a bug"]
    assert {"oracle", "zero", "random"} <= set(table.references)
    assert table.references["oracle"]["solved_reward"] == table.best > 0.0


def test_an_entry_that_failed_stands_last_and_says_so(board: Path, tmp_path: Path) -> None:
    copy = tmp_path / "board"
    shutil.copytree(board, copy)
    one = copy / "v1" / TASK / "one"
    (row,) = (row for table in page.tables(copy)[0] for row in table.rows if row.name == "one")
    assert row.label == "re-scored"
    asked = verify.verify(one, verify.Asked(rescore=False))
    reasons = (*asked.reasons, "FAILED: not re-scored: seed1 was compared: DIFFERENT")
    verify.record(copy, one, replace(asked, passed=False, reasons=reasons))
    found, left_out = page.tables(copy)
    (table,) = (table for table in found if table.rows)
    assert [row.label for row in table.rows] == ["submitted", "replayed, then FAILED"]
    text = page.markdown(found, left_out, "# Leaderboards\n")
    assert re.search(r"\| one \|.*\| replayed, then FAILED \|", text)
    assert [row["passed"] for row in page.plain([table], [])["tables"][0]["rows"]] == [True, False]
    index = page.write_site(copy, tmp_path / "site", None, lambda line: None)[-1]
    assert '<span class="state failed">replayed, then FAILED</span>' in index.read_text()


def test_tables_in_markdown(board: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["leaderboard", "--board", str(board), "--readme"]) == 0
    capsys.readouterr()
    text = (board / "README.md").read_text()
    assert text.startswith("# Leaderboards\n")
    assert re.search(r"\| one \| [0-9.]+ \| \d+% \|.*\| re-scored \| 7 \| 1 \|", text)
    assert re.search(r"\| oracle \| 0\.\d+ \|  \| 1 \|  \| - \|  \|  \| reference \|", text)
    assert "retracted: a bug" in text
    assert page.COLUMNS in text
    assert cli.main(["leaderboard", "--board", str(board), "--json", str(board / "out.json")]) == 0
    shown = json.loads((board / "out.json").read_text())
    (board / "out.json").unlink()
    assert shown["left_out"] == [f"v1/{TASK}/gone: retracted: a bug"]
    (rows,) = (table["rows"] for table in shown["tables"] if table["rows"])
    assert {row["entry"]: (row["state"], len(row["seeds"])) for row in rows} == {
        "one": ("re-scored", 1), "ten": ("submitted", 10)
    }  # fmt: skip
    capsys.readouterr()
    assert re.search(
        r"\| steps \| time \| state \|.*\n\|[-|]+\|\n\| one \|.*\| \d+:\d\d \| re-", text
    )
    assert cli.main(["leaderboard", "--board", str(board), "--readme"]) == 0
    assert (board / "README.md").read_text() == text


@pytest.fixture(scope="module")
def site(board: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    page.write_site(board, folder, lambda run: f"<p>{run.path.name}</p>", lambda line: None)
    return folder


def test_a_site_replaces_an_earlier_one_and_no_other_files(board: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    for _ in range(2):
        written = page.write_site(board, site, None, lambda line: None)
    assert written[-1] == site / "index.html"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "index.html").write_text("mine")
    for place in (tmp_path / "mine", tmp_path / "mine" / "index.html"):
        with pytest.raises(TsbenchError, match="nothing is overwritten: give another folder"):
            page.write_site(board, place, None, lambda line: None)
    assert (tmp_path / "mine" / "index.html").read_text() == "mine"


def test_a_site_loses_the_pages_of_entries_that_are_gone(board: Path, tmp_path: Path) -> None:
    """And nothing else that lies in it."""
    site, other = tmp_path / "site", tmp_path / "board"
    page.write_site(board, site, lambda run: "<p></p>", lambda line: None)
    (site / TASK / "ten" / "notes.txt").write_text("mine")
    (site / TASK / "mine").mkdir()
    (site / TASK / "mine" / "index.html").write_text("mine")
    shutil.copytree(board, other)
    for name in ("one", "ten"):
        entry = other / "v1" / TASK / name
        verify.record(other, entry, verify.retracted(entry, "a bug"))
    add(other, "two", [RUN])
    (site / "index.html").unlink()  # as of a command that broke off before its end
    written = page.write_site(other, site, None, lambda line: None)
    left = {site / TASK / "ten" / "notes.txt", site / TASK / "mine" / "index.html"}
    assert {path for path in site.rglob("*") if path.is_file()} == {*written, *left}
    assert not (site / TASK / "one").exists()


def test_texts_of_an_entry_are_nothing_but_text(site: Path) -> None:
    for path in site.rglob("index.html"):
        text = path.read_text()
        assert EVIL not in text
        assert "'\"><b>" not in text
        assert "default-src 'none'" in text
        assert not re.search(r"(src=|@import|url\()", text)
    own = (site / TASK / "ten" / "index.html").read_text()
    assert "&lt;script&gt;alert(1)" in own
    assert 'href="seed3.html"' in own
    assert (site / TASK / "ten" / "seed3.html").read_text() == "<p>seed3</p>"
    manifest = (site / TASK / "ten" / "manifest.json").read_bytes()
    assert submission.Manifest.decode(manifest).described.entry == "ten"


def test_a_site_says_what_a_mean_the_oracle_and_a_time_are(site: Path) -> None:
    index = (site / "index.html").read_text()
    assert f'<p class="quiet">{page.ORACLE.replace(chr(39), "&#39;")}</p>' in index
    assert ">time</button>" in index
    assert re.search(r'<td class="minor" data-value="[\d.]+">\d+:\d\d</td>', index)
    of_all = rf"\d+ of {V1.perturbed} starts"
    one, ten = ((site / TASK / name / "index.html").read_text() for name in ("one", "ten"))
    assert re.search(rf"best known; solves {of_all}\. 1\s", one)
    assert re.search(rf"best known; its trainings solve {of_all} on average\. 10\s", ten)


def test_the_guide_leaves_the_same_claims_as_an_entry_s_page() -> None:
    """Every state, in order, in the words of the page."""
    guide = (BOARD.parent / "docs" / "leaderboard.md").read_text()
    _, _, after = guide.partition("## What stays a claim")
    rows = re.findall(r"^\| (.+) \| (.+) \|$", after.partition("\n## ")[0], re.MULTILINE)
    assert rows[1:] == [(state, verify.CLAIMS[state]) for state in verify.STATES]
