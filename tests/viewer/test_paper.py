"""The paper's figures: their claims and figures follow from the data."""

from __future__ import annotations

import importlib
import math
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.motion import Plan
from tsbench.core.task import plannable, roadmap_space
from tsbench.planning.roadmap import find_route
from tsbench.runs import config, results
from tsbench.runs.directory import Record, RunDirectory, Stage
from tsbench.runs.execute import prepare
from tsbench.runs.provenance import write_provenance
from tsbench.runs.results import Curve, Result, Results, read
from tsbench.sim.kinematic import naive_plan, plan_along
from tsbench.viewer.paper import ladder, learning, maps, page, plans, scores
from tsbench.viewer.paper.exhibit import (
    COLOURS,
    MONOLITHIC,
    OURS,
    PRM,
    Claim,
    Verdict,
    compare,
    grouped,
    papers_group,
    solves,
)

ROOT = Path(__file__).parents[2]
ROCKET = "rocket_navigation"
Invented = Callable[[str], Record]


@pytest.fixture(name="make")
def make_fixture(invented_record: Invented) -> Callable[..., Result]:
    """A function that makes the result of a seed, with so much reward and success."""
    record = invented_record(ROCKET)

    def make(
        method: str, seed: int, reward: float, success: float = 1.0, *options: str,
        distance: float = 60.0,
    ) -> Result:  # fmt: skip
        solved = round(100 * success)
        perturbed = replace(
            record.score.perturbed, normalized_reward=reward, solved_reward=reward,
            success=solved / 100, solved=(1,) * solved + (0,) * (100 - solved),
        )  # fmt: skip
        score = replace(
            record.score, perturbed=perturbed, normalized_reward=reward, solved_reward=reward,
            success=solved / 100,
        )  # fmt: skip
        if distance != 60.0:
            options = (*options, f"task.constants.distance={distance:g}")
        words = (f"task={ROCKET}", f"method={method}", "budget=smoke", f"seed={seed}", *options)
        return Result(
            words=words, task=ROCKET, method=method, seed=seed, budget="smoke", distance=distance,
            standard=distance == 60.0, commit=None, settings="", stages=record.stages, score=score,
        )  # fmt: skip

    return make


def of(rows: Sequence[Result]) -> Results:
    return Results({row.words: row for row in rows})


def verdicts(claims: Sequence[Claim], says: str) -> list[Verdict]:
    return [claim.verdict for claim in claims if says in claim.says]


def test_a_method_has_one_colour_and_its_variants_paler_ones(make: Callable[..., Result]) -> None:
    rows = [
        make("zigzag", 0, 0.1), make(MONOLITHIC, 0, 0.1), make(OURS, 0, 0.1), make(PRM, 0, 0.1),
        make(PRM, 0, 0.1, 1.0, "method.roadmap=layered"), make(OURS, 0, 0.1, distance=24.0),
    ]  # fmt: skip
    groups = grouped(of(rows).groups())
    labels = [group.label for group in groups]
    assert labels == [OURS, OURS, PRM, f"{PRM}, roadmap=layered", MONOLITHIC, "zigzag"]
    colours = [group.colour for group in groups]
    assert colours[:3] == [COLOURS[OURS], COLOURS[OURS], COLOURS[PRM]]
    assert len(set(colours)) == 5


def test_a_variant_has_one_colour_in_all_tasks(make: Callable[..., Result]) -> None:
    """Also where a task has other variants of the method, or none without options."""
    other = replace(make(PRM, 0, 0.1, 1.0, "method.shortcut=true"), task="rocket_obstacles")
    rows = [
        make(PRM, 0, 0.1), make(PRM, 0, 0.1, 1.0, "method.roadmap=layered"),
        make(PRM, 0, 0.1, 1.0, "method.shortcut=true"),
        replace(other, words=("task=rocket_obstacles", *other.words[1:])),
    ]  # fmt: skip
    colours: dict[str, set[str]] = {}
    for group in grouped(of(rows).groups()):
        colours.setdefault(group.label, set()).add(group.colour)
    assert [len(found) for found in colours.values()] == [1, 1, 1]
    assert len(set.union(*colours.values())) == 3
    assert colours[PRM] == {COLOURS[PRM]}


