"""Tuning: shared, resumed, pruned; with runs that are made up, and once with real ones."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from optuna.samplers import TPESampler

from tsbench import TsbenchError, cli, methods
from tsbench.core import plugins
from tsbench.core.errors import NotFiniteError, PlanError
from tsbench.runs import config, execute, tune
from tsbench.runs.directory import RunDirectory
from tsbench.runs.schema import RunConfig
from tsbench.runs.tune import Dimension, Study

if TYPE_CHECKING:
    from tests.conftest import Forks

KEY = "task.training.task.entropy"
WORDS = ("task=rocket_navigation", "method=monolithic", "budget=smoke")
# A plug-in's method may have no search space; it is then refused (below).
OWN = [n for n in methods.names() if methods.stages(n) and methods.provider(n) == plugins.own()]
Made = Callable[[RunConfig, Sequence[str]], None]


def study(folder: Path, **space: Dimension) -> Study:
    return Study(WORDS, space or {KEY: Dimension(0.0, 1.0)}, folder / "study")


@pytest.fixture
def scored(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[float], float]], Made]:
    """A function that makes up runs: their solved_reward is a function of the tuned setting."""

    def record(run: Any) -> Any:
        solved = json.loads((run.path / "made.json").read_text())
        return SimpleNamespace(score=SimpleNamespace(solved_reward=solved, normalized_reward=0.5))

    monkeypatch.setattr(RunDirectory, "record", record)

    def make(worth: Callable[[float], float]) -> Made:
        def run(made: RunConfig, words: Sequence[str]) -> None:
            place = Path(made.directory or "")
            place.mkdir(parents=True, exist_ok=True)
            entropy = made.task.training["task"]["entropy"]
            (place / "made.json").write_text(json.dumps(worth(entropy)))

        return run

    return make


def trials(given: Study) -> list[Any]:
    return tune._opened(given).get_trials()


def test_it_finds_the_better_settings(tmp_path: Path, scored: Any) -> None:
    """Beyond the random trials it tries settings near the best ones, of which it finds one. The
    first trial has the method's own settings, which are far away."""
    given = study(tmp_path)
    tune.tune(given, 24, run=scored(lambda entropy: 1.0 - abs(entropy - 0.3)))
    trial, spent = tune.best(given)
    assert spent == 24
    assert abs(trial.params[KEY] - 0.3) < 0.05
    first, *others = trials(given)
    assert first.params == {}
    own = config.compose(list(WORDS)).task.training["task"]["entropy"]
    assert first.value == pytest.approx(1.0 - abs(own - 0.3) + 0.5e-3)
    far = [abs(one.params[KEY] - 0.3) for one in others]
    assert sum(far[-10:]) / 10 < sum(far[:3]) / 6
    assert abs(trial.params[KEY] - 0.3) == min(far)
    assert trial.value == pytest.approx(1.0 - abs(trial.params[KEY] - 0.3) + 0.5e-3)
    made = config.compose(given.chosen(trial.params))
    assert made.task.training["task"]["entropy"] == trial.params[KEY]


def test_settings_that_are_no_better_are_not_taken(tmp_path: Path, scored: Any) -> None:
    given = study(tmp_path)
    tune.tune(given, 6, run=scored(lambda entropy: 0.5))
    trial, spent = tune.best(given)
    assert (trial.number, spent) == (0, 6)
    assert given.chosen(trial.params) == list(WORDS)


