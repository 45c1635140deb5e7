"""Tuning: which settings a method should be run with, found by Optuna's TPE.

A study is a directory: the journal of its trials, which all processes that work on it share, and
the runs of every trial. A trial is one choice of settings, run with the same training seeds as all
others. The first one has the method's own settings, so that tuning does not end with worse ones by
the luck of a few seeds. Every lock is the kernel's, so a killed process leaves none behind: whoever
comes next takes over its trial and resumes its runs.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import optuna
import yaml
from optuna.exceptions import ExperimentalWarning
from optuna.pruners import MedianPruner
from optuna.samplers import TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, Trial, TrialState

from tsbench.core import plugins
from tsbench.core.errors import NotFiniteError, PlanError, TsbenchError, os_errors
from tsbench.core.files import lock, locked
from tsbench.core.typed import typed
from tsbench.evaluation.score import Score
from tsbench.runs import config, execute
from tsbench.runs.directory import RunDirectory
from tsbench.runs.schema import RunConfig, words_of

# No final run has these seeds: those of a table count up from 0.
FIRST_SEED = 1_000_000
SEEDS = 3
# Of normalized_reward beside solved_reward: it orders trials that solve equally much, as nothing.
TIE_BREAKER = 1e-3
# Trials before TPE learns from them, and that no pruning compares yet: the method's own settings,
# and then random ones.
FIRST_TRIALS = 4

DIRECTORY = Path("studies")
Execute = Callable[[RunConfig, Sequence[str]], object]  # leaves a finished run in the directory


@dataclass(frozen=True)
class Dimension:
    """The values that a setting may take: a range, or one of some.

    Attributes:
        low: the least value; with `high` a whole number, only whole numbers are drawn.
        high: the largest value.
        log: whether values are drawn evenly in the logarithm.
        choices: the values, in place of a range.
    """

    low: Any = None
    high: Any = None
    log: bool = False
    choices: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        numbers = all(type(end) in (int, float) for end in (self.low, self.high))
        if bool(self.choices) == numbers:
            raise ValueError("takes numbers low and high, or choices")
        if numbers and not (self.low < self.high and (self.low > 0 or not self.log)):
            raise ValueError("needs low below high, and with log low above 0")

    def draw(self, trial: Trial, key: str) -> None:
        """Lets a trial choose its value, unless it has chosen."""
        if self.choices:
            trial.suggest_categorical(key, self.choices)
        elif type(self.low) is type(self.high) is int:
            trial.suggest_int(key, self.low, self.high, log=self.log)
        else:
            trial.suggest_float(key, self.low, self.high, log=self.log)

    @property
    def some(self) -> Any:
        """A value to check the key with."""
        return self.choices[0] if self.choices else self.low


@dataclass(frozen=True)
class Study:
    """What is tuned, and where.

    Attributes:
        words: of `tsbench run`, without settings of a trial.
        space: the settings that trials choose, by the word's key.
        directory: of the journal and the runs.
        threads: CPU threads of a run, None for all.
        seeds: with which each trial trains.
    """

    words: tuple[str, ...]
    space: Mapping[str, Dimension]
    directory: Path
    threads: int | None = None
    seeds: tuple[int, ...] = field(default=tuple(range(FIRST_SEED, FIRST_SEED + SEEDS)))

    @property
    def journal(self) -> Path:
        return self.directory / "journal.log"

    def chosen(self, settings: Mapping[str, Any]) -> list[str]:
        """The words of `tsbench run` for some settings."""
        return [*self.words, *(f"{key}={config.word(value)}" for key, value in settings.items())]

    def run(self, trial: int, settings: Mapping[str, Any], seed: int) -> RunConfig:
        made = config.compose([*self.chosen(settings), f"seed={seed}"])
        place = str(self.place(trial) / f"seed{seed}")
        return replace(made, directory=place, threads=self.threads)

    def place(self, trial: int) -> Path:
        """The directory of a trial's runs."""
        return self.directory / f"trial{trial}"


