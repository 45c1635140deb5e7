"""Results of many trainings, kept as data: a line for each run, thin curves, and a few policies.

A results folder has

- `runs.jsonl`: a line for each run: its words, what it used, and its whole score;
- `curves.npz`: the learning curves, at most `POINTS` points for each stage;
- `policies/`: policy, plan and configuration of the best, the median and the worst seed of each
  group of runs that differ in their seed alone.

It is enough to make the paper's figures again. `collect` adds runs to it, and may be called after
each of them: a line is replaced by a newer run with the same words, and every other line is kept.
"""

from __future__ import annotations

import hashlib
import io
import json
import shlex
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from tsbench import tasks
from tsbench.core.errors import TsbenchError, os_errors
from tsbench.core.files import locked, parse_json, read_file, write_whole
from tsbench.core.motion import DAMAGE
from tsbench.core.typed import typed
from tsbench.core.words import command
from tsbench.evaluation.score import Score
from tsbench.runs.directory import (
    MAX_SCORE,
    RunDirectory,
    Stage,
    curve_points,
    read_metrics,
    standard_name,
    thin,
)
from tsbench.runs.schema import words_of

ROWS = "runs.jsonl"
CURVES = "curves.npz"
POLICIES = "policies"
MEASURE = "normalized_return"  # of `metrics.jsonl`
COMMAND = "tsbench run "  # begins a run's command
CONSTANTS = "task.constants."
# Limits of the files, in bytes. The curves of a stage are 2.4 KB.
MAX_ROWS = 2_000 * MAX_SCORE
MAX_CURVES = 2**28


@dataclass(frozen=True)
class Curve:
    """The learning curve of a stage.

    Attributes:
        stage: the method's name for the stage.
        steps: environment steps since the stage began, shape (n,).
        seconds: the same, shape (n,).
        returns: mean return of the training episodes over the largest conceivable one of the
            stage's own reward, shape (n,).
    """

    stage: str
    steps: np.ndarray
    seconds: np.ndarray
    returns: np.ndarray


@dataclass(frozen=True)
class Result:
    """A finished training, or one that ended with a plan that fails its audit or with none.

    Attributes:
        words: that `tsbench run` makes it with, without those that change no result.
        task: name of the task.
        method: name of the method.
        seed: of the training.
        budget: its name.
        distance: of the goal from the start in metres.
        standard: whether the task had its standard constants.
        commit: of tsbench's checkout; "+" at its end says that files were changed.
        settings: hash of the settings, so that runs with the same words but other settings can be
            told apart.
        stages: what each stage used.
        score: of the policy; None if there is none, since its plan failed.
        failure: why there is no policy; "" if there is one.
        trials: that were spent on tuning the settings.
    """

    words: tuple[str, ...]
    task: str
    method: str
    seed: int
    budget: str
    distance: float
    standard: bool
    commit: str | None
    settings: str
    stages: tuple[Stage, ...]
    score: Score | None
    failure: str = ""
    trials: int = 0

    def __post_init__(self) -> None:
        if (self.score is None) != bool(self.failure):
            raise ValueError("score or failure: a result has one of them")

    @property
    def command(self) -> str:
        """That makes the run again."""
        return command("run", *self.words)

    @property
    def options(self) -> tuple[str, ...]:
        """The words beside task, method, seed, budget and the task's constants."""
        known = ("task=", "method=", "seed=", "budget=", CONSTANTS)
        return tuple(word for word in self.words if not word.lstrip("+~").startswith(known))

    @property
    def kind(self) -> tuple[str, ...]:
        """The words without the seed: what runs that differ in their seed alone share."""
        return tuple(word for word in self.words if not word.startswith("seed="))

    # A training whose plan fails is a training that failed: it counts as zero in every mean.

    @property
    def solved_reward(self) -> float:
        return self.score.solved_reward if self.score else 0.0

    @property
    def normalized_reward(self) -> float:
        return self.score.normalized_reward if self.score else 0.0

    @property
    def success(self) -> float:
        """Share of the perturbed starts solved."""
        return self.score.success if self.score else 0.0

    @property
    def steps(self) -> int:
        """Environment steps of all stages."""
        return sum(stage.steps for stage in self.stages)


