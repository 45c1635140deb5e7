"""From the words of `tsbench run` to jobs: one run, or a sweep that Hydra's launcher starts.

One run needs nothing of Hydra but its grammar and its composition of configurations (`config`). For
sweeps, and to show what it knows, Hydra's own object is used, as `hydra.core.global_hydra` hands it
out: `hydra.main` would read the words from the process's own command line.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.console import Console

from tsbench.cli import tables
from tsbench.core.errors import Stopped, TsbenchError, memory_errors
from tsbench.core.files import write_json
from tsbench.runs import config, execute
from tsbench.runs.config import RunConfig
from tsbench.runs.directory import RunDirectory, shown
from tsbench.viewer.report import write_pages

RUNS = Path("runs")
LONGEST_NAME = 200  # characters; file systems allow 255 bytes
CHECKED_JOBS = 1000  # of a sweep; later ones are checked when their turn comes
PART_OF_THE_NAME = ("task", "method", "seed", "budget", "directory", "threads", "checkpoint")
RESUME = "resume="


def launch(words: Sequence[str], json: Path | None = None) -> None:
    """Does what `tsbench run WORDS` asks for; every job is checked before the first one starts.

    Args:
        words: of the command line.
        json: a file that the score of one run is written to as well.

    Raises:
        TsbenchError: the words are wrong, or runs failed. The other runs of a sweep go on.
        Stopped: by Ctrl-C or SIGTERM.
    """
    parser = _parser()
    flags = parser.parse_intermixed_args(list(words))
    if any(word.startswith(RESUME) for word in words):
        if len(words) > 1:
            raise TsbenchError("resume=RUN goes on with the run's own configuration: give it alone")
        place = _resume(Path(words[0].removeprefix(RESUME)))
    elif flags.cfg or flags.hydra_help or flags.info or flags.shell_completion:
        _show(flags, parser)
        return
    elif flags.multirun:
        if json is not None:
            raise TsbenchError("--json is for one run; each of a sweep's has its score.json")
        _sweep(flags.overrides)
        return
    else:
        chosen = placed(config.compose(flags.overrides), flags.overrides)
        execute.execute(chosen, _own(flags.overrides))
        place = Path(chosen.directory or "")
        finish(place)
    write_json(json, shown(RunDirectory(place).record()))


def finish(directory: Path, console: Console | None = None) -> None:
    """Tells what came out of a finished run, makes pages that it lacks, and says where they are.

    Raises:
        TsbenchError: a page cannot be made. The run is finished all the same.
        Stopped: by Ctrl-C or SIGTERM.
    """
    finished, console = RunDirectory(directory), console or Console()
    record = finished.record()
    tables.show_run(console, record, finished.task(record.task))
    way_on = f"; the run is finished, its pages are not: tsbench report {directory}"
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
    """The configuration with the run's directory in it: the one asked for or the standard one."""
    return replace(chosen, directory=chosen.directory or str(directory(chosen, words)))


def directory(chosen: RunConfig, words: Sequence[str]) -> Path:
    """The standard run directory; words that are not part of its name are added to it."""
    name = f"seed{chosen.seed}-{chosen.budget}"
    for word in _own(words):
        key = word.lstrip("+~").split("=")[0]
        if key not in PART_OF_THE_NAME:
            name += "," + re.sub(r"[^\w.=-]+", "_", word.lstrip("+~"))
    if len(name) > LONGEST_NAME:
        name = name[:LONGEST_NAME] + "-" + hashlib.sha256(name.encode()).hexdigest()[:8]
    return RUNS / chosen.task.name / str(chosen.method["name"]) / name


def _own(words: Sequence[str]) -> list[str]:
    """The words that are about the run, not about Hydra."""
    return [word for word in words if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]


def _resume(place: Path) -> Path:
    """Goes on with a run: with its training, or with the pages of a finished one."""
    found = RunDirectory(place)
    if not found.finished or found.report_file.exists():
        execute.resume(place)
    finish(place)
    return place


def _sweep(words: Sequence[str]) -> None:
    """Runs every combination of the values in the words, through Hydra's sweeper and launcher.

    A launcher composes the configuration of its jobs where it starts them, perhaps on another
    machine. They are composed here too, so that a mistake in the last one stops the first.
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
    """What Hydra's launcher calls for each job of a sweep, in this process or in a worker's.

    Attributes:
        process: that the sweep was started in.
        failures: words, log and error of each job that has failed in that process.
    """

    process: int = field(default_factory=os.getpid)
    failures: list[tuple[str, Path, Exception]] = field(default_factory=list)

    def __call__(self, node: DictConfig) -> float:
        """Does what is missing of a run, and returns its normalized reward; not a number for one
        that has failed."""
        words = list(HydraConfig.get().overrides.task)
        chosen = placed(config.parse(node), words)
        place = RunDirectory(Path(chosen.directory or ""))
        try:
            reward = execute.complete(chosen, words)
            finish(place.path)
            return reward
        except Exception as error:
            if os.getpid() != self.process:
                raise  # a worker has to let the failure travel back
            if not isinstance(error, TsbenchError) and place.log_file.exists():
                with place.log_file.open("a", encoding="utf-8") as file:
                    traceback.print_exc(file=file)
            self.failures.append((" ".join(words), place.log_file, error))
            return float("nan")


def _show(flags: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """What Hydra can tell about the words and itself."""
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
    """Hydra, with tsbench's configurations. What it raises becomes one line."""
    with (
        config.one_line_errors(),
        config.found_by_hydra(),
    ):
        yield GlobalHydra.instance().hydra


def _parser() -> argparse.ArgumentParser:
    """Of the words and of those of Hydra's flags that tsbench has, with Hydra's names."""
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
