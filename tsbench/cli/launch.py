"""Starts the jobs of `tsbench run`: one run, or a sweep through Hydra's launcher.

A single run uses only Hydra's grammar and composition of configurations (`runs.config`). Sweeps and
Hydra's own help use the Hydra object of `hydra.core.global_hydra`, because `hydra.main` would read
the words from the command line of the process.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console

from tsbench.cli import hints, tables
from tsbench.cli.streams import loading
from tsbench.core.errors import Stopped, TsbenchError, memory_errors
from tsbench.core.files import write_json
from tsbench.core.lazy import Lazy
from tsbench.core.words import command
from tsbench.runs import config
from tsbench.runs.directory import RunDirectory, shown, standard_name
from tsbench.runs.progress import Output
from tsbench.runs.schema import ELSEWHERE, RunConfig

if TYPE_CHECKING:
    from tsbench.rl import processes
    from tsbench.runs import execute
else:  # they load torch, so a mistake in the words is told first
    processes, execute = Lazy("tsbench.rl.processes"), Lazy("tsbench.runs.execute")

RUNS = Path("runs")
CHECKED_JOBS = 1000  # jobs of a sweep checked before it starts; later ones when they start
PART_OF_THE_NAME = ("task", "method", "seed", "budget", *ELSEWHERE)
RESUME = "resume="


def launch(words: Sequence[str], json: Path | None = None) -> None:
    """Carries out `tsbench run WORDS`. Checks every job before the first one starts.

    Args:
        words: the words of the command line after `run`.
        json: a file to which the score of a single run is written too.

    Raises:
        TsbenchError: the words are wrong, or a run failed. A sweep continues after a failed run.
        Stopped: Ctrl-C or SIGTERM stopped the run.
    """
    parser, words = _parser(), hints.expanded(words)
    flags, others = parser.parse_known_intermixed_args(words)
    if others:
        hint = hints.of_flag(others[0], words)
        parser.error(f"unrecognized arguments: {' '.join(others)}{hint}")
    if not (flags.shell_completion or flags.hydra_help or flags.info):
        hints.check(flags.overrides)
    if any(word.startswith(RESUME) for word in words):
        if len(words) > 1:
            raise TsbenchError("resume=RUN goes on with the run's own configuration: give it alone")
        place = _resume(Path(words[0].removeprefix(RESUME)))
    elif flags.cfg or flags.hydra_help or flags.info or flags.shell_completion:
        _show(flags, parser)
        return
    elif flags.multirun:
        if processes.count() > 1:
            raise TsbenchError("a sweep's runs have one process each: start it without torchrun")
        if json is not None:
            raise TsbenchError("--json is for one run; each of a sweep's has its score.json")
        _sweep(flags.overrides)
        return
    else:
        chosen = placed(config.compose(flags.overrides), flags.overrides)
        with loading():
            first, train = not processes.rank(), execute.execute
        if not first:
            execute.assist(chosen)
            return
        train(chosen, _own(flags.overrides))
        place = Path(chosen.directory or "")
    write_json(json, shown(RunDirectory(place).record()))  # whether or not the pages can be made
    finish(place)


def finish(directory: Path, console: Console | None = None) -> None:
    """Shows a finished run's score, makes its missing pages, and shows their paths.

    Raises:
        TsbenchError: a page cannot be made. The run stays finished.
        Stopped: Ctrl-C or SIGTERM interrupted the making of the pages.
    """
    from tsbench.viewer.report import write_pages  # takes a second to load, before a run begins

    finished, console = RunDirectory(directory), console or Output()
    record = finished.record()
    tables.show_run(console, record, finished.task(record.task))
    way_on = f"; the run is finished, its pages are not: {command('report', directory)}"
    try:
        with execute.signals(_stop), memory_errors():
            write_pages(finished)
    except TsbenchError as error:
        raise TsbenchError(f"{error}{way_on}") from error
    except Stopped as stopped:
        raise Stopped(stopped.signal, f"{stopped}{way_on}") from None
    tables.show_places(console, finished)


def _stop(number: int) -> NoReturn:
    raise Stopped(number)


def placed(chosen: RunConfig, words: Sequence[str]) -> RunConfig:
    """The configuration with its run directory: the given one, else the standard one."""
    return replace(chosen, directory=chosen.directory or str(directory(chosen, words)))


def directory(chosen: RunConfig, words: Sequence[str]) -> Path:
    """The standard run directory. Words that change other keys are part of its name."""
    plain = [word.lstrip("+") for word in _own(words)]
    others = [word for word in plain if word.split("=")[0].strip("~") not in PART_OF_THE_NAME]
    name = standard_name(chosen.seed, chosen.budget, others)
    return RUNS / chosen.task.name / str(chosen.method["name"]) / name


def _own(words: Sequence[str]) -> list[str]:
    """The words without those that configure Hydra itself."""
    return [word for word in words if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]


def _resume(place: Path) -> Path:
    """Continues the training of an unfinished run. Of a finished one only pages may be missing.

    Returns:
        The run directory.
    """
    found = RunDirectory(place)
    if not found.finished or (found.view_file.exists() and found.report_file.exists()):
        execute.resume(place)
    return place


def _sweep(words: Sequence[str]) -> None:
    """Runs every combination of the values in the words, through Hydra's sweeper and launcher.

    A launcher composes the configuration of each job when it starts the job, perhaps on another
    machine. This function composes them all first, so that a mistake in the last job is found
    before the first job starts.
    """
    places: set[str] = set()
    for job in islice(config.sweep(words), CHECKED_JOBS):
        chosen = config.compose(job)
        execute.prepare(chosen)
        if chosen.directory in places:
            raise TsbenchError(
                f"directory={chosen.directory} would be the place of several of the sweep's "
                "runs: without it each has its own"
            )
        if chosen.directory is not None:
            places.add(chosen.directory)
    start = _Job()
    with _hydra() as hydra:
        hydra.multirun("config", start, [*config.opened(words), "hydra.mode=MULTIRUN"])
    for name, log, error in start.failures:
        where = f" (log: {log})" if log.exists() else ""
        reason = str(error) if isinstance(error, TsbenchError) else repr(error)
        sys.stderr.write(f"tsbench: failed: {name}: {reason}{where}\n")
    if start.failures:
        count = len(start.failures)
        raise TsbenchError(f"{count} of the sweep's runs failed (see above)")


@dataclass(frozen=True)
class _Job:
    """The function that Hydra's launcher calls for each job of a sweep, in this process or another.

    Attributes:
        process: identifier of the process that started the sweep.
        failures: words, log file and error of each job that failed in that process.
    """

    process: int = field(default_factory=os.getpid)
    failures: list[tuple[str, Path, Exception]] = field(default_factory=list)

    def __call__(self, node: DictConfig) -> float:
        """Completes a run and its pages. Returns its normalized reward, NaN if it failed."""
        words = list(HydraConfig.get().overrides.task)
        chosen = placed(config.parse(node, config.keys(words)), words)
        place = RunDirectory(Path(chosen.directory or ""))
        try:
            reward = execute.complete(chosen, words)
            finish(place.path)
            return reward
        except Exception as error:
            if os.getpid() != self.process:
                raise  # the launcher brings a worker's error back to the first process
            if not isinstance(error, TsbenchError) and place.log_file.exists():
                with place.log_file.open("a", encoding="utf-8") as file:
                    traceback.print_exc(file=file)
            self.failures.append((" ".join(words), place.log_file, error))
            return float("nan")


def _show(flags: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Shows the configuration or Hydra's own help, as the flags ask."""
    if flags.cfg:
        execute.prepare(config.compose(flags.overrides))
    words = flags.overrides = config.opened(flags.overrides)
    with _hydra() as hydra:
        if flags.shell_completion:
            hydra.shell_completion("config", words)
        elif flags.hydra_help:
            hydra.hydra_help("config", parser, flags)
        elif flags.info:
            hydra.show_info(flags.info, "config", words)
        else:
            hydra.show_cfg("config", words, flags.cfg, flags.package, flags.resolve)