def test_what_was_tuned_is_held_against_the_tuned_method(make: Callable[..., Result]) -> None:
    """Its label does not list the settings, of which there are many."""
    few, many = "method.explore=0.5", "task.training.imitate.epochs=8"
    rows = [
        make(OURS, 0, 0.1), make(OURS, 1, 0.1), make(MONOLITHIC, 0, 0.4),
        replace(make(OURS, 0, 0.3, 1.0, few, many), trials=12),
        replace(make(MONOLITHIC, 0, 0.9, 1.0, many), trials=12),
        make(PRM, 0, 0.2, 1.0, "method.shortcut=true"),
    ]  # fmt: skip
    rows += [replace(make(OURS, seed, 0.3, 1.0, few, many), trials=12) for seed in (1, 2)]
    lines = scores.table(grouped(of(rows).groups()), {ROCKET: tasks.make(ROCKET)})
    differences = {line.group.label: line.against and line.against.mean for line in lines}
    assert differences == {
        OURS: None,
        f"{OURS}, tuned": pytest.approx(0.2),
        MONOLITHIC: pytest.approx(0.3),
        f"{MONOLITHIC}, tuned": pytest.approx(0.6),
        f"{PRM}, shortcut=true": pytest.approx(0.1),
    }


def larger(row: Result) -> Result:
    """The row with the budget `paper`."""
    words = tuple(word.replace("smoke", "paper") for word in row.words)
    return replace(row, words=words, budget="paper")


def test_a_budget_is_held_against_the_same_budget_and_has_a_panel_of_its_own(
    make: Callable[..., Result],
) -> None:
    rows = [make(method, seed, 0.1) for method in (OURS, MONOLITHIC) for seed in (0, 1)]
    rows += [larger(make(OURS, 0, 0.3)), larger(make(MONOLITHIC, 0, 0.9))]
    groups = grouped(of(rows).groups())
    lines = scores.table(groups, {ROCKET: tasks.make(ROCKET)})
    differences = {line.group.label: line.against and line.against.mean for line in lines}
    ours, monolithic = f"{OURS}, budget paper", f"{MONOLITHIC}, budget paper"
    assert differences == {
        OURS: None,
        ours: pytest.approx(0.2),
        MONOLITHIC: pytest.approx(0.0),
        monolithic: pytest.approx(0.6),
    }
    curve = Curve("imitate", *np.ones((3, 2)))
    kept = replace(of(rows), curves={row.words: (curve,) for row in rows})
    exhibit = next(learning.exhibits(kept, groups, {ROCKET: tasks.make(ROCKET)}))
    titles = [panel.get_title(loc="left") for panel in exhibit.figure.axes]
    assert titles == [f"{ROCKET}, budget paper", f"{ROCKET}, budget smoke"]


def test_variants_of_a_method_are_told_apart(make: Callable[..., Result]) -> None:
    few, many = "task.training.imitate.epochs=2", "task.training.imitate.epochs=8"
    (group,) = grouped(of([make(OURS, 0, 0.1, 1.0, few)]).groups())
    assert group.label == f"{OURS}, other settings"
    rows = [make(OURS, 0, 0.1, 1.0, few, distance=24.0), make(OURS, 0, 0.1, 1.0, many)]
    labels = {group.label for group in grouped(of(rows).groups())}
    assert labels == {f"{OURS}, other settings ({word})" for word in (few, many)}


def test_any_method_has_its_own_name_and_colour(make: Callable[..., Result]) -> None:
    rows = [make(f"other{i}", 0, 0.1) for i in range(20)]
    groups = grouped(of([*rows, *(make(name, 0, 0.1) for name in COLOURS)]).groups())
    assert [group.label for group in groups] == [*COLOURS, *sorted(row.method for row in rows)]
    assert len({to_hex(group.colour) for group in groups}) == len(groups)