def test_settings_are_drawn_together_after_the_first_trials(
    tmp_path: Path, scored: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one, which has chosen none, would leave TPE without settings in common."""
    space = {KEY: Dimension(0.0, 1.0), "task.training.task.clip": Dimension(0.1, 0.9)}
    together, draw = [], TPESampler.sample_relative

    def noted(self: Any, shared: Any, trial: Any, search_space: Any) -> Any:
        found = draw(self, shared, trial, search_space)
        together.append(set(found))
        return found

    monkeypatch.setattr(TPESampler, "sample_relative", noted)
    given = study(tmp_path, **space)
    tune.tune(given, 6, run=scored(lambda entropy: entropy))
    random = tune.FIRST_TRIALS - 1  # after the method's own settings
    assert together == [set()] * random + [set(space)] * 2


def test_all_trials_train_with_the_same_seeds(tmp_path: Path, scored: Any) -> None:
    given, seen = study(tmp_path), []
    run = scored(lambda entropy: 0.0)

    def noted(made: RunConfig, words: Sequence[str]) -> None:
        seen.append((Path(made.directory or "").parent.name, made.seed))
        # The words that the run keeps as its command.
        assert config.compose(list(words)).identity == made.identity
        run(made, words)

    tune.tune(given, 2, run=noted)
    seeds = [tune.FIRST_SEED + i for i in range(3)]
    assert seen == [(f"trial{trial}", seed) for trial in range(2) for seed in seeds]
    assert set(seeds).isdisjoint(range(1000))


def test_a_study_goes_on_in_other_words_that_say_the_same(tmp_path: Path, scored: Any) -> None:
    tune.tune(study(tmp_path), 1, run=scored(lambda entropy: 0.0))
    words = ("task.training.task.clip=0.2", *WORDS)
    same = (*reversed(WORDS), "checkpoint=10", "loggers=[]", "threads=1")
    first = tune.prepare(list(WORDS), tmp_path / "study")
    other = tune.prepare(list(same), tmp_path / "study")
    assert tune._plain(first.words) == tune._plain(other.words) != tune._plain(words)
    given = study(tmp_path)
    assert len(trials(replace(given, words=same))) == 1
    with pytest.raises(TsbenchError, match=r"without task\.training\.task\.clip=0\.2\)"):
        trials(replace(given, words=words))


def test_unpromising_trials_end_after_the_first_seed(tmp_path: Path, scored: Any) -> None:
    given, ran = study(tmp_path), []
    worths = iter([0.9] * 12 + [0.1])

    def run(made: RunConfig, words: Sequence[str]) -> None:
        ran.append(made.seed)
        worth = next(worths)
        scored(lambda entropy: worth)(made, words)

    lines: list[str] = []
    tune.tune(given, 5, run=run, told=lines.append)
    assert len(ran) == 13
    assert lines[-1].startswith("trial 4 pruned after seed 1000000: 0.1")
    assert [trial.state.name for trial in trials(given)] == ["COMPLETE"] * 4 + ["PRUNED"]
    assert tune.best(given)[1] == 5


def test_nothing_solved_is_ordered_by_the_reward() -> None:
    worth: list[Any] = [
        SimpleNamespace(solved_reward=solved, normalized_reward=reward)
        for solved, reward in ((0.0, 0.1), (0.0, 0.9), (0.01, 0.2))
    ]
    assert sorted(worth, key=tune.value) == worth


def test_settings_that_diverge_are_a_trial_spent(tmp_path: Path, scored: Any) -> None:
    given = study(tmp_path)

    def run(made: RunConfig, words: Sequence[str]) -> None:
        if "trial0" in str(made.directory):
            raise NotFiniteError("reward is not finite", {})
        scored(lambda entropy: 0.5)(made, words)

    tune.tune(given, 2, run=run)
    assert [trial.state.name for trial in trials(given)] == ["FAIL", "COMPLETE"]


def test_a_plan_that_fails_is_worth_nothing(tmp_path: Path, scored: Any) -> None:
    """Its trial is complete: the settings are as good as their other seeds make them."""
    given = study(tmp_path)

    def run(made: RunConfig, words: Sequence[str]) -> None:
        if made.seed == tune.FIRST_SEED + 1:
            raise PlanError("the plan fails its audit")
        scored(lambda entropy: 0.6)(made, words)

    tune.tune(given, 1, run=run)
    (trial,) = trials(given)
    assert trial.state.name == "COMPLETE"
    assert trial.value == pytest.approx(2.0 / 3.0 * (0.6 + 0.5e-3))


def test_a_roadmap_without_a_way_is_worth_nothing(tmp_path: Path) -> None:
    """Real runs: the obstacles stand between start and goal, and there is no other point."""
    words = ("task=rocket_obstacles", "method=prm", "method.samples=0", "budget=smoke")
    given = Study(words, {"method.neighbours": Dimension(1, 2)}, tmp_path / "study")
    tune.tune(given, 1)
    (trial,) = trials(given)
    assert (trial.state.name, trial.value) == ("COMPLETE", 0.0)


def test_another_failure_is_resumed(tmp_path: Path, scored: Any) -> None:
    given, full = study(tmp_path), [True]
    run = scored(lambda entropy: 0.5)

    def once(made: RunConfig, words: Sequence[str]) -> None:
        if made.seed == tune.FIRST_SEED + 1 and full:
            full.clear()
            raise TsbenchError("No space left on device")
        run(made, words)

    with pytest.raises(TsbenchError, match="No space"):
        tune.tune(given, 1, run=once)
    (before,) = trials(given)
    assert before.state.name == "RUNNING"
    tune.tune(given, 1, run=once)
    (after,) = trials(given)
    assert (after.state.name, after.params) == ("COMPLETE", before.params)


def work(given: Study, count: int, gate: Path) -> None:
    """A process at work on a study, which stops in the second seed until `gate` exists."""

    def record(run: Any) -> Any:
        return SimpleNamespace(score=SimpleNamespace(solved_reward=0.5, normalized_reward=0.5))

    RunDirectory.record = record  # type: ignore[assignment,method-assign]

    def run(made: RunConfig, words: Sequence[str]) -> None:
        place = Path(made.directory or "")
        place.mkdir(parents=True, exist_ok=True)
        with (place / "by").open("a") as file:
            file.write(f"{os.getpid()}\n")
        wait(lambda: made.seed != tune.FIRST_SEED + 1 or gate.exists())
        time.sleep(0.02)

    tune.tune(given, count, run=run)


def wait(ready: Callable[[], bool]) -> None:
    until = time.monotonic() + 300
    while not ready():
        assert time.monotonic() < until, "the other process does not come so far"
        time.sleep(0.01)


def test_processes_share_a_study(tmp_path: Path, forks: Forks) -> None:
    """Two processes at once do four trials: each once, by one process, with its own values."""
    given, gate, context = study(tmp_path), tmp_path / "gate", forks.context
    workers = [context.Process(target=work, args=(given, 4, gate)) for _ in range(2)]
    for worker in workers:
        worker.start()
    second = tune.FIRST_SEED + 1
    wait(lambda: all((given.place(trial) / f"seed{second}" / "by").exists() for trial in (0, 1)))
    gate.touch()
    for worker in workers:
        worker.join(300)
    assert [worker.exitcode for worker in workers] == [0, 0]
    done = trials(given)
    assert [trial.state.name for trial in done] == ["COMPLETE"] * 4
    assert len({trial.params.get(KEY) for trial in done}) == 4
    by = [[path.read_text().split() for path in given.place(n).glob("*/by")] for n in range(4)]
    assert all(len(runs) == 3 and all(len(once) == 1 for once in runs) for runs in by)
    workers_of = [{once[0] for once in runs} for runs in by]
    assert all(len(one) == 1 for one in workers_of)
    assert workers_of[0] != workers_of[1]


def test_a_killed_process_leaves_its_trial_to_others(tmp_path: Path, forks: Forks) -> None:
    """The trial keeps its settings. What the dying process wrote last may be cut off."""
    given, gate, context = study(tmp_path), tmp_path / "gate", forks.context
    worker = context.Process(target=work, args=(given, 2, gate))
    worker.start()
    wait((given.place(0) / f"seed{tune.FIRST_SEED + 1}" / "by").exists)
    worker.kill()
    worker.join()
    (left,) = trials(given)
    assert left.state.name == "RUNNING"
    with given.journal.open("ab") as file:
        file.write(b'{"op_code":4,"worker')
    gate.touch()
    other = context.Process(target=work, args=(given, 2, gate))
    other.start()
    other.join(300)
    assert other.exitcode == 0
    done = trials(given)
    assert [trial.state.name for trial in done] == ["COMPLETE"] * 2
    assert done[0].params == left.params


def test_another_study_is_not_mixed_in(tmp_path: Path, scored: Any) -> None:
    given = study(tmp_path)
    tune.tune(given, 1, run=scored(lambda entropy: 0.5))
    wider = replace(given, space={KEY: Dimension(0.0, 2.0)})
    with pytest.raises(
        TsbenchError, match=r"holds another study \(another search space\): study=PATH"
    ):
        tune.tune(wider, 2)
    given.journal.write_bytes(b"nonsense\n" + given.journal.read_bytes())
    with pytest.raises(TsbenchError, match=r"journal\.log is damaged: "):
        tune.tune(given, 2)


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({}, "takes numbers low and high, or choices"),
        ({"low": 0, "high": 1, "choices": (1,)}, "takes numbers low and high, or choices"),
        ({"low": 2, "high": 1}, "needs low below high"),
        ({"low": 0.0, "high": 1.0, "log": True}, "with log low above 0"),
        ({"low": True, "high": 2}, "takes numbers"),
    ],
)
def test_wrong_ranges(values: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        Dimension(**values)


@pytest.mark.parametrize("method", OWN)
def test_every_range_is_a_word_of_run(method: str) -> None:
    """Both ends of every range and all choices make a configuration, all at once: no trial may
    choose what the method refuses."""
    space = tune.search_space(method)
    prepared = tune.prepare(["task=rocket_navigation", f"method={method}"])
    assert prepared.space == space
    for turn in range(max(2, *(len(one.choices) for one in space.values()))):
        values = {key: one.choices or (one.low, one.high) for key, one in space.items()}
        chosen = {key: ends[turn % len(ends)] for key, ends in values.items()}
        execute.prepare(prepared.run(0, chosen, 0))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["task=rocket_navigation", "seed=1"], "a study chooses the seed of its runs"),
        (["task=rocket_navigation", "budget=none"], "unknown budget 'none'"),
        (["method=twostage"], "task=NAME is missing"),
    ],
)
def test_wrong_words(words: list[str], line: str) -> None:
    with pytest.raises(TsbenchError, match=line):
        tune.prepare(words)


def test_what_is_given_is_not_tuned_and_what_cannot_be_tuned_says_so() -> None:
    given = tune.prepare([*WORDS, f"{KEY}=0.5"])
    assert KEY not in given.space
    with pytest.raises(TsbenchError, match=r"'nothing' cannot be tuned: .* conf/search/nothing"):
        tune.search_space("nothing")
    with pytest.raises(TsbenchError, match="there is no study in"):
        tune.best(replace(given, directory=Path("nowhere")))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ([], "trials=N is missing"),
        (["trials=0"], "trials must be a whole number from 1 to 1000000, not '0'"),
        (["trials=1", "seed=2"], "a study chooses the seed"),
        (["--best", "study=nowhere"], "there is no study in nowhere"),
    ],
)
def test_wrong_commands(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tune", *WORDS, *words]) == 2
    (shown,) = capsys.readouterr().err.splitlines()
    assert line in shown


def test_without_optuna(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "tsbench.runs.tune")
    monkeypatch.delattr("tsbench.runs.tune")
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert cli.main(["tune", *WORDS, "trials=1"]) == 2
    error = capsys.readouterr().err
    assert error == "tsbench: optuna is missing: pip install 'tsbench[tune]'\n"


def test_the_command_goes_on_after_a_kill(tmp_path: Path, forks: Forks) -> None:
    """Real runs: killed while the second seed trains, then resumed; finished runs are kept."""
    small = "task.budgets.smoke.act=512", "task.budgets.smoke.plan=512"
    words = ["tune", *WORDS, "study=s", "threads=1", *small]
    first, _ = forks.start(tmp_path, *words, "trials=1")
    runs = tmp_path / "s" / "trial0"
    wait((runs / "seed1000001" / "config.yaml").exists)
    first.kill()
    first.join()
    kept = (runs / "seed1000000" / "score.json").stat().st_mtime_ns
    done = forks.call(tmp_path, *words, "trials=1")
    assert done.returncode == 0, done.stderr
    assert (runs / "seed1000000" / "score.json").stat().st_mtime_ns == kept
    assert all((runs / f"seed{1_000_000 + i}" / "score.json").is_file() for i in range(3))
    line = done.stdout.splitlines()[-1]
    again = forks.call(tmp_path, *words, "--best", "--json", "best.json")
    assert again.stdout == f"{line}\n"
    assert again.stderr.startswith("trial 0 is the best of 1 trial, worth ")
    refused = forks.call(tmp_path, *words[:-2], "task.budgets.smoke.act=256", "--best")
    assert refused.returncode == 2
    said = f"with {' '.join(small)}, without task.budgets.smoke.act=256"
    assert said in refused.stderr
    assert "study=PATH names another folder" in refused.stderr
    figures = json.loads((tmp_path / "best.json").read_text())
    assert figures["trials"] == 1
    config.compose(line.split()[2:])
