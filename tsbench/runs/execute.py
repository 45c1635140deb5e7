"""Executes one training run: trains, evaluates, and writes the run directory."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from tsbench import methods, tasks
from tsbench.core.errors import (
    NotFiniteError,
    PlanError,
    Stopped,
    TsbenchError,
    memory_errors,
    os_errors,
)
from tsbench.core.files import leftovers, lock, taken, write_json, write_whole
from tsbench.core.method import Problem
from tsbench.core.policy import Policy
from tsbench.core.typed import unknown_key
from tsbench.core.words import command
from tsbench.evaluation.evaluate import check_fit, evaluate
from tsbench.evaluation.protocol import SMOKE, V1
from tsbench.evaluation.score import Score
from tsbench.rl import processes
from tsbench.rl.devices import torch_device
from tsbench.rl.stages import settings
from tsbench.rl.threads import one_thread
from tsbench.runs import events
from tsbench.runs.directory import CHECKPOINTS, Record, RunDirectory, overspent
from tsbench.runs.progress import Output, progress_bar
from tsbench.runs.provenance import check_provenance, identity, write_provenance
from tsbench.runs.schema import RunConfig
from tsbench.runs.workspace import RunWorkspace


def prepare(config: RunConfig) -> Problem:
    """The problem that a configuration describes. Checks all of it and writes nothing.

    Raises:
        TsbenchError: unknown names, or values of the wrong type.
    """
    problem = Problem(
        task=tasks.checked(config.task.name, **config.task.constants),
        budget=config.task.budgets[config.budget],
        training=config.task.training,
        options=config.method,
        seed=config.seed,
        threads=config.threads,
        device=config.device,
        deterministic=config.deterministic,
    )
    torch_device(problem.device)
    events.check(config.loggers)
    name = config.method["name"]
    methods.options(methods.find(name).Options, problem)
    known = methods.all_stages()
    for kind in dict.fromkeys([*methods.stages(name), *config.task.training]):
        if kind not in known:
            raise unknown_key("task.training", kind, known)
        settings(problem, kind)
    return problem


def execute(config: RunConfig, words: Sequence[str] = (), console: Console | None = None) -> Score:
    """Trains, evaluates, and writes the run directory without its pages.

    Args:
        config: the configuration, with its directory.
        words: the words of the command line, recorded in the directory.
        console: shows progress and results.

    Raises:
        TsbenchError: the configuration is wrong, the directory exists or cannot be written, or the
            method cannot solve this kind of task. A run that fails before training leaves no files.
        Stopped: Ctrl-C or SIGTERM stopped the run.
    """
    problem = prepare(config)
    run = RunDirectory(Path(config.directory or ""))
    with os_errors(run.path):
        found = set(run.path.iterdir()) if run.path.is_dir() else None
        _create(run)
    with _locked(run.path), _explained(run):
        try:
            write_provenance(run, config, problem, words)
            line = f"{command('run', *words)} -> {run.path}"
            return _work(config, problem, run, line, console or Output())
        except (TsbenchError, OSError) as error:
            if not run.trained and not isinstance(error, (NotFiniteError, PlanError)):
                _leave_as_found(run.path, found)
            raise


def assist(config: RunConfig) -> None:
    """Trains with the first of several processes, which executes the run. Leaves no files.

    Raises:
        TsbenchError: as `execute`.
    """
    problem = prepare(config)
    method = methods.find(config.method["name"])
    with tempfile.TemporaryDirectory() as folder:
        workspace = RunWorkspace(Path(folder), Console(quiet=True), interval=config.checkpoint)
        together = processes.together(torch_device(problem.device))
        with closing(workspace), memory_errors(), one_thread(), together:
            method.train(problem, workspace)


def resume(directory: Path, console: Console | None = None) -> Score:
    """Continues an interrupted run, and ends with the same bits as an uninterrupted run.

    Raises:
        TsbenchError: the run does not exist, is finished or is running, was begun with another
            configuration or other versions, or would be written through a link. Beyond that, as
            `execute`.
        PlanError: the run has ended with a plan that fails, as it would again.
        Stopped: Ctrl-C or SIGTERM stopped the run.
    """
    run = RunDirectory(directory)
    if processes.count() > 1:
        raise TsbenchError("a run of several processes cannot be resumed: begin it again")
    if not run.begun:
        raise TsbenchError(f"there is no run in {directory}")
    with _locked(directory):
        if run.finished:
            raise TsbenchError(f"{directory} holds a finished run: there is nothing to resume")
        if run.failure:
            raise PlanError(f"{directory} cannot go on: {run.failure}")
        config = replace(run.config(), directory=str(directory))
        problem = prepare(config)
        check_provenance(run, config, problem)
        for name in (CHECKPOINTS, *events.LOGGERS):  # in whose folders files are replaced
            if (run.path / name).is_symlink():
                raise TsbenchError(f"{run.path / name} is a link: put the folder in its place")
        with _explained(run):
            for folder in (run.path, run.checkpoints):
                for path, _ in leftovers(folder) if folder.is_dir() else ():
                    path.unlink(missing_ok=True)
            line = command("run", f"resume={directory}")
            return _work(config, problem, run, line, console or Output())


def complete(config: RunConfig, words: Sequence[str] = ()) -> float:
    """Executes or resumes a run of a sweep; skips a finished one.

    Returns:
        The normalized reward of the run.

    Raises:
        TsbenchError: the directory holds another run. Beyond that, as `execute` and `resume`.
        Stopped: Ctrl-C or SIGTERM stopped the run.
    """
    run = RunDirectory(Path(config.directory or ""))
    if not run.begun:
        return execute(config, words).normalized_reward
    if run.config().identity != config.identity:
        raise taken(run.path, "a run with another configuration")
    if run.finished:
        Console().print(f"finished already: {run.path}", highlight=False, soft_wrap=True)
        return run.record().score.normalized_reward
    return resume(run.path).normalized_reward


def _work(
    config: RunConfig, problem: Problem, run: RunDirectory, line: str, console: Console
) -> Score:
    said = json.dumps(identity(config, problem), sort_keys=True)
    workspace = RunWorkspace(
        run.path,
        console,
        interval=config.checkpoint,
        run=hashlib.sha256(said.encode()).hexdigest(),
        loggers=config.loggers,
    )
    with closing(workspace), signals(workspace.stop), memory_errors(), one_thread():
        workspace.note(line)
        record = _train(config, problem, workspace, console)
        write_json(run.score_file, record.as_dict())  # last: its presence says: run finished
    shutil.rmtree(run.checkpoints, ignore_errors=True)
    return record.score


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Has the lock of the run directory.

    Raises:
        TsbenchError: another process has the lock.
    """
    with os_errors(directory):
        descriptor = lock(directory, wait=False)
    if descriptor is None:
        raise TsbenchError(f"another process is at work in {directory}")
    try:
        yield
    finally:
        os.close(descriptor)