@dataclass(frozen=True)
class Results:
    """Attributes:
    rows: by their words.
    curves: of each stage in order, by the words of the run; perhaps of runs without a row.
    folders: where the policies are that are at hand, by the words of the run.
    """

    rows: dict[tuple[str, ...], Result] = field(default_factory=dict)
    curves: dict[tuple[str, ...], tuple[Curve, ...]] = field(default_factory=dict)
    folders: dict[tuple[str, ...], RunDirectory] = field(default_factory=dict)

    def update(self, other: Results) -> None:
        """Adds the other's results, which replace those with the same words."""
        for name in other.rows:
            self.curves.pop(name, None)
            self.folders.pop(name, None)
        self.rows.update(other.rows)
        self.curves.update(other.curves)
        self.folders.update(other.folders)

    def groups(self) -> list[list[Result]]:
        """The results whose words differ in the seed alone, each group by seed."""
        found: dict[tuple[str, ...], list[Result]] = {}
        for row in sorted(self.rows.values(), key=lambda row: (row.kind, row.seed)):
            found.setdefault(row.kind, []).append(row)
        return list(found.values())


def read(paths: Sequence[Path]) -> Results:
    """The results in run directories, entries and results folders, and in all folders below the
    given ones. Of results with the same words the last one counts.

    Raises:
        TsbenchError: a path holds none of them, or a file is missing or damaged.
    """
    found = Results()
    for path in paths:
        if not path.is_dir():
            raise TsbenchError(f"there is no directory {path}")
        parts = list(_parts(path))
        if not parts:
            raise TsbenchError(
                f"{path} holds no finished run, no entry and no results of tsbench (an entry of "
                "another library has no config.yaml)"
            )
        for part in parts:
            found.update(part)
    return found


def _parts(path: Path) -> Iterator[Results]:
    if (path / ROWS).is_file():
        yield load(path)
    elif (run := RunDirectory(path)).begun:
        if (result := of_run(run)) is not None:
            yield result
    else:
        for folder in sorted(one for one in path.iterdir() if one.is_dir()):
            yield from _parts(folder)


def of_run(run: RunDirectory) -> Results | None:
    """The result of a run or entry alone; None while it is unfinished.

    Raises:
        TsbenchError: a file is missing or damaged.
    """
    if not (run.finished or run.failure):
        return None
    result = _result(run)
    curves = {result.words: read_curves(run.metrics_file)}
    return Results({result.words: result}, curves, {result.words: run})


def _result(run: RunDirectory) -> Result:
    config, record = run.config(), run.record() if run.finished else None
    task = run.task(config.task.name)
    settings = {
        "budget": asdict(config.task.budgets[config.budget]),
        "training": config.task.training,
        "constants": config.task.constants,
        "method": config.method,
    }
    return Result(
        words=words_of(config, _words(run.command.removeprefix(COMMAND))),
        task=task.name,
        method=config.method["name"],
        seed=config.seed,
        budget=config.budget,
        distance=round(float(task.goal_distance(task.ideal())[0]), 6),
        standard=tasks.standard(task),
        commit=run.versions().get("commit"),
        settings=hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16],
        stages=record.stages if record else _stages(run),
        score=record.score if record else None,
        failure=run.failure,
    )


def _words(line: str) -> list[str]:
    """The words of a command. Older runs have them without quotes."""
    try:
        return shlex.split(line)
    except ValueError:
        return line.split()


def _stages(run: RunDirectory) -> tuple[Stage, ...]:
    """What the stages of a run without a score have used, by the last line of each in its metrics,
    which tell neither their budgets nor their physics steps."""
    found: dict[str, Stage] = {}
    for row in read_metrics(run.metrics_file) if run.metrics_file.exists() else ():
        try:
            name, steps, seconds = str(row["stage"]), int(row["steps"]), float(row["seconds"])
        except (KeyError, TypeError, ValueError) as error:
            raise TsbenchError(f"damaged metrics {run.metrics_file}: {error}") from None
        found[name] = Stage(name, steps, steps=steps, seconds=seconds)
    return tuple(found.values())


def read_curves(metrics: Path) -> tuple[Curve, ...]:
    """The learning curves of a run's `metrics.jsonl`, thinned to `POINTS`; none without the file.

    Raises:
        TsbenchError: the file is damaged.
    """
    if not metrics.exists():
        return ()
    found: dict[str, list[tuple[float, float, float]]] = {}
    for stage, point in curve_points(metrics):
        if MEASURE in point:
            found.setdefault(stage, []).append((point["steps"], point["seconds"], point[MEASURE]))
    return tuple(Curve(stage, *_thinned(points)) for stage, points in found.items())


def _thinned(points: Sequence[tuple[float, float, float]]) -> np.ndarray:
    """At most `POINTS` of them, the first and the last among them, shape (3, n), as they are kept
    in the file."""
    return np.array(points, np.float32)[thin(len(points))].T