def test_an_order_holds_by_its_interval_and_not_by_its_mean(make: Callable[..., Result]) -> None:
    def verdict(ours: Sequence[float], theirs: Sequence[float]) -> Verdict:
        rows = [make(OURS, seed, reward) for seed, reward in enumerate(ours)]
        rows += [make(MONOLITHIC, seed, reward) for seed, reward in enumerate(theirs)]
        groups = grouped(of(rows).groups())
        (claim,) = compare(groups, ROCKET, OURS, MONOLITHIC, "better")
        return claim.verdict

    apart = [0.5 + 0.01 * seed for seed in range(10)]
    assert verdict(apart, [0.1] * 10) is Verdict.HOLDS
    assert verdict([0.1] * 10, apart) is Verdict.DIFFERS
    assert verdict([0.1, 0.9] * 5, [0.9, 0.1] * 5) is Verdict.OPEN
    assert verdict(apart[:9], [0.1] * 9) is Verdict.OPEN  # too few seeds


def test_an_order_is_told_of_one_budget(make: Callable[..., Result]) -> None:
    rows = [make(OURS, seed, 0.5) for seed in range(3)]
    rows += [larger(make(MONOLITHIC, seed, 0.1)) for seed in range(3)]
    assert not list(compare(grouped(of(rows).groups()), ROCKET, OURS, MONOLITHIC, "better"))
    rows.append(make(MONOLITHIC, 0, 0.2))
    (claim,) = compare(grouped(of(rows).groups()), ROCKET, OURS, MONOLITHIC, "better")
    assert "over 1 seed" in claim.found


def test_the_physics_steps_of_a_failed_training_are_not_drawn(make: Callable[..., Result]) -> None:
    """Nobody counted them: its curve would stand at zero."""
    stages = (Stage("imitate", 50, steps=50, physics_substeps=1000),)
    rows = [replace(make(OURS, seed, 0.5), stages=stages) for seed in (0, 1)]
    rows[1] = replace(rows[1], score=None, failure="no way")
    curve = Curve("imitate", *np.ones((3, 2)))
    kept = replace(of(rows), curves={row.words: (curve,) for row in rows})
    groups = grouped(kept.groups())
    drawn = {
        exhibit.name: {seed for _, _, seed, *_ in exhibit.rows}
        for exhibit in learning.exhibits(kept, groups, {ROCKET: tasks.make(ROCKET)})
    }
    assert drawn["learning_steps"] == {0, 1}
    assert drawn["learning_substeps"] == {0}


def test_what_the_paper_says_of_its_roadmap_is_not_said_of_another(
    make: Callable[..., Result],
) -> None:
    rows = [make(PRM, seed, 0.1, 1.0, "method.shortcut=true") for seed in range(3)]
    assert papers_group(grouped(of(rows).groups()), ROCKET, PRM) is None
    rows.append(make(PRM, 0, 0.1))
    found = papers_group(grouped(of(rows).groups()), ROCKET, PRM)
    assert found is not None
    assert found.label == PRM


def test_a_method_solves_a_task_fails_it_or_does_so_in_part(make: Callable[..., Result]) -> None:
    def verdict(successes: Sequence[float], *, good: bool) -> Verdict:
        rows = [make(OURS, seed, 0.5, share) for seed, share in enumerate(successes)]
        return solves(grouped(of(rows).groups()), "solved", good=good).verdict

    assert verdict([0.95, 1.0, 1.0], good=True) is Verdict.HOLDS
    assert verdict([0.95, 1.0, 1.0], good=False) is Verdict.DIFFERS
    assert verdict([0.94, 1.0, 1.0], good=True) is Verdict.PART
    assert verdict([0.94, 1.0, 1.0], good=False) is Verdict.PART
    assert verdict([0.94, 0.0, 0.5], good=False) is Verdict.HOLDS
    assert verdict([1.0, 1.0], good=True) is Verdict.OPEN


