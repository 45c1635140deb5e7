"""The board as people read it: a static site without any network, and tables in Markdown.

Every text from an entry passes through jinja2's escaping, and every page forbids the browser to
load anything from elsewhere.
"""

from __future__ import annotations

import importlib.resources
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from tsbench import tasks
from tsbench.core.errors import TsbenchError, os_errors
from tsbench.core.files import taken, write_whole
from tsbench.core.words import duration, number, short
from tsbench.evaluation.protocol import V1
from tsbench.evaluation.references import stored
from tsbench.evaluation.statistics import RANKED_SEEDS, Aggregate, aggregate
from tsbench.evaluation.words import FIGURES
from tsbench.leaderboard import recipe
from tsbench.leaderboard.kept import MANIFEST
from tsbench.leaderboard.submission import Entry, read_entry
from tsbench.leaderboard.verify import (
    CLAIMS,
    RETRACTED,
    STATES,
    Verdict,
    as_markdown,
    entries,
    recorded,
)
from tsbench.runs.directory import RunDirectory

MARK = b'<meta name="generator" content="tsbench leaderboard">'  # of the pages of a site
Report = Callable[[RunDirectory], str]  # makes the page of a training: 3-D view and figures

STANDINGS = {
    "ranked": "with a 95 % interval",
    "provisional": "provisional: dots without an interval",
    "too few": "too few for an interval",
}


@dataclass(frozen=True)
class Row:
    """An entry as the tables show it; figures are means over its trainings.

    Attributes:
        entry: the entry.
        state: the last state that it has passed.
        passed: whether the board says of nothing that it failed.
        reasons: why.
        reward: solved_reward over the training seeds.
        share: of the best reward that the board or a plan has.
        figures: by name: normalized_reward, success, survival and recovery, and the first measure.
        cost: environment steps, physics steps and seconds of one training.
        surface: share of pushes survived, by force and heading, shape (forces, headings).
        forces: of the surface in newtons.
    """

    entry: Entry
    state: str
    passed: bool
    reasons: tuple[str, ...]
    reward: Aggregate
    share: float
    figures: dict[str, float | None]
    cost: tuple[float, float, float]
    surface: np.ndarray
    forces: tuple[float, ...]

    @property
    def name(self) -> str:
        return self.entry.manifest.described.entry

    @property
    def label(self) -> str:
        """What the board says of it."""
        return self.state if self.passed else f"{self.state}, then FAILED"

    @property
    def style(self) -> str:
        """The class of the label's style; "" for the plain one."""
        if not self.passed:
            return "failed"
        return "" if self.state in ("submitted", "replayed") else "checked"

    @property
    def claims(self) -> str:
        """What nobody has verified, in words."""
        return CLAIMS[self.state]

    @property
    def complete(self) -> bool:
        """Whether all trainings are kept."""
        manifest = self.entry.manifest
        return len(manifest.described.seeds_trained) == len(manifest.trainings)

    @property
    def standing(self) -> str:
        """How sure the reward is, in words."""
        words = STANDINGS[self.reward.standing]
        return words if self.complete else f"not all that were trained; {words}"


ORACLE = (
    "oracle: the best plan known, as if physics followed it exactly. The planner's speed limits "
    "bind it and do not bind physics, so an entry may earn more."
)


COLUMNS = (
    "solved_reward: the interquartile mean over an entry's trainings, from "
    f"{RANKED_SEEDS} on with a 95 % interval; the other figures are means over them. of the best "
    "known: solved_reward over the largest one of the task, be it an entry's or the oracle's. "
    "steps, time: of one training. state: the last step of tsbench verify that the entry has "
    f"passed, of {', '.join(STATES)}; entries that FAILED another step stand last. tuning trials: "
    "choices of settings that were tried before. seeds: trainings that are kept."
)


@dataclass(frozen=True)
class Table:
    """A task's rows, best first, and the references beside them.

    Attributes:
        task: name of the task.
        best: solved_reward of the oracle; 0 where none is stored.
        measure: name of the measure that a column shows, and what it says.
        rows: the entries.
        references: rows of what needs no training, by name: the oracle, and two policies. The
            oracle has no pushes.
    """

    task: str
    best: float
    measure: tuple[str, str]
    rows: tuple[Row, ...]
    references: dict[str, dict[str, Any]]

    @property
    def most(self) -> float:
        """The largest solved_reward, for bars."""
        return max([self.best, *(max(row.reward.scores[self.task]) for row in self.rows)])