def load(place: Path) -> Results:
    """The content of a results folder.

    Raises:
        TsbenchError: a file is missing or damaged.
    """
    rows, found = place / ROWS, Results()
    for number, line in enumerate(read_file(rows, MAX_ROWS, "results").splitlines(), 1):
        try:
            result: Result = typed(Result, parse_json(line), "")
        except (ValueError, OverflowError, TsbenchError) as error:
            raise TsbenchError(f"damaged results {rows}, line {number}: {error}") from None
        found.rows[result.words] = result
    found.curves.update(_load_curves(place / CURVES))
    for result in found.rows.values():
        folder = place / POLICIES / _folder(result)
        if RunDirectory(folder).begun:
            found.folders[result.words] = RunDirectory(folder)
    return found


def _load_curves(path: Path) -> dict[tuple[str, ...], tuple[Curve, ...]]:
    if not path.exists():
        return {}
    found: dict[tuple[str, ...], tuple[Curve, ...]] = {}
    content = io.BytesIO(read_file(path, MAX_CURVES, "curves"))
    try:
        with np.load(content, allow_pickle=False) as file:
            for name in file.files:
                *words, stage = shlex.split(name)
                if not (words and words[0].startswith("task=")):
                    raise TsbenchError(f"{path} holds no learning curves of tsbench: {name!r}")
                curve = Curve(stage, *file[name])
                found[tuple(words)] = (*found.get(tuple(words), ()), curve)
    except DAMAGE as error:
        raise TsbenchError(f"damaged curves {path}: {error}") from None
    return found


def collect(new: Results, place: Path, trials: int | None = None) -> Results:
    """Adds results to a results folder, which is made where there is none.

    Args:
        new: the results. Those in the folder with the same words are replaced.
        place: the folder.
        trials: that were spent on tuning the settings of the new ones; None for as many as the
            folder says.

    Returns:
        All results that the folder has now.

    Raises:
        TsbenchError: a file in the folder is damaged, or it cannot be written.
    """
    with os_errors(place):
        place.mkdir(parents=True, exist_ok=True)
    with os_errors(place), locked(place):
        # The curves are written first, so a collection that was killed may leave them alone.
        begun = (place / ROWS).exists()
        found = load(place) if begun else Results(curves=_load_curves(place / CURVES))
        for words, row in new.rows.items():
            before = found.rows.get(words, row).trials
            new.rows[words] = replace(row, trials=before if trials is None else trials)
        found.update(new)
        for group in found.groups():
            _keep_policies(found, group, place / POLICIES)
        arrays = {
            shlex.join([*words, curve.stage]): np.stack([curve.steps, curve.seconds, curve.returns])
            for words, curves in sorted(found.curves.items())
            for curve in curves
        }
        content = io.BytesIO()
        np.savez_compressed(content, allow_pickle=False, **arrays)
        write_whole(place / CURVES, content.getvalue())
        write_whole(place / ROWS, b"".join(_line(row) for g in found.groups() for row in g))
    return found


def _line(row: Result) -> bytes:
    values = {**asdict(row), "score": row.score.as_dict() if row.score else None}
    return (json.dumps(values, separators=(",", ":")) + "\n").encode()


def _keep_policies(found: Results, group: Sequence[Result], policies: Path) -> None:
    """Keeps the policies of the best, the median and the worst run, or of those next to them whose
    policies are at hand, and removes those that have been kept before and are none of these now.
    Changed tasks are for their scores alone."""
    ranked = sorted(
        (row for row in group if row.score and row.standard),
        key=lambda row: (row.solved_reward, row.normalized_reward),
    )
    at_hand = [rank for rank, row in enumerate(ranked) if row.words in found.folders]
    wanted = (0, len(ranked) // 2, len(ranked) - 1)
    chosen = {
        ranked[min(at_hand, key=lambda rank: abs(rank - place))].words
        for place in wanted
        if at_hand
    }
    for row in group:
        folder, run = policies / _folder(row), found.folders.get(row.words)
        if row.words not in chosen:
            shutil.rmtree(folder, ignore_errors=True)
            if run is not None and run.path == folder:
                del found.folders[row.words]
        elif run is not None and run.path != folder:
            part = folder.with_name(f"{folder.name}.part")
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir(parents=True)
            for path in (
                run.config_file, run.versions_file, run.policy_info_file, run.policy_file,
                run.plan_file,
            ):  # fmt: skip
                if path.exists():
                    shutil.copy(path, part / path.name)
            shutil.rmtree(folder, ignore_errors=True)
            part.rename(folder)
            found.folders[row.words] = RunDirectory(folder)


def _folder(row: Result) -> Path:
    return Path(row.task, row.method, standard_name(row.seed, row.budget, row.words[4:]))