def test_the_table_by_hand(make: Callable[..., Result]) -> None:
    rows = [make(OURS, seed, float(seed), seed / 10) for seed in range(11)]
    rows += [make(MONOLITHIC, seed, 1.0, 0.0) for seed in (2, 4)]
    failed = make(PRM, 2, 0.0)
    rows.append(replace(failed, score=None, failure="no way"))
    groups = grouped(of(rows).groups())
    ours, prm, monolithic = scores.table(groups, {ROCKET: tasks.make(ROCKET)})
    assert (ours.solved.iqm, ours.succeeding) == (5.0, 1)
    assert ours.success == pytest.approx(0.5)
    assert ours.solved.interval is not None
    assert ours.against is None
    assert monolithic.solved.interval is None
    assert monolithic.against is not None
    assert (monolithic.against.mean, monolithic.against.interval) == (1.0 - 3.0, None)
    assert (prm.solved.iqm, prm.success, prm.succeeding) == (0.0, 0.0, 0)
    assert monolithic.p_value is None  # it is not one of the comparisons that p is corrected for
    assert scores.cells(monolithic)[2] == "2, too few"


def test_curves_of_stages_follow_each_other_on_every_axis(make: Callable[..., Result]) -> None:
    stages = (
        Stage("plan", 100, steps=100, seconds=5.0),
        Stage("imitate", 50, steps=50, physics_substeps=1000, seconds=20.0),
    )
    row = replace(make(OURS, 0, 0.5), stages=stages)
    curves = tuple(
        Curve(name, np.array([10.0, end]), np.array([1.0, 2.0]), np.array([0.1, 0.2]))
        for name, end in (("plan", 100.0), ("imitate", 50.0))
    )
    found = {
        axis.name: [x.tolist() for _, x, _ in learning.points(axis, curves, row)]
        for axis in learning.AXES
    }
    assert found == {
        "steps": [[10, 100], [110, 150]],
        "substeps": [[0, 0], [200, 1000]],
        "seconds": [[1, 2], [6, 7]],
    }


def test_how_smooth_a_plan_is_by_hand(make: Callable[..., Result]) -> None:
    """Straight at an even pace, and with a corner in the middle."""
    task = plannable(tasks.make(ROCKET))
    (group,) = grouped(of([make(OURS, 0, 0.5)]).groups())
    goal = np.array([*plannable(task).spec().site("goal").pos])[[0, 2]]

    def way(*corners: np.ndarray) -> plans.Way:
        at = np.linspace(0.0, len(corners) - 1.0, 100 * (len(corners) - 1) + 1)
        columns = [np.interp(at, range(len(corners)), column) for column in np.transpose(corners)]
        states = np.column_stack([*columns, np.zeros(len(at))])
        plan = Plan(ROCKET, task.version, 0.05, states, np.zeros(len(at) - 1))
        return plans.way(task, plan, group, 0)

    straight = way(np.zeros(2), goal)
    assert straight.length == pytest.approx(60.0, abs=1.0)
    assert straight.roughness == pytest.approx(0.0, abs=1e-6)
    assert straight.turning == pytest.approx(0.0, abs=1e-6)
    corner = way(np.zeros(2), np.array([goal[0], 0.0]), goal)
    assert corner.turning * corner.length == pytest.approx(math.pi / 2, abs=1e-6)
    assert corner.roughness > 1.0


def test_the_footsteps_of_a_plan_by_hand(make: Callable[..., Result]) -> None:
    """The hand-made trot steps evenly; the way through a roadmap does not."""
    task = plannable(tasks.make("laikago_trot"))
    plan = naive_plan(task)
    reference = task.reference(plan)
    even = plans.step_lengths(plan, reference)
    feet = reference.tracked["feet"].copy()
    swayed = replace(reference, tracked={**reference.tracked, "feet": feet})
    feet[..., 0] += 0.05 * np.sin(2.0 * reference.times)[:, None]
    assert len(even) > 8
    assert even.mean() == pytest.approx(0.34, abs=0.02)
    assert np.std(plans.step_lengths(plan, swayed)) > np.std(even) + 0.01
    stood = {**reference.tracked, "contacts": np.ones_like(reference.tracked["contacts"])}
    assert len(plans.step_lengths(plan, replace(reference, tracked=stood))) == 0

    space = roadmap_space(task, PRM)
    rough = plan_along(task, space, find_route(space, 500, 16, seed=0).points)
    ours, prm = grouped(of([make(OURS, 0, 0.5), make(PRM, 0, 0.5)]).groups())
    for theirs, verdict in ((rough, Verdict.HOLDS), (plan, Verdict.DIFFERS)):
        ways = {g: [plans.way(task, p, g, 0)] for g, p in ((ours, plan), (prm, theirs))}
        (claim,) = plans._claims(task, ways)
        assert claim.verdict is verdict