def tables(board: Path) -> tuple[list[Table], list[str]]:
    """All tables of a board, and why an entry is in none, one line each.

    Raises:
        TsbenchError: a verdict is damaged.
    """
    found: dict[str, list[tuple[Entry, Verdict | None]]] = {}
    left_out = []
    for path in entries(board):
        try:
            entry = read_entry(path)
        except TsbenchError as error:
            left_out.append(str(error))
            continue
        verdict = recorded(board, path)
        if verdict is not None and verdict.state == RETRACTED:
            left_out.append(f"{entry.name}: {'; '.join(verdict.reasons)}")
            continue
        found.setdefault(entry.manifest.task, []).append((entry, verdict))
    return [_table(task, found.get(task, [])) for task in tasks.names()], left_out


def _table(name: str, found: Sequence[tuple[Entry, Verdict | None]]) -> Table:
    task = tasks.make(name)
    references = dict((stored(name) or {"rows": {}})["rows"])
    best = float(references.get("oracle", {"solved_reward": 0.0})["solved_reward"])
    measure = next(iter(task.measure_notes.items()), ("", ""))
    rewards = [
        aggregate({name: {k.training.seed: k.training.claimed.solved_reward for k in entry.kept}})
        for entry, _ in found
    ]
    believed = [
        reward.iqm
        for (_, verdict), reward in zip(found, rewards, strict=True)
        if verdict is None or verdict.passed
    ]
    top = max([best, *believed])
    rows = [
        _row(entry, verdict, reward, top, measure[0])
        for (entry, verdict), reward in zip(found, rewards, strict=True)
    ]
    rows.sort(key=lambda row: (not row.passed, -row.reward.iqm, row.name))
    return Table(name, best, measure, tuple(rows), references)


def _row(entry: Entry, verdict: Verdict | None, reward: Aggregate, top: float, measure: str) -> Row:
    scores = [kept.record.score for kept in entry.kept]
    claims = [kept.training.claimed for kept in entry.kept]
    known = [one for score in scores if (one := score.perturbed.measures.get(measure)) is not None]
    names = ("normalized_reward", "success", "survival_100N", "recovery_100N")
    figures: dict[str, float | None] = {
        name: float(np.mean([getattr(claim, name) for claim in claims])) for name in names
    }
    figures["measure"] = float(np.mean(known)) if known else None
    trainings = entry.manifest.trainings
    costs = [(one.steps, one.physics_substeps, one.seconds) for one in trainings]
    steps, substeps, seconds = np.mean(costs, axis=0).tolist()
    surfaces = [np.mean(score.robustness.surface.survived, axis=-1) for score in scores]
    return Row(
        entry=entry,
        state=verdict.state if verdict else STATES[0],
        passed=verdict is None or verdict.passed,
        reasons=verdict.reasons if verdict else ("no verdict is recorded",),
        reward=reward,
        share=reward.iqm / top if top > 0.0 else 0.0,
        figures=figures,
        cost=(steps, substeps, seconds),
        surface=np.mean(surfaces, axis=0),
        forces=scores[0].robustness.surface.forces_N,
    )