@contextmanager
def _hydra() -> Iterator[Any]:
    """Hydra with tsbench's configurations. Its errors become TsbenchErrors of one line."""
    with (
        config.one_line_errors(),
        config.found_by_hydra(),
    ):
        yield GlobalHydra.instance().hydra


def _parser() -> argparse.ArgumentParser:
    """The parser of the words and of the supported flags, which have Hydra's names."""
    parser = argparse.ArgumentParser("tsbench run", add_help=False, allow_abbrev=False)
    parser.error = _refuse  # type: ignore[method-assign]
    parser.add_argument("overrides", nargs="*", help="key=value words")
    flag = parser.add_argument
    flag("--multirun", "-m", action="store_true", help="a sweep: run every combination of values")
    flag("--cfg", "-c", choices=("job", "hydra", "all"), help="show the configuration and stop")
    flag("--resolve", action="store_true", help="with --cfg: resolve interpolations")
    flag("--package", "-p", help="with --cfg: show this part of the configuration")
    flag("--hydra-help", action="store_true", help="show this help")
    flag("--shell-completion", "-sc", action="store_true", help="install=SHELL, uninstall=SHELL")
    topics = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
    flag("--info", "-i", nargs="?", const="all", choices=topics, help="show what Hydra has found")
    return parser


def _refuse(message: str) -> NoReturn:
    raise TsbenchError(f"{message} (see tsbench run --help)")