def prepare(words: Sequence[str], directory: Path | None = None) -> Study:
    """The study that words of `tsbench run` describe. Checks all of it and writes nothing.

    Args:
        words: task=NAME and method=NAME, and what all trials have in common.
        directory: of the study; None for studies/TASK/METHOD-BUDGET.

    Raises:
        TsbenchError: the words are wrong, the method has no search space, or the space is wrong.
    """
    keys = [override.key_or_group for override in config.parse_words(words)]
    for key in ("seed", "directory"):
        if key in keys:
            raise TsbenchError(f"a study chooses the {key} of its runs: leave out {key}=")
    made = config.compose(words)
    name = made.method["name"]
    place = directory or DIRECTORY / made.task.name / f"{name}-{made.budget}"
    space = {key: one for key, one in search_space(name).items() if key not in keys}
    if not space:
        raise TsbenchError("the words leave nothing to tune")
    common = tuple(word for word in words if not word.startswith("threads="))
    study = Study(common, space, place, made.threads)
    settings = {key: dimension.some for key, dimension in space.items()}
    execute.prepare(study.run(0, settings, FIRST_SEED))
    return study


def search_space(method: str) -> dict[str, Dimension]:
    """The settings that a method's `conf/search/NAME.yaml` names, each with its values.

    Raises:
        TsbenchError: there is no such file, or it is wrong.
    """
    for folder in plugins.configurations("search"):
        file = folder / f"{method}.yaml"
        if file.is_file():
            try:
                content = yaml.safe_load(file.read_text("utf-8"))
            except yaml.YAMLError as error:
                raise TsbenchError(f"conf/search/{method}.yaml: {error}") from None
            found: dict[str, Dimension] = typed(dict[str, Dimension], content, "search")
            return found
    raise TsbenchError(
        f"the method {method!r} cannot be tuned: its package lacks conf/search/{method}.yaml"
    )


def tune(
    study: Study,
    trials: int,
    *,
    run: Execute = execute.complete,
    told: Callable[[str], object] = lambda line: None,
) -> None:
    """Works on a study until it has `trials` trials, pruned and failed ones among them. Several
    processes can work on one study, each on trials of its own.

    Args:
        study: what is tuned.
        trials: in all, whoever works on them.
        run: executes, resumes or skips a run.
        told: receives a line for each trial that ends.

    Raises:
        TsbenchError: the directory holds another study, or a run fails for a reason that lies
            outside its settings. The trial is resumed by the next call.
        Stopped: Ctrl-C or SIGTERM stopped a run, with the same consequence.
    """
    with os_errors(study.directory):
        study.directory.mkdir(parents=True, exist_ok=True)
    shared = _opened(study)
    while True:
        with _claimed(study, shared, trials) as trial:
            if trial is None:
                return
            told(_work(study, shared, trial, run))


def best(study: Study) -> tuple[FrozenTrial, int]:
    """The best trial that was run with all seeds, and the number of trials spent.

    Raises:
        TsbenchError: there is no study, or no trial of it is complete.
    """
    if not study.journal.is_file():
        raise TsbenchError(f"there is no study in {study.directory}")
    spent = _opened(study).get_trials(deepcopy=False)
    complete = [trial for trial in spent if trial.state == TrialState.COMPLETE]
    if not complete:
        raise TsbenchError(f"no trial in {study.directory} is complete yet")
    return max(complete, key=lambda trial: (trial.value or 0.0, -trial.number)), len(spent)


def value(score: Score) -> float:
    """What a run is worth: solved_reward, by which rows are ranked, and among equals
    normalized_reward."""
    return score.solved_reward + TIE_BREAKER * score.normalized_reward


def _work(study: Study, shared: optuna.Study, trial: Trial, run: Execute) -> str:
    """Runs a trial to its end and returns a line about it."""
    values: list[float] = []
    about = f"trial {trial.number}"
    for seed in study.seeds:
        made = study.run(trial.number, trial.params, seed)
        try:
            run(made, [*study.chosen(trial.params), f"seed={seed}"])
        except NotFiniteError as error:  # these settings diverge
            shared.tell(trial, state=TrialState.FAIL)
            return f"{about} failed: {error}"
        except PlanError:  # a training that fails is worth nothing
            values.append(0.0)
        else:
            values.append(value(RunDirectory(Path(made.directory or "")).record().score))
        if len(values) == 1:
            if not shared.trials[trial.number].intermediate_values:  # else it is resumed
                trial.report(values[0], step=0)
            if len(study.seeds) > 1 and trial.should_prune():
                shared.tell(trial, state=TrialState.PRUNED)
                return f"{about} pruned after seed {seed}: {values[0]:.4g}"
    shared.tell(trial, fmean(values))
    return f"{about} is worth {fmean(values):.4g}"