def test_the_printed_imitation_reward_is_as_sparse_as_the_task_s(
    make: Callable[..., Result], make_run: Callable[..., Path], naive_plan: Callable[[str], Plan]
) -> None:
    """It has R as a factor, so that it is not felt at the start of the plan."""
    row, path = make(OURS, 0, 0.5), make_run(ROCKET)
    found = replace(of([row]), folders={row.words: RunDirectory(path)})
    (exhibit,) = maps.exhibits(found, grouped(found.groups()))
    assert verdicts(exhibit.claims, "R is sparse") == [Verdict.HOLDS]
    dense = {
        claim.found.split(", ")[2].split(":")[0]: claim.verdict for claim in exhibit.claims[1:]
    }
    assert dense == {"progress": Verdict.HOLDS, "paper": Verdict.DIFFERS}


def test_a_ladder_says_where_a_method_fails(make: Callable[..., Result]) -> None:
    rows = [
        make(method, seed, 0.5, 1.0 if method == OURS else near, distance=distance)
        for method in (OURS, MONOLITHIC)
        for distance, near in ((24.0, 1.0), (60.0, 0.0))
        for seed in range(3)
    ]
    (exhibit,) = ladder.exhibits(grouped(of(rows).groups()))
    assert verdicts(exhibit.claims, "Two stages solve") == [Verdict.HOLDS]
    assert verdicts(exhibit.claims, "monolithic") == [Verdict.PART]
    assert "3 of 3 seeds at 24 m, 0 of 3 seeds at 60 m" in exhibit.claims[0].found
    assert len(exhibit.rows) == 12
    standard = [row for row in rows if row.standard]
    assert not list(ladder.exhibits(grouped(of(standard).groups())))


def test_a_folder_of_figures_is_complete_and_needs_nothing_else(
    tmp_path: Path, make: Callable[..., Result], make_run: Callable[..., Path]
) -> None:
    rows = [make(method, seed, 0.1) for method in (OURS, MONOLITHIC) for seed in range(3)]
    rows.append(make(PRM, 0, 0.1, 1.0, "task.constants.start_spread=3"))
    rows[-1] = replace(rows[-1], standard=False)
    found = of(rows)
    found.folders[rows[0].words] = RunDirectory(make_run(ROCKET))
    points = np.linspace(0.1, 1.0, 5)
    found.curves[rows[0].words] = (Curve("plan", 1000 * points, points, points),)
    out = tmp_path / "figures"
    lines, remarks = page.write(found, out)
    assert len(lines) == 2
    assert any("left out, since its constants were changed" in remark for remark in remarks)
    names = {
        "scores", f"heatmap_{ROCKET}", "learning_steps", "learning_substeps", "learning_seconds",
        f"plans_{ROCKET}", f"survival_{ROCKET}",
    }  # fmt: skip
    assert {path.stem for path in out.glob("*.png")} == names
    for kind in ("svg", "csv"):
        assert names <= {path.stem for path in out.glob(f"*.{kind}")}
    text = (out / "index.html").read_text("utf-8")
    assert text.count('src="data:image/png;base64,') == len(names)
    assert not re.search(r"https?://|@import", re.sub(r'src="[^"]*"', "", text))
    assert "what came out" in text
    with pytest.raises(TsbenchError, match="nothing is overwritten: give another by --out DIR"):
        page.write(found, out)