def markdown(found: Sequence[Table], left_out: Sequence[str], before: str) -> str:
    """The tables in Markdown, after the text `before`."""
    lines = [before.rstrip()]
    for table in found:
        lines += ["", f"## {table.task}", ""]
        head = ["entry", "solved_reward", "of the best known", "success", table.measure[0]]
        head += ["survival_100N", "steps", "time", "state", "tuning trials", "seeds"]
        lines += [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
        for row in table.rows:
            figures, (steps, _, seconds) = row.figures, row.cost
            trials = row.entry.manifest.described.tuning_trials
            reward = number(row.reward.iqm)
            if row.reward.interval:
                low, high = row.reward.interval
                reward += f" ({low:.3g} to {high:.3g})"
            cells = [
                row.name, reward, f"{row.share:.0%}", number(figures["success"]),
                number(figures["measure"]), number(figures["survival_100N"]), short(steps),
                duration(seconds), row.label, "not said" if trials is None else str(trials),
                str(len(row.entry.kept)),
            ]  # fmt: skip
            lines.append(f"| {' | '.join(cells)} |")
        for name, given in table.references.items():
            cells = [
                name, number(given["solved_reward"]), "", number(given["success"]), "",
                number(given.get("survival_100N")), "", "", "reference", "", "",
            ]  # fmt: skip
            lines.append(f"| {' | '.join(cells)} |")
    lines += ["", COLUMNS, "", ORACLE]
    if left_out:
        lines += ["", "Not shown:", "", *(f"- {as_markdown(line)}" for line in left_out)]
    return "\n".join(lines) + "\n"


def plain(found: Sequence[Table], left_out: Sequence[str]) -> dict[str, Any]:
    """The tables as JSON holds them."""
    shown = [
        {
            "task": table.task,
            "best": table.best,
            "measure": table.measure[0],
            "rows": [_plain_row(row) for row in table.rows],
            "references": table.references,
        }
        for table in found
    ]
    return {"tables": shown, "left_out": list(left_out)}


def _plain_row(row: Row) -> dict[str, Any]:
    steps, substeps, seconds = row.cost
    return {
        "entry": row.name,
        "solved_reward": row.reward.iqm,
        "interval": row.reward.interval,
        "of_the_best_known": row.share,
        **row.figures,
        "steps": steps,
        "substeps": substeps,
        "seconds": seconds,
        "state": row.state,
        "passed": row.passed,
        "tuning_trials": row.entry.manifest.described.tuning_trials,
        "seeds": [kept.training.seed for kept in row.entry.kept],
    }


def write_site(
    board: Path, folder: Path, report: Report | None, tell: Callable[[str], None]
) -> list[Path]:
    """Writes the site: for each entry a page, its manifest and its reports, and `index.html` last.

    Files of an earlier site are replaced or, as those of a retracted entry, removed; no others are.

    Args:
        board: with the entries.
        folder: of the site.
        report: makes the page of a training, or None for a site without them.
        tell: takes a line before each page that takes long.

    Returns:
        The files, `index.html` last.

    Raises:
        TsbenchError: the folder holds other files, one cannot be written, or a verdict is damaged.
    """
    index = folder / "index.html"
    with os_errors(folder):
        # Without the index it is the site that was being written when a command broke off.
        own = _marked(index) if index.exists() else bool(_homes(folder))
        if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not own)):
            raise taken(folder, "other files", "give another folder by --html DIR")
    found, left_out = tables(board)
    templates = _templates()
    written: dict[Path, bytes] = {}
    one = templates.get_template("entry.html")
    for table in found:
        for row in table.rows:
            home = folder / table.task / row.name
            linked = report is not None
            remarks = {kept.training.folder: recipe.remark(kept.run) for kept in row.entry.kept}
            text = one.render(
                row=row, table=table, manifest=row.entry.manifest, reports=linked, remarks=remarks
            )
            written[home / "index.html"] = text.encode()
            written[home / MANIFEST] = (row.entry.path / MANIFEST).read_bytes()
            for kept in row.entry.kept if report else ():
                tell(f"{row.entry.name}, seed {kept.training.seed}: 3-D view and figures")
                assert report is not None
                written[home / f"{kept.training.folder}.html"] = report(kept.run).encode()
    page = templates.get_template("index.html").render(
        tables=found, left_out=left_out, figures=FIGURES, oracle=ORACLE, columns=COLUMNS,
        protocol=V1.name,
    )  # fmt: skip
    written[index] = page.encode()
    with os_errors(folder):
        for home in _homes(folder):
            for path in home.iterdir():
                if path not in written and _PAGE.fullmatch(path.name):
                    path.unlink()
            if not any(home.iterdir()):
                home.rmdir()
    for path, content in written.items():
        with os_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, content)
    return list(written)


_PAGE = re.compile(rf"index\.html|seed\d+\.html|{re.escape(MANIFEST)}")  # files of an entry


def _marked(path: Path) -> bool:
    """Whether a file is a page of a site."""
    return path.is_file() and MARK in path.read_bytes()[:2000]


def _homes(folder: Path) -> list[Path]:
    """The folders of the entries that an earlier site in that folder has."""
    return [
        page.parent
        for task in tasks.names()
        for page in (folder / task).glob("*/index.html")
        if _marked(page)
    ]


def _templates() -> Environment:
    templates = Environment(
        loader=PackageLoader("tsbench.leaderboard", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {"number": number, "short": short, "duration": duration, "soft": _soft}
    style = importlib.resources.files("tsbench.leaderboard").joinpath("templates/style.css")
    templates.globals["starts"] = V1.perturbed
    templates.globals["style"] = style.read_text("utf-8")
    return templates


def _soft(name: str) -> str:
    """A name that a browser may break after its underscores."""
    return name.replace("_", "_\u200b")