@contextmanager
def signals(stop: Callable[[int], None]) -> Iterator[None]:
    """Lets Ctrl-C and SIGTERM call `stop` with their number, if this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {
        number: signal.signal(number, lambda number, _: stop(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _explained(run: RunDirectory) -> Iterator[None]:
    """Turns the error that stops a run into one line, and adds how to resume where possible."""
    try:
        with os_errors(run.path):
            yield
    except NotFiniteError as error:
        raise NotFiniteError(f"{error}{_dumped(run.dump_file, error)}", error.arrays) from error
    except PlanError as error:
        with os_errors(run.failure_file):
            write_whole(run.failure_file, f"{error}\n".encode())
        place = f"; the plan is in {run.path}" if run.plan_file.exists() else ""
        raise PlanError(f"{error}{place}") from error
    except TsbenchError as error:
        raise TsbenchError(f"{error}{_way_on(run) if run.trained else ''}") from error
    except Stopped as stopped:
        raise Stopped(stopped.signal, f"{stopped}{_way_on(run) if run.begun else ''}") from None


def _dumped(path: Path, error: NotFiniteError) -> str:
    """Saves the arrays that a number that is not finite was computed from; returns a note on it."""
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **error.arrays)
    with os_errors(path):
        write_whole(path, content.getvalue())
    return f"; its inputs are in {path}"


def _way_on(run: RunDirectory) -> str:
    return f"; to go on: {command('run', f'resume={run.path}')}"


def _train(
    config: RunConfig, problem: Problem, workspace: RunWorkspace, console: Console
) -> Record:
    run = RunDirectory(workspace.directory)
    name = config.method["name"]
    with processes.together(torch_device(problem.device)):
        # A plug-in may return anything.
        policy: object = methods.find(name).train(problem, workspace)
    if not isinstance(policy, Policy):
        given = type(policy).__name__
        raise TsbenchError(f"the method {name} returns {given}, not a Policy")
    if policy.info.method != name:
        other = policy.info.method
        raise TsbenchError(f"the method {name} returns a policy that names the method {other}")
    check_fit(policy, problem.task)
    if more := overspent(workspace.stages, config, processes.count()):
        workspace.note(f"over the budget, so no leaderboard takes this run: {more}")
    policy.save(run.path)
    protocol = SMOKE if config.budget == SMOKE.name else V1
    workspace.note(f"evaluation by protocol {protocol.name}")
    with progress_bar(console, "evaluate") as progress:
        score = evaluate(
            policy, problem.task, protocol=protocol, threads=problem.threads, progress=progress
        )
    assert score.log is not None
    score.log.save(run.actions_file)
    return Record(
        task=problem.task.name,
        task_version=problem.task.version,
        standard=tasks.standard(problem.task),
        method=name,
        seed=config.seed,
        budget=config.budget,
        score=score,
        stages=tuple(replace(stage, seconds=round(stage.seconds, 3)) for stage in workspace.stages),
    )


def _create(run: RunDirectory) -> None:
    """Makes the directory. An existing one may be empty or hold what a run left before it began.

    Raises:
        TsbenchError: the directory holds a run or other files.
    """
    run.path.mkdir(parents=True, exist_ok=True)
    parts = dict(leftovers(run.path))
    left = {parts.get(path, path.name) for path in run.path.iterdir()}
    if left <= {run.versions_file.name, run.config_file.name} and not run.config_file.exists():
        return
    elsewhere = "choose another directory=PATH"
    if run.finished:
        other = "read its report.html, or choose another seed=N or directory=PATH"
        raise taken(run.path, "a finished run", other)
    if run.failure:
        raise taken(run.path, "a run whose plan has failed", elsewhere)
    if run.config_file.exists():
        way_out = f"go on with {command('run', f'resume={run.path}')}, or {elsewhere}"
        raise taken(run.path, "an unfinished run", way_out)
    raise taken(run.path, "other files", elsewhere)


def _leave_as_found(directory: Path, found: set[Path] | None) -> None:
    """Removes what a run has written.

    Args:
        directory: the run directory.
        found: the paths in it before the run; None if the directory did not exist.
    """
    if found is None:
        shutil.rmtree(directory, ignore_errors=True)
        return
    for path in set(directory.iterdir()) - found:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