@pytest.fixture(name="puck")
def puck_fixture(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module of a plug-in's task that has neither feet nor a flat, bounded world."""
    monkeypatch.setattr(
        tasks, "_factories", {name: tasks._factories[name] for name in tasks.names()}
    )
    monkeypatch.syspath_prepend(ROOT / "examples" / "planar-puck")
    yield importlib.import_module("planar_puck.task")
    for name in ("planar_puck.task", "planar_puck"):
        del sys.modules[name]


def test_a_task_of_a_plug_in_has_the_figures_that_it_can_have(
    tmp_path: Path, make: Callable[..., Result], make_run: Callable[..., Path], puck: Any
) -> None:
    """Its words may have what TeX would read."""

    def of_puck(row: Result) -> Result:
        assert row.score is not None
        words = ("task=puck_gap", *row.words[1:])
        score = replace(row.score, origin=replace(row.score.origin, task="puck_gap"))
        return replace(row, task="puck_gap", words=words, score=score)

    rows = [of_puck(make(method, 0, 0.1)) for method in (OURS, PRM)]
    rows.append(of_puck(make(PRM, 0, 0.1, 1.0, "method.note='$\\no_such_word$'")))
    found = of(rows)
    for number, row in enumerate(rows[:2]):
        run = make_run("puck_gap", directory=f"run{number}")
        found.folders[row.words] = RunDirectory(run)
    page.write(found, tmp_path / "out")
    names = {path.stem for path in (tmp_path / "out").glob("*.png")}
    assert names == {"scores", "survival_puck_gap"}
    footed = replace(puck.PuckGap().drawing(), feet=("left",))
    strange = type("Strange", (puck.PuckGap,), {"drawing": lambda _: footed})()
    assert not list(plans.exhibits(found, grouped(found.groups()), {"puck_gap": strange}))
    (group,) = grouped(of(rows[:1]).groups())
    way = plans.way(strange, naive_plan(strange), group, 0)
    assert 2.0 < way.length < 3.0  # through the gap
    assert way.path[-1] == pytest.approx([2.0, 0.0, 0.1], abs=0.2)


def test_the_commands_keep_a_run_and_draw_it_with_a_strip(
    tmp_path: Path, make_run: Callable[..., Path]
) -> None:
    path, words = make_run("laikago_trot"), ["task=laikago_trot", "budget=smoke"]
    chosen = config.compose(words)
    write_provenance(RunDirectory(path), chosen, prepare(chosen), words)
    for command in (
        ["collect", str(path), "--out", str(tmp_path / "kept"), "--trials", "6"],
        ["figures", str(tmp_path / "kept"), "--out", str(tmp_path / "out")],
    ):
        done = subprocess.run(
            [sys.executable, "-m", "tsbench", *command], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
    assert "laikago_trot" in done.stdout
    (row,) = results.load(tmp_path / "kept").rows.values()
    assert row.trials == 6
    for name in ("strip_laikago_trot.png", "plans_laikago_trot.svg", "table.md", "index.html"):
        assert (tmp_path / "out" / name).exists(), name


def test_the_table_of_the_documentation_is_that_of_the_kept_results() -> None:
    """All its columns but the range over the seeds."""
    lines = (ROOT / "docs" / "results.md").read_text(encoding="utf-8").splitlines()
    told: dict[tuple[str, str], tuple[str, ...]] = {}
    task = ""
    for line in lines[lines.index("## What came out") : lines.index("## The paper's results")]:
        name, *rest = (cell.strip() for cell in line.strip("|").split("|"))
        if name.startswith("**") and rest:
            task = name.split("**")[1]
        elif name.startswith("`") and rest:
            label = name.replace("`", "").replace("shortcuts", "shortcut=true")
            told[task, label.replace("layered", "roadmap=layered")] = (*rest[:2], *rest[3:])
    results = read([ROOT / "results" / "paper"])
    groups = grouped([rows for rows in results.groups() if rows[0].standard])
    found = {}
    for row in scores.table(groups, {name: tasks.make(name) for name in tasks.names()}):
        _, label, seeds, solved, _, success, succeeding, less, _, steps, _, _ = scores.cells(row)
        number, letter = steps[:-1], steps[-1]
        found[row.group.task, label] = (
            seeds.partition(",")[0], solved, success, succeeding.partition(" ")[0], less,
            f"{number} {letter}",
        )  # fmt: skip
    assert len(told) == 20
    assert told == {name: found[name] for name in told}
