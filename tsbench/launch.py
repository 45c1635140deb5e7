"""From the words of `tsbench run` to jobs: one run or a sweep, handed over to Hydra."""

from __future__ import annotations

import hashlib
import os
import re
import sys
import traceback
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console

from tsbench import config, run, tables
from tsbench.config import RunConfig
from tsbench.errors import Stopped, TsbenchError, memory_errors
from tsbench.files import write_json
from tsbench.record import RunDirectory, shown
from tsbench.viewer.report import write_pages

RUNS = Path("runs")
LONGEST_NAME = 200  # characters; file systems allow 255 bytes
CHECKED_JOBS = 1000  # of a sweep; later ones are checked when their turn comes
PART_OF_THE_NAME = ("task", "method", "seed", "budget", "directory", "threads", "checkpoint")
RESUME = "resume="
OWN_SEARCH_PATH = ("config_path", "config_name", "config_dir", "experimental_rerun")
NO_JOB = ("shell_completion", "hydra_help", "info")


def launch(words: Sequence[str], json: Path | None = None) -> None:
    """Does what `tsbench run WORDS` asks for; every job is checked before the first one starts.

    Args:
        words: of the command line.
        json: a file that the score of one run is written to as well.

    Raises:
        TsbenchError: the words are wrong, or runs failed. The other runs of a sweep go on.
    """
    parser = get_args_parser()
    parser.error = _refuse
    flags = parser.parse_intermixed_args(list(words))
    if any(word.startswith(RESUME) for word in words):
        if len(words) > 1:
            raise TsbenchError("resume=RUN goes on with the run's own configuration: give it alone")
        resumed = _resume(Path(words[0].removeprefix(RESUME)))
        write_json(json, shown(RunDirectory(resumed).record()))
        return
    if json is not None and flags.multirun:
        raise TsbenchError("--json is for one run; each of a sweep's has its score.json")
    if not any(getattr(flags, name) for name in (*OWN_SEARCH_PATH, *NO_JOB)):
        jobs = config.sweep(flags.overrides) if flags.multirun else [list(flags.overrides)]
        places: set[str] = set()
        for job in islice(jobs, CHECKED_JOBS):
            chosen = config.compose(job)
            run.prepare(chosen)
            if chosen.directory in places:
                raise TsbenchError(
                    f"directory={chosen.directory} would be the place of several of the sweep's "
                    "runs: without it each has its own"
                )
            if chosen.directory is not None:
                places.add(chosen.directory)

    failures: list[tuple[str, Path, Exception]] = []
    parent = os.getpid()

    @hydra.main(
        version_base=config.VERSION_BASE,
        config_path=f"pkg://{config.CONFIGURATIONS}",
        config_name="config",
    )
    def start(node: DictConfig) -> float:
        given = list(HydraConfig.get().overrides.task)
        chosen = config.parse(node)
        chosen = replace(chosen, directory=chosen.directory or str(directory(chosen, given)))
        place = RunDirectory(Path(chosen.directory or ""))
        try:
            if flags.multirun:
                reward = run.complete(chosen, given)
                finish(place.path)
                return reward
            reward = run.execute(chosen, given).normalized_reward
            finish(place.path)
            write_json(json, shown(place.record()))
            return reward
        except Exception as error:
            known = isinstance(error, TsbenchError)
            # A launcher's worker has to let the failure travel back.
            if os.getpid() != parent or not (known or flags.multirun):
                raise
            log = place.log_file
            if not known and log.exists():
                with log.open("a", encoding="utf-8") as file:
                    traceback.print_exc(file=file)
            failures.append((" ".join(given), log, error))
            return float("nan")

    options = [word for word in words if word not in flags.overrides]
    sys.argv = [sys.argv[0], *options, *config.opened(flags.overrides)]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra lets exceptions through instead of printing them
    with config.one_line_errors():
        start()
    if failures and not flags.multirun:
        raise failures[0][2]
    for name, log, error in failures:
        where = f" (log: {log})" if log.exists() else ""
        reason = str(error) if isinstance(error, TsbenchError) else repr(error)
        sys.stderr.write(f"tsbench: failed: {name}: {reason}{where}\n")
    if failures:
        raise TsbenchError(f"{len(failures)} of the sweep's runs failed (see above)")


def finish(directory: Path, console: Console | None = None) -> None:
    """Makes the pages that a finished run lacks, and tells where they are.

    Raises:
        TsbenchError: a page cannot be made. The run is finished all the same.
        Stopped: by Ctrl-C or SIGTERM.
    """
    finished = RunDirectory(directory)
    way_on = f"; the run is finished, its pages are not: tsbench report {directory}"
    try:
        with run.signals(_stop), memory_errors():
            write_pages(finished)
    except TsbenchError as error:
        raise TsbenchError(f"{error}{way_on}") from error
    except Stopped as stopped:
        raise Stopped(stopped.signal, f"{stopped}{way_on}") from None
    tables.show_places(console or Console(), finished)


def _stop(number: int) -> NoReturn:
    raise Stopped(number)


def _resume(place: Path) -> Path:
    """Goes on with a run: with its training, or with the pages of a finished one."""
    found = RunDirectory(place)
    if not found.finished or found.report_file.exists():
        run.resume(place)
    finish(place)
    return place


def directory(chosen: RunConfig, words: Sequence[str]) -> Path:
    """The standard run directory; words that are not part of its name are added to it."""
    name = f"seed{chosen.seed}-{chosen.budget}"
    for word in words:
        key = word.lstrip("+~").split("=")[0]
        if key not in PART_OF_THE_NAME:
            name += "," + re.sub(r"[^\w.=-]+", "_", word.lstrip("+~"))
    if len(name) > LONGEST_NAME:
        name = name[:LONGEST_NAME] + "-" + hashlib.sha256(name.encode()).hexdigest()[:8]
    return RUNS / chosen.task.name / str(chosen.method["name"]) / name


def _refuse(message: str) -> NoReturn:
    raise TsbenchError(f"{message} (see tsbench run --help)")
