"""Runs many trainings side by side, and keeps their results after each of them.

    python benchmarks/study.py benchmarks/paper.txt --out results/paper --jobs 2

makes the runs of which the file has a sweep in each line: the words of `tsbench run -m`, before
them `trials=N` if their settings were tuned. What the results folder has is not run again; of the
others, finished runs are collected, and interrupted ones go on where they stopped, whatever
stopped them. A run that was begun by another version of the code begins again. Each training has
one thread and a low priority, and makes no pages. Ctrl-C, SIGTERM and `--hours` let each of them
save its state first. A plan that fails, such as a roadmap without a way, is a result: the run
counts as zero.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NoReturn

from tsbench.cli.launch import placed
from tsbench.core.errors import Stopped, TsbenchError, os_errors
from tsbench.core.files import lock
from tsbench.core.words import duration
from tsbench.runs import config, results
from tsbench.runs.directory import RunDirectory
from tsbench.runs.execute import complete, prepare
from tsbench.runs.provenance import check_provenance
from tsbench.runs.schema import RunConfig, words_of

TRIALS = "trials="
WORK = "--work"  # what a process of this file is given that trains
NICE = 15
PAUSE = 1.0  # seconds between looks at the trainings


@dataclass(frozen=True)
class Job:
    """A training of the study.

    Attributes:
        given: words of `tsbench run`.
        chosen: the configuration that they make, with its directory.
        trials: that were spent on tuning its settings, None where the file does not say.
    """

    given: tuple[str, ...]
    chosen: RunConfig
    trials: int | None

    @property
    def words(self) -> tuple[str, ...]:
        return words_of(self.chosen, self.given)

    @property
    def run(self) -> RunDirectory:
        return RunDirectory(Path(self.chosen.directory or ""))


@dataclass(frozen=True)
class Training:
    """A job that is being done: its process, what that says, and when it began."""

    job: Job
    process: subprocess.Popen[bytes]
    said: IO[bytes]
    began: float


def read_jobs(path: Path) -> list[Job]:
    """The trainings of a study's file, in its order.

    Raises:
        TsbenchError: a line cannot be read, or does not make valid configurations.
    """
    with os_errors(path):
        lines = path.read_text(encoding="utf-8").splitlines()
    found: dict[tuple[str, ...], Job] = {}
    for number, line in enumerate(lines, 1):
        try:
            for job in _jobs(shlex.split(line, comments=True)):
                found.setdefault(job.words, job)
        except (TsbenchError, ValueError) as error:
            raise TsbenchError(f"{path}, line {number}: {error}") from None
    return list(found.values())


def _jobs(words: Sequence[str]) -> Iterator[Job]:
    trials = None
    if words and words[0].startswith(TRIALS):
        trials, words = int(words[0].removeprefix(TRIALS)), words[1:]
        if not words:
            raise TsbenchError(f"nothing follows {TRIALS}{trials}; words of `tsbench run` should")
    for word in words:
        if word.partition("=")[0] in ("directory", "threads"):
            raise TsbenchError(f"a study chooses the directory and the threads: leave out {word}")
    for given in config.sweep(words) if words else ():
        chosen = placed(config.compose(given), given)
        prepare(chosen)
        yield Job(tuple(given), chosen, trials)


class Study:
    """The trainings that are left to do, and those that are being done."""

    def __init__(self, jobs: Sequence[Job], out: Path) -> None:
        """
        Args:
            jobs: all trainings of the study.
            out: the results folder.
        """
        rows = results.load(out).rows if (out / results.ROWS).exists() else {}
        self.waiting = deque(job for job in jobs if job.words not in rows)
        self.running: list[Training] = []
        self.failed = 0
        self._stopping = False
        self._out = out
        self._total = len(jobs)
        self._began = time.monotonic()

    def work(self, slots: int, hours: float | None) -> None:
        """Does the trainings, so many at a time, until none is left or the hours are over."""
        while self.waiting or self.running:
            for training in [one for one in self.running if one.process.poll() is not None]:
                self.running.remove(training)
                self._finish(training)
            for _ in range(len(self.waiting)):
                if len(self.running) < slots:
                    self._start(self.waiting.popleft())
            if hours is not None and time.monotonic() - self._began > 3600.0 * hours:
                self._tell(f"the {hours:g} hours are over")
                self.stop()
                return
            time.sleep(PAUSE)

    def stop(self) -> None:
        """Lets all trainings save their state, waits until they have, and keeps what is finished.

        Raises:
            TsbenchError: a result cannot be kept.
        """
        self._stopping = True
        for training in self.running:
            training.process.send_signal(signal.SIGTERM)
        for training in self.running:
            training.process.wait()
        stopped, self.running = self.running, []
        for training in stopped:
            self._finish(training)

    def _start(self, job: Job) -> None:
        """Starts a training, unless another process is still at work on it: then it waits."""
        run = job.run
        if run.begun:
            if _busy(run.path):
                self.waiting.append(job)
                return
            if self._collect(job, "was there already"):
                return
            try:
                check_provenance(run, job.chosen, prepare(job.chosen))
            except TsbenchError as error:
                self._tell(f"{job.run.path} begins again: {error}")
                shutil.rmtree(run.path)
        said = tempfile.TemporaryFile()  # noqa: SIM115  it lives as long as the process
        command = [sys.executable, __file__, WORK, *job.given]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        # In a session of its own: of two signals, the terminal's Ctrl-C and that of `stop`, the
        # second would end a training before its state is saved.
        process = subprocess.Popen(
            command, stdout=said, stderr=said, env=environment, start_new_session=True
        )
        self.running.append(Training(job, process, said, time.monotonic()))

    def _finish(self, training: Training) -> None:
        job, seconds = training.job, time.monotonic() - training.began
        training.said.seek(0)
        lines = training.said.read().decode(errors="replace").strip().splitlines()
        training.said.close()
        if self._collect(job, f"after {duration(seconds)}"):
            return
        status = training.process.returncode
        if self._stopping and status in (128 + signal.SIGTERM, -signal.SIGTERM):
            self._tell(f"stopped: {' '.join(job.words)}")
            return
        why = lines[-1] if lines else f"status {status}"
        if status < 0:  # such as SIGKILL, where memory runs out
            why = f"killed by {signal.Signals(-status).name}"
        self.failed += 1
        self._tell(f"failed: {' '.join(job.words)}: {why}")

    def _collect(self, job: Job, when: str) -> bool:
        """Keeps the result of a run. Returns whether there is one."""
        found = results.of_run(job.run) if job.run.begun else None
        if found is None:
            return False
        kept = results.collect(found, self._out, job.trials)
        row = kept.rows[job.words]
        worth = f"solves {row.success:.0%}, solved_reward {row.solved_reward:.3f}"
        self._tell(f"{' '.join(job.words)}: {row.failure or worth}, {when}")
        return True

    def _tell(self, line: str) -> None:
        done = self._total - len(self.waiting) - len(self.running)
        now = time.strftime("%Y-%m-%d %H:%M:%S")
        sys.stdout.write(f"{now} [{done} of {self._total}] {line}\n")
        sys.stdout.flush()


def _busy(directory: Path) -> bool:
    """Whether a process has the run, such as one that a killed study has left behind."""
    descriptor = lock(directory, wait=False)
    if descriptor is not None:
        os.close(descriptor)
    return descriptor is None


def train(given: Sequence[str]) -> int:
    """What a training's process does. Returns its exit status."""
    os.nice(NICE)
    try:
        chosen = placed(config.compose([*given, "threads=1"]), given)
        complete(chosen, given)
    except TsbenchError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except Stopped as stopped:
        return 128 + stopped.signal
    return 0


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def main(arguments: Sequence[str]) -> int:
    if arguments[:1] == [WORK]:
        return train(arguments[1:])
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("study", type=Path, metavar="FILE", help="a sweep in each line")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="results folder")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="side by side (all cores)")
    parser.add_argument("--hours", type=float, help="stop after so many")
    parser.add_argument("--list", action="store_true", help="name what is left to do, and stop")
    options = parser.parse_args(arguments)
    try:
        study = Study(read_jobs(options.study), options.out)
        if options.list:
            lines = (f"tsbench run {' '.join(job.words)}\n" for job in study.waiting)
            sys.stdout.write("".join(lines))
            return 0
        try:
            study.work(max(options.jobs, 1), options.hours)
        except KeyboardInterrupt:
            return 130
        finally:
            study.stop()
    except TsbenchError as error:
        sys.stderr.write(f"study: {error}\n")
        return 2
    return 1 if study.failed else 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _interrupt)
    sys.exit(main(sys.argv[1:]))