def _opened(study: Study) -> optuna.Study:
    """The study in its directory, a new one if there is none.

    Raises:
        TsbenchError: the directory holds another study, or its journal is damaged.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    # As JSON gives it back, which has lists for tuples.
    space = {key: asdict(dimension) for key, dimension in study.space.items()}
    described = {"words": _plain(study.words), "seeds": study.seeds, "space": space}
    identity = json.loads(json.dumps(described))
    with locked(study.directory / "study.lock"):
        try:
            _mend(study.journal)
            backend = JournalFileBackend(str(study.journal), KernelLock(study.journal))
            shared = optuna.create_study(
                storage=JournalStorage(backend),
                study_name="tune",
                direction="maximize",
                pruner=MedianPruner(n_startup_trials=FIRST_TRIALS),
                load_if_exists=True,
            )
            known = shared.user_attrs.get("identity")
            if known is None:
                shared.set_user_attr("identity", identity)
        except (ValueError, KeyError) as error:
            raise TsbenchError(f"{study.journal} is damaged: {error}") from None
    if known is not None:
        known = known | {"words": _plain(known["words"])}  # as earlier versions wrote them
    if known not in (None, identity):
        raise TsbenchError(
            f"{study.directory} holds another study ({_differing(known, identity)}): "
            "study=PATH names another folder"
        )
    return shared


def _plain(words: Sequence[str]) -> list[str]:
    """The words that decide the trials, with the defaults of task, method and budget."""
    return [w for w in words_of(config.compose(list(words)), words) if not w.startswith("seed=")]


def _differing(known: Mapping[str, Any], identity: Mapping[str, Any]) -> str:
    """How a kept study differs from the one that is asked for."""
    words = {name: set(said["words"]) for name, said in (("its", known), ("asked", identity))}
    parts = [
        f"{what} {' '.join(sorted(more))}"
        for what, more in (
            ("with", words["its"] - words["asked"]),
            ("without", words["asked"] - words["its"]),
        )
        if more
    ]
    keys = [key for key in ("seeds", "space") if known[key] != identity[key]]
    names = {"seeds": "other seeds", "space": "another search space"}
    return ", ".join([*parts, *(names[key] for key in keys)])


@contextmanager
def _claimed(study: Study, shared: optuna.Study, trials: int) -> Iterator[Trial | None]:
    """A trial that no other process works on: one that was left unfinished, else a new one; None
    if the study has its `trials` trials."""
    trial, held = None, None
    with locked(study.directory / "study.lock"):
        known = shared.get_trials(deepcopy=False)
        for one in known:
            if one.state == TrialState.RUNNING:
                held = lock(study.place(one.number) / "lock", wait=False)
                if held is not None:
                    trial = Trial(shared, one._trial_id)
                    break
        if trial is None and len(known) < trials:
            shared.sampler = _sampler(len(known))
            trial = shared.ask()
            held = lock(study.place(trial.number) / "lock", wait=True)
        if trial is not None and (trial.number > 0 or trial.params):
            # An unfinished one may have been stopped before it had chosen all. Older studies have
            # chosen settings in their first trial too.
            for key, dimension in study.space.items():
                dimension.draw(trial, key)
    try:
        yield trial
    finally:
        if held is not None:
            os.close(held)


def _sampler(trial: int) -> TPESampler:
    """Seeded by the trial: two processes must not draw the same settings. Grouped, so that it draws
    them together although the first trial has chosen none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        return TPESampler(
            multivariate=True, group=True, n_startup_trials=FIRST_TRIALS, seed=FIRST_SEED + trial
        )


def _mend(journal: Path) -> None:
    """Drops the last line of a journal if a killed process has written only a part of it."""
    with locked(KernelLock(journal).path):
        content = journal.read_bytes() if journal.exists() else b""
        if content and not content.endswith(b"\n"):
            os.truncate(journal, content.rfind(b"\n") + 1)


class KernelLock(JournalFileOpenLock):
    """The lock of the journal; the kernel releases it when its process ends, however it ends."""

    def __init__(self, journal: Path) -> None:
        super().__init__(str(journal))
        self.path = journal.with_suffix(".lock")
        self.descriptor: int | None = None

    def acquire(self) -> bool:
        self.descriptor = lock(self.path, wait=True)
        return True

    def release(self) -> None:
        assert self.descriptor is not None
        os.close(self.descriptor)
