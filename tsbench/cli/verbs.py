"""The command line: a table of verbs. Each verb imports its modules when it is called."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from tsbench.cli import places
from tsbench.cli.streams import loading, open_closed, warnings_as_usual
from tsbench.cli.usage import fitted
from tsbench.core.errors import Stopped, TsbenchError, nearest, unknown
from tsbench.gl import draw_nothing, find_working_backend

if TYPE_CHECKING:
    from rich.console import Console

RUN_HELP = """\
usage: tsbench run task=NAME [method=NAME] [budget=NAME] [seed=N] [key=value ...] [options]

Trains a policy, evaluates it on the task and writes a run directory with a report.

words, in Hydra's grammar:
  task=NAME        the task; `tsbench list` names all
  method=NAME      the method (twostage)
  budget=NAME      smoke: seconds, fast: the standard, paper: the published one (fast)
  seed=N           the seed of all random numbers (0)
  directory=PATH   the run directory, a new one (runs/TASK/METHOD/seedN-BUDGET)
  threads=N        CPU threads (all)
  checkpoint=S     seconds of training between checkpoints (30)
  loggers=[...]    what shows the training: tensorboard, wandb, mlflow ([tensorboard])
  device=NAME      what learns: cpu, cuda, cuda:N, or auto for a GPU where there is one (cpu)
  deterministic=true
                   the same bits each time on a GPU, for more time
  resume=RUN       continues an interrupted run to the same result, bit for bit; takes no other
                   words
  method.KEY=...   an option of the method
  task.training.STAGE.KEY=...
                   a PPO setting of the plan, imitate, finetune or task stages
  task.constants.KEY=...
                   a constant of the task, for studies: such a score is not ranked

options:
  --cfg job        show the configuration and stop
  --json FILE      write the score to a new JSON file too, as `tsbench evaluate` does
  -m, --multirun   a sweep: every combination of the values given, e.g. seed=0,1,2 task=a,b
  --hydra-help     Hydra's own flags; -sc install=bash prints the shell completion

examples:
  tsbench run task=rocket_navigation budget=smoke
  tsbench run -m task=laikago_walk,laikago_trot 'seed=range(0,3)'
"""


TUNE_HELP = """\
usage: tsbench tune task=NAME method=NAME trials=N [study=PATH] [key=value ...] [options]

Finds good settings of a method by Optuna's multivariate TPE, and prints the words of the best ones.
Processes that are given the same words work on one study together, and a study goes on where it
was interrupted. docs/tuning.md says what a trial is and what it is worth.

words:
  trials=N         trials of the whole study, pruned and failed ones among them
  study=PATH       directory of the journal and the runs (studies/TASK/METHOD-BUDGET)
  task=, method=, budget=, threads=, key=value
                   as of `tsbench run`, for all trials; a key that is given is not tuned

options:
  --best           only print the words of the best trial so far
  --json FILE      write them to a new JSON file too, with the number of trials spent
"""

JSON_HELP = "write what is shown to a new JSON file too"
VECNORMALIZE = "the model's VecNormalize, saved beside the .zip; loading it runs code too"
PICTURES = ("--video", "--strip")  # options that need OpenGL


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are TsbenchErrors of one line."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """The options. An unknown one is refused with the nearest that there is."""
        options, others = self.parse_known_args(args, namespace)
        if not others:
            return options
        flags = [flag for flag in self._option_string_actions if flag.startswith("--")]
        key = others[0].lstrip("-").partition("=")[0]
        near = nearest(f"--{key}", flags)
        hint = f" (did you mean {near}?)" if near else ""
        return self.error(f"unrecognized arguments: {' '.join(others)}{hint}")

    def error(self, message: str) -> NoReturn:
        raise TsbenchError(f"{message} (see {self.prog} --help)")


@dataclass(frozen=True)
class Verb:
    """A command.

    Attributes:
        summary: its purpose in a few words.
        call: the function that takes its arguments and returns the exit status, None for 0.
    """

    summary: str
    call: Callable[[Sequence[str]], int | None]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit status.

    The status is 0 for success, 1 for a score that differs from the recorded one or cannot be
    compared with it, and for a closed output, 2 for a user's mistake, 130 for Ctrl-C and 143 for
    SIGTERM.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    open_closed()
    try:
        with warnings_as_usual():
            status = _dispatch(words)
        sys.stdout.flush()
    except TsbenchError as error:
        status = _fail(str(error), 2)
        try:
            sys.stdout.flush()
        except OSError:  # the reader closed the output of a run
            _drop_output()
    except Stopped as stopped:
        return _fail(str(stopped), 128 + stopped.signal)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except BrokenPipeError:  # the reader closed the output, as in `tsbench list | head -1`
        _drop_output()
        return 1
    except OSError as error:  # of a file without its own handling, or of the output
        _drop_output()
        return _fail(f"{error.filename or 'output'}: {error.strerror or error}", 2)
    return status


def _fail(line: str, status: int) -> int:
    sys.stderr.write(f"tsbench: {line}\n")
    return status


def _drop_output() -> None:
    """Discards the buffered output, so that Python does not report a closed output at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        sys.stdout.write(fitted(_help()))
    elif words[0] == "--version":
        from tsbench.core import plugins

        sys.stdout.write(f"tsbench {plugins.own().version}\n")
    elif words[0] in ("-sc", "--shell-completion"):
        _complete(words)
    elif words[0] in VERBS:
        _choose_graphics(words)
        return VERBS[words[0]].call(words[1:]) or 0
    elif "=" in words[0]:
        hint = f"(did you mean 'tsbench run {words[0]}'?)"
        raise TsbenchError(f"a command comes first, not {words[0]!r} {hint}")
    else:
        raise unknown("command", words[0], VERBS)
    return 0


def _choose_graphics(words: list[str]) -> None:
    """Chooses the OpenGL library before mujoco is imported: one that works for a verb that draws
    pictures, and none for the others.

    Raises:
        TsbenchError: none works, and the verb cannot do without.
    """
    if words[0] == "view" and any(word.startswith(PICTURES) for word in words):
        find_working_backend()
    elif words[0] == "figures":
        with suppress(TsbenchError):  # only the motion strips are then left out
            find_working_backend()
    else:
        draw_nothing()


def _help() -> str:
    verbs = "\n".join(f"  {name:<13}{verb.summary}" for name, verb in VERBS.items())
    return f"""\
usage: tsbench COMMAND ...

Sparse-reward robot tasks, as a planning MDP and as a physics MDP, and the methods that solve them.

commands (each with --help):
{verbs}

first steps:
  tsbench list
  tsbench run task=rocket_navigation budget=smoke
"""


def _run(words: Sequence[str]) -> None:
    if "-h" in words or "--help" in words:
        sys.stdout.write(fitted(RUN_HELP))
        return
    with loading():
        from tsbench.cli import launch

    parser = Parser("tsbench run", add_help=False, allow_abbrev=False)
    parser.add_argument("--json", type=_new_file)
    options, others = parser.parse_known_args(words)
    launch.launch(others, options.json)


def _complete(words: Sequence[str]) -> None:
    """Completes verbs, and the words of `run` by Hydra's completion.

    Hydra knows no verbs, so the verb is removed from the line that Hydra sees.
    """
    line = os.environ.get("COMP_LINE", "").split(" ")
    if "install" not in words[-1] and (len(line) < 3 or line[1] != "run"):
        sys.stdout.write(" ".join(VERBS) + "\n")
        return
    os.environ["COMP_LINE"] = " ".join(line[:1] + line[2:])
    from tsbench.cli import launch

    launch.launch(words)


def _list(words: Sequence[str]) -> None:
    parser = _parser("list")
    what = "show this task's card, as `tsbench describe` does"
    parser.add_argument("task", nargs="?", metavar="TASK", help=what)
    options = parser.parse_args(words)
    if options.task is not None:
        _show_card(options)
        return
    from tsbench import methods, tasks
    from tsbench.core import plugins
    from tsbench.core.files import write_json
    from tsbench.runs import schema
    from tsbench.sim.promises import check_promises

    made, budgets, faults = {}, {}, []
    for name in tasks.names():
        try:
            made[name], budgets[name] = tasks.make(name), schema.budgets(name)
            if tasks.provider(name) != plugins.own():  # the contract tests check tsbench's own
                check_promises(name, made[name])
        except TsbenchError as error:
            faults.append(str(error))
    rows = {
        name: {
            "version": task.version,
            "steps": task.horizon,
            "seconds": round(task.horizon * task.timestep, 6),
            "budgets": {budget: vars(steps) for budget, steps in budgets[name].items()},
        }
        for name, task in made.items()
    }
    summaries = {name: methods.summary(name) for name in methods.names()}
    brought: dict[str, list[str]] = {}
    for kind, names in ((tasks, rows), (methods, summaries)):
        for name in names:
            if (provider := kind.provider(name)) not in (None, plugins.own()):
                brought.setdefault(str(provider), []).append(name)
    refused = tuple(dict.fromkeys((*tasks.refused(), *methods.refused())))
    incomplete = (*schema.incomplete(), *faults)
    offered = tuple(dict.fromkeys(name for amounts in budgets.values() for name in amounts))
    from rich.console import Console

    from tsbench.cli.rows import show_rows
    from tsbench.core.words import short

    console = Console()
    lines = []
    for name, row in rows.items():
        amounts = [budgets[name].get(budget) for budget in offered]
        costs = [f"{short(a.plan)} + {short(a.act)}" if a else "-" for a in amounts]
        lines.append((name, str(row["version"]), f"{row['seconds']:g}", *costs))
    show_rows(console, ("task", "version", "seconds", *offered), lines, folded=None)
    console.print("Budgets: environment steps to plan with + to act with.")
    show_rows(console, ("method", "what it does"), list(summaries.items()), folded=1)
    remarks = [f"Plug-in {provider}: {', '.join(names)}" for provider, names in brought.items()]
    remarks += [f"Refused: {line}" for line in refused]
    remarks += [f"Incomplete: {line}" for line in incomplete]
    for line in remarks:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    shown = {"tasks": rows, "methods": summaries, "plug-ins": brought, "refused": refused}
    write_json(options.json, {**shown, "incomplete": incomplete})


def _describe(words: Sequence[str]) -> None:
    parser = _parser("describe")
    parser.add_argument("task", metavar="TASK", help="its name, which `tsbench list` gives")
    _show_card(parser.parse_args(words))


def _show_card(options: Any) -> None:
    from rich.console import Console

    from tsbench.cli import describe
    from tsbench.core.files import write_json

    write_json(options.json, describe.show(Console(), options.task.removeprefix("task=")))


def _doctor(words: Sequence[str]) -> None:
    parser = _parser("doctor")
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.cli import doctor
    from tsbench.core.files import write_json

    console, found = Console(), list[tuple[str, str]]()
    for subject, state in doctor.findings():
        found.append((subject, state))
        line = f"{subject:<18} {state}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    write_json(options.json, dict(found))


def _parser(verb: str, *, json: bool = True) -> Parser:
    summary = VERBS[verb].summary
    parser = Parser(f"tsbench {verb}", description=summary, allow_abbrev=False)
    if json:
        parser.add_argument("--json", type=_new_file, metavar="FILE", help=JSON_HELP)
    return parser


def _new_file(word: str) -> Path:
    """The path of a new file, checked before hours of work whose result it will hold.

    Raises:
        TsbenchError: the file exists or cannot be written.
    """
    from tsbench.core.files import check_new

    path = places.path(word)
    check_new(path)
    return path


def _evaluate(words: Sequence[str]) -> int:
    parser = _parser("evaluate")
    parser.add_argument(
        "policy",
        metavar="POLICY_OR_RUN",
        help="directory with a policy in it, kept entry (TASK/ENTRY), .onnx file, "
        "stable-baselines3 .zip, zero or random",
    )
    parser.add_argument(
        "task", nargs="?", metavar="task=NAME", help="for a policy that names no task"
    )
    parser.add_argument(
        "--protocol",
        metavar="NAME",
        help="v1, or smoke, which takes seconds (the protocol of the run's score, else v1)",
    )
    help_physics = (
        "elliptic, half_step or warp: also play the protocol there and count changed verdicts"
    )
    parser.add_argument("--physics", metavar="NAME", help=help_physics)
    parser.add_argument("--threads", type=_threads, metavar="N", help="CPU threads (all)")
    parser.add_argument(
        "--trust-sb3",
        metavar="ALGORITHM",
        help="the algorithm that saved the .zip, which can run any code when it is loaded",
    )
    parser.add_argument("--vecnormalize", type=places.path, metavar="FILE", help=VECNORMALIZE)
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench import tasks
    from tsbench.cli import tables
    from tsbench.core.files import write_json
    from tsbench.core.words import number
    from tsbench.evaluation.evaluate import evaluate
    from tsbench.evaluation.flips import flips
    from tsbench.evaluation.protocol import PHYSICS, PROTOCOLS, V1
    from tsbench.evaluation.replay import compare
    from tsbench.runs import directory
    from tsbench.runs.progress import progress_bar

    path = places.run(options.policy)
    policy, task = _policy(path, options.task, options.trust_sb3, options.vecnormalize)
    run = directory.RunDirectory(path)
    kept = run.record() if run.finished else None
    name = options.protocol or (kept.score.protocol if kept else V1.name)
    if name not in PROTOCOLS:
        raise unknown("protocol", name, PROTOCOLS)
    protocol = PROTOCOLS[name]
    log = run.actions(task) if kept else None
    if options.physics is not None and options.physics not in PHYSICS:
        raise unknown("physics", options.physics, PHYSICS)
    engine = _engine(options.physics)
    console, standard = Console(), tasks.standard(task)
    with progress_bar(console, "evaluate") as progress:
        score = evaluate(
            policy, task, protocol=protocol, threads=options.threads, progress=progress
        )
    tables.show_score(console, f"{task.name}: {options.policy}", score, task)
    tables.show_rank(console, standard, score)
    shown: dict[str, Any] = {**score.as_dict(), "standard": standard}
    confirmed = True
    if kept is not None:
        comparison = compare(kept.score, score, task, log)
        # Who names another protocol asks for a new score, and not whether the kept one is right.
        confirmed = bool(comparison.agrees) or protocol.name != kept.score.protocol
        made = replace(kept, score=score, standard=standard)
        shown = directory.shown(made) | {"comparison": vars(comparison)}
        line = f" {run.score_file}: {comparison.words}"
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if options.physics is not None:
        with progress_bar(console, options.physics) as progress:
            other = evaluate(
                policy,
                task,
                protocol=protocol.elsewhere(options.physics),
                threads=options.threads,
                progress=progress,
                engine=engine,
            )
        flipped = flips(score, other)
        tables.show_flips(console, options.physics, flipped)
        console.print(
            f" solved_reward: {number(score.solved_reward)} by protocol {protocol.name}, "
            f"{number(other.solved_reward)} in physics {options.physics}, which is never ranked",
            highlight=False,
            soft_wrap=True,
        )
        shown |= {"physics": {"score": other.as_dict(), "flips": [vars(one) for one in flipped]}}
    write_json(options.json, shown)
    return int(not confirmed)


def _engine(physics: str | None) -> Any:
    """What plays a score in one of the other physics (`evaluation.protocol.PHYSICS`).

    Raises:
        TsbenchError: its packages are not installed.
    """
    if physics == "warp":
        from tsbench.sim.warp import HostPhysics

        return HostPhysics
    from tsbench.sim.physics import Physics

    return Physics


def _policy(
    path: Path, word: str | None, trust_sb3: str | None, vecnormalize: Path | None = None
) -> tuple[Any, Any]:
    """A policy, and the task in which it is evaluated.

    Args:
        path: a run directory, a policy file or the name of a reference policy.
        word: task=NAME, or None.
        trust_sb3: the stable-baselines3 algorithm that saved the file, or None.
        vecnormalize: the file of that model's VecNormalize, or None.

    Raises:
        TsbenchError: the policy does not exist, or `word` is missing or wrong.
    """
    from tsbench import tasks
    from tsbench.evaluation import foreign, references
    from tsbench.runs.directory import RunDirectory

    name = None if word is None else _task_name(word)
    for flag, given in (("--trust-sb3", trust_sb3), ("--vecnormalize", vecnormalize)):
        if given is not None and path.suffix != ".zip":
            raise TsbenchError(f"{flag} is for a stable-baselines3 .zip, not for {path}")
    if path.is_dir():
        run = RunDirectory(path)
        policy = run.policy()
        task = run.task(policy.info.task)
        if name not in (None, task.name):
            raise TsbenchError(f"{path} holds a policy for {task.name}, not for {name}")
        return policy, task
    if name is None:
        if path.exists() or str(path) in references.POLICIES:
            raise TsbenchError(f"task=NAME is missing; allowed: {', '.join(tasks.names())}")
        raise TsbenchError(f"no run directory {path}")
    task = tasks.checked(name)
    named = references.named(path, task)
    if named is None and not (path.exists() or path.is_symlink()):
        others = " and ".join(references.POLICIES)
        raise TsbenchError(f"no policy {path}; without a file there are {others}")
    return named or foreign.load(path, task, trust_sb3, vecnormalize), task


def _task_name(word: str) -> str:
    """The name in the word task=NAME.

    Raises:
        TsbenchError: the word is another, or there is no such task.
    """
    from tsbench import tasks

    key, separator, name = word.partition("=")
    if key != "task" or not separator:
        raise TsbenchError(f"expected task=NAME, not {word!r}")
    if name not in tasks.names():
        raise unknown("task", name, tasks.names())
    return name


def _threads(word: str) -> int:
    return _whole_number(word, 1, 1024)


def _whole_number(word: str, lowest: int, highest: int) -> int:
    if not (word.isdecimal() and lowest <= int(word) <= highest):
        message = f"must be a whole number from {lowest} to {highest}, not {word!r}"
        raise argparse.ArgumentTypeError(message)
    return int(word)


def _view(words: Sequence[str]) -> None:
    parser = _parser("view", json=False)
    what = "a run's directory, a kept entry (TASK/ENTRY), a plan's file (plan.npz), or task=NAME"
    parser.add_argument("what", nargs="?", metavar="RUN|PLAN|task=NAME", help=what)
    parser.add_argument("--compare", nargs=2, metavar="RUN", help="two runs of one task instead")
    push = "push the robot for 0.1 s, e.g. 100N@0.5s:+y: newtons, when, where to (axis or degrees)"
    parser.add_argument("--push", metavar="PUSH", help=push)
    files = {
        "--html": "write a page, open no server",
        "--video": "write an MP4",
        "--strip": "write a PNG of some moments",
    }
    for flag, purpose in files.items():
        parser.add_argument(flag, type=_new_file, metavar="FILE", help=purpose)
    port = "of the live view (any that is free)"
    parser.add_argument("--port", type=_port, metavar="N", default=0, help=port)
    options = parser.parse_args(words)
    if (options.what is None) == (options.compare is None):
        parser.error("one of RUN|PLAN|task=NAME and --compare RUN RUN is needed")
    from rich.console import Console

    from tsbench.core.files import write_new
    from tsbench.runs.progress import progress_bar
    from tsbench.viewer import film, page, serve
    from tsbench.viewer.show import Show
    from tsbench.viewer.subject import pair, subject

    compared = [str(places.run(word)) for word in options.compare or ()]
    chosen = options.what or ""
    if chosen and not chosen.startswith("task="):
        chosen = str(places.run(chosen))

    def show(push: str | None) -> Show:
        return pair(compared, push) if compared else subject(chosen).show(push)

    shown = show(options.push)
    if options.html:
        write_new(options.html, page.render(shown).encode())
    if options.video:
        with progress_bar(Console(stderr=True), "video") as progress:
            film.write_video(shown, options.video, progress)
    if options.strip:
        film.write_strip(shown, options.strip)
    written = [str(path) for path in (options.html, options.video, options.strip) if path]
    if written:
        sys.stdout.write("\n".join(written) + "\n")
        return
    running = serve.server(lambda push: page.render(show(push), served=True), options.port)
    sys.stdout.write(f"{serve.address(running, options.push)} (Ctrl-C ends it)\n")
    sys.stdout.flush()
    # A shell makes its background processes ignore Ctrl-C; SIGINT must still end the server.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with running, suppress(KeyboardInterrupt):
        running.serve_forever()


def _port(word: str) -> int:
    return _whole_number(word, 0, 65535)


def _report(words: Sequence[str]) -> None:
    parser = _parser("report", json=False)
    parser.add_argument("run", metavar="RUN", help="a finished run's directory, or TASK/ENTRY")
    what = "the new page (the missing ones of report.html and view.html in RUN)"
    parser.add_argument("--html", type=places.path, metavar="FILE", help=what)
    options = parser.parse_args(words)
    from tsbench.core.files import check_new, write_new
    from tsbench.runs.directory import RunDirectory
    from tsbench.viewer import report

    run = RunDirectory(places.run(options.run))
    report.check_finished(run)
    path = options.html or run.report_file
    check_new(path, "give another by --html FILE")
    if options.html:
        write_new(path, report.render(run).encode())
    else:
        report.write_pages(run)
    sys.stdout.write(f"{path}\n")


def _tune(words: Sequence[str]) -> None:
    if "-h" in words or "--help" in words:
        sys.stdout.write(fitted(TUNE_HELP))
        return
    try:
        from tsbench.runs import tune
    except ModuleNotFoundError as error:
        if error.name != "optuna":
            raise
        raise TsbenchError("optuna is missing: pip install 'tsbench[tune]'") from None
    from tsbench.core.files import write_json
    from tsbench.core.words import command

    parser = Parser("tsbench tune", add_help=False, allow_abbrev=False)
    parser.add_argument("--best", action="store_true")
    parser.add_argument("--json", type=_new_file)
    options, others = parser.parse_known_args(words)
    own = {"trials": "", "study": ""}
    for key in own:
        own[key] = next((w.partition("=")[2] for w in others if w.startswith(f"{key}=")), "")
    common = [word for word in others if not word.startswith(tuple(f"{key}=" for key in own))]
    study = tune.prepare(common, places.path(own["study"]) if own["study"] else None)
    if not options.best:
        if not own["trials"]:
            raise TsbenchError("trials=N is missing, the number of trials of the whole study")
        try:
            trials = _whole_number(own["trials"], 1, 10**6)
        except argparse.ArgumentTypeError as error:
            raise TsbenchError(f"trials {error}") from None
        tune.tune(study, trials, told=lambda line: sys.stderr.write(f"{line}\n"))
    trial, spent = tune.best(study)
    chosen = study.chosen(trial.params)
    sys.stdout.write(f"{command('run', *chosen)}\n")
    figures = {"words": chosen, "value": trial.value, "trial": trial.number, "trials": spent}
    write_json(options.json, {**figures, "seeds": study.seeds})


def _collect(words: Sequence[str]) -> None:
    parser = _parser("collect", json=False)
    what = "runs, entries, results folders, or folders with such in them"
    parser.add_argument("runs", nargs="+", type=places.path, metavar="RUNS", help=what)
    out = "the results folder, which is made where there is none"
    parser.add_argument("--out", type=places.path, required=True, metavar="DIR", help=out)
    trials = "trials that were spent on tuning the settings of these runs"
    parser.add_argument("--trials", type=_trials, metavar="N", help=trials)
    options = parser.parse_args(words)
    from tsbench.runs import results

    found = results.read(options.runs)
    kept = results.collect(found, options.out, options.trials)
    sys.stdout.write(f"{options.out}: {len(found.rows)} added, {len(kept.rows)} in all\n")


def _trials(word: str) -> int:
    return _whole_number(word, 0, 10**6)


def _compare(words: Sequence[str]) -> None:
    parser = _parser("compare")
    what = "runs, kept entries (TASK/ENTRY), results folders, or folders with such in them"
    parser.add_argument("runs", nargs="+", metavar="RUN", help=what)
    parser.add_argument(
        "--png", type=_new_file, metavar="FILE", help="write the learning curves as one picture"
    )
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.cli import tables
    from tsbench.core.files import write_json, write_new
    from tsbench.runs import results
    from tsbench.viewer import comparison

    parts = [results.read([places.entry(word)]) for word in options.runs]
    everything = results.Results()
    for part in parts:
        everything.update(part)
    console, pairs = Console(), comparison.pairs(everything)
    tables.show_runs(console, dict(zip(options.runs, parts, strict=True)))
    tables.show_pairs(console, pairs)
    if options.png:
        write_new(options.png, comparison.picture(everything))
        console.print(f" {options.png}", markup=False, highlight=False, soft_wrap=True)
    runs = [
        {"run": word, "words": row.words, "score": row.score.as_dict() if row.score else None}
        for word, part in zip(options.runs, parts, strict=True)
        for row in part.rows.values()
    ]
    write_json(options.json, {"runs": runs, "pairs": [asdict(pair) for pair in pairs]})


def _figures(words: Sequence[str]) -> None:
    parser = _parser("figures", json=False)
    what = "runs, entries, results folders, or folders with such in them"
    parser.add_argument("runs", nargs="+", type=places.path, metavar="RUNS", help=what)
    out = "a new folder, which gets index.html and the figures as PNG, SVG and CSV"
    parser.add_argument("--out", type=places.path, required=True, metavar="DIR", help=out)
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.cli import tables
    from tsbench.runs import results
    from tsbench.viewer.paper import page

    lines, remarks = page.write(results.read(options.runs), options.out)
    console = Console()
    tables.show_scores(console, lines)
    for line in remarks:
        console.print(f" {line}", markup=False, highlight=False, soft_wrap=True)
    console.print(f" {options.out / 'index.html'}", markup=False, highlight=False, soft_wrap=True)


def _bench(words: Sequence[str]) -> None:
    parser = _parser("bench")
    parser.add_argument("--only", metavar="NAME", help="one comparison, such as laikago")
    parser.add_argument("--quick", action="store_true", help="a minute, with wider ranges")
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench import bench
    from tsbench.bench import table
    from tsbench.core.files import write_json

    progress = Console(stderr=True)
    findings = bench.measure(
        options.only, quick=options.quick, tell=lambda name: progress.print(f"measuring {name}")
    )
    table.show(Console(), findings)
    write_json(options.json, findings.as_dict())


def _export(words: Sequence[str]) -> None:
    parser = _parser("export", json=False)
    what = "a run or policy directory, .onnx file, stable-baselines3 .zip, or .pt file of torch"
    parser.add_argument("model", type=places.path, metavar="MODEL", help=what)
    for_task = "that the policy is for, if it does not say so"
    parser.add_argument("task", nargs="?", metavar="task=NAME", help=for_task)
    parser.add_argument("directory", type=places.path, metavar="DIRECTORY", help="a new one")
    parser.add_argument("--method", metavar="NAME", help="that made the policy of another library")
    parser.add_argument("--trust-sb3", metavar="ALGORITHM", help="that saved the .zip; runs code")
    parser.add_argument("--vecnormalize", type=places.path, metavar="FILE", help=VECNORMALIZE)
    parser.add_argument("--activation", metavar="NAME", help="of a .pt file's hidden layers")
    options = parser.parse_args(words)
    from tsbench import tasks
    from tsbench.core.files import check_new
    from tsbench.evaluation import deploy, export

    check_new(options.directory, parents=True)
    if options.activation is not None and options.model.suffix not in (".pt", ".pth"):
        raise TsbenchError(f"--activation is for a .pt file of torch, not for {options.model}")
    if options.model.is_dir():
        if options.method is not None:
            raise TsbenchError("--method is for a policy of another library")
        policy, task = _policy(options.model, options.task, options.trust_sb3, options.vecnormalize)
        differences = deploy.write(policy, task, options.directory)
    else:
        if options.task is None:
            raise TsbenchError(f"task=NAME is missing; allowed: {', '.join(tasks.names())}")
        if options.method is None:
            raise TsbenchError("--method NAME is missing, the name of what made the policy")
        task = tasks.make(_task_name(options.task))
        found = export.read(
            options.model,
            task,
            algorithm=options.trust_sb3,
            vecnormalize=options.vecnormalize,
            activation=options.activation,
        )
        policy, _ = export.policy_of(found, task, options.method)
        differences = deploy.write(policy, task, options.directory, found.answer)
    for name, difference in differences.items():
        about = f" (opset {deploy.OPSET}, any number of rows)" if name == deploy.ONNX_FILE else ""
        sys.stdout.write(
            f"{options.directory / name}{about}: "
            f"actions differ by at most {difference:.1g} from the model's\n"
        )


BOARD = Path("leaderboards")
BOARD_HELP = "(leaderboards here, else the kept entries)"


def _submit(words: Sequence[str]) -> int:
    parser = _parser("submit")
    flag = parser.add_argument
    flag("runs", nargs="+", type=places.path, metavar="RUN", help="a run, or an exported policy")
    flag("--name", required=True, help="of the entry: its directory")
    flag("--author", required=True, action="append", metavar="NAME", help="one of the authors")
    flag("--licence", required=True, metavar="NAME", help="of the files, e.g. MIT")
    flag("--url", help="where the method is described")
    flag("--hardware", metavar="TEXT", help="that trained it")
    flag("--tuning-trials", type=_count, metavar="N", help="trainings that decided on settings")
    flag("--trained", type=_seeds, metavar="SEEDS", help="all that were trained, e.g. 0-9 (RUNs')")
    flag("--rescore", action="store_true", help="score again what has a score")
    flag("--check", action="store_true", help="run the whole verification and keep nothing")
    flag("--board", type=places.path, default=BOARD, metavar="DIRECTORY", help="(leaderboards)")
    flag("--threads", type=_threads, metavar="N", help="CPU threads (all)")
    told = parser.add_argument_group("of policies that tsbench did not train")
    told.add_argument("--seeds", type=_seeds, metavar="SEEDS", help="one for each RUN, e.g. 0-2")
    told.add_argument("--steps", type=_count, metavar="N", help="environment steps of each")
    told.add_argument("--seconds", type=float, metavar="S", help="of each training")
    told.add_argument("--command", metavar="TEXT", help="that trained them")
    told.add_argument("--code", metavar="COMMIT", help="of the code that trained them")
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.core.files import write_json
    from tsbench.evaluation.evaluate import evaluate
    from tsbench.evaluation.protocol import V1
    from tsbench.leaderboard import submission, verify
    from tsbench.runs.progress import progress_bar

    console = Console(stderr=True)
    try:
        described = submission.Described(
            entry=options.name,
            authors=tuple(options.author),
            licence=options.licence,
            url=options.url,
            hardware=options.hardware,
            tuning_trials=options.tuning_trials,
            seeds_trained=tuple(options.trained or ()),
        )
    except ValueError as error:
        raise TsbenchError(str(error)) from None
    foreign = (options.seeds, options.steps, options.seconds, options.command)
    if None not in foreign and len(options.seeds) != len(options.runs):
        parser.error(f"{len(options.seeds)} --seeds for {len(options.runs)} runs")
    given = (
        submission.Told(tuple(options.seeds), options.command, options.steps, options.seconds,
                        options.code)
        if None not in foreign else None
    )  # fmt: skip

    def score(policy: Any, task: Any) -> Any:
        with progress_bar(console, "evaluate") as progress:
            return evaluate(policy, task, protocol=V1, threads=options.threads, progress=progress)

    packed = submission.pack(
        options.runs, described, options.board, V1, told=given, score=score,
        rescore=options.rescore,
    )  # fmt: skip
    try:
        if not options.check:
            submission.home(packed, options.board, V1, options.runs)
        asked = verify.Asked(rescore=options.check, threads=options.threads)
        verdict = verify.verify(packed, asked, _tell(console))
        _show_verdict(Console(), verdict)
        if verdict.passed and not options.check:
            place = submission.place(packed, options.board, V1, options.runs)
            sys.stdout.write(f"{place}\n")
    finally:
        submission.discard(packed)
    write_json(options.json, verify.plain(verdict))
    return int(not verdict.passed)


def _verify(words: Sequence[str]) -> int:
    parser = _parser("verify")
    flag = parser.add_argument
    what = "directories of entries, or kept ones (TASK/ENTRY)"
    flag("entries", nargs="*", type=places.entry, metavar="ENTRY", help=what)
    flag("--all", action="store_true", help="every entry of the board")
    flag("--quick", action="store_true", help="replay the kept actions only, in seconds")
    flag("--seed-file", type=places.path, metavar="FILE", help="score from the hidden starts too")
    flag("--retrain", action="store_true", help="train again by the recorded configuration")
    flag("--record", action="store_true", help="keep the verdicts in verdicts/ of the board")
    flag("--retract", metavar="REASON", help="take the entries back, and keep that verdict")
    flag("--pull-request", metavar="BASE", help="the entries that HEAD adds to this commit")
    flag("--in", dest="checkout", type=places.path, default=Path(), metavar="DIRECTORY",
         help="with --pull-request: the repository (here)")  # fmt: skip
    flag("--comment", type=_new_file, metavar="FILE", help="write the verdicts as Markdown too")
    flag("--board", type=places.path, metavar="DIRECTORY", help=BOARD_HELP)
    flag("--threads", type=_threads, metavar="N", help="CPU threads (all)")
    options = parser.parse_args(words)
    if sum((bool(options.entries), options.all, options.pull_request is not None)) != 1:
        parser.error("one of ENTRY, --all and --pull-request BASE is needed")
    from rich.console import Console

    from tsbench.core.files import write_json, write_new
    from tsbench.leaderboard import pull_request, verify

    console = Console()
    written = options.record or options.retract is not None
    board = places.board(options.board, BOARD, written=written)
    faults: list[str] = []
    if options.pull_request is not None:
        entries, faults = pull_request.entries(options.checkout, options.pull_request)
    else:
        entries = verify.entries(board) if options.all else options.entries
    if options.all and not entries:
        raise TsbenchError(f"no entries in {board}")
    train = None
    if options.retrain:
        from tsbench.runs.execute import execute

        train = execute
    seed = options.seed_file and verify.hidden_seed(options.seed_file, board)
    asked = verify.Asked(not options.quick, seed, train, options.threads)
    verdicts = []
    for fault in faults:
        console.print(f"refused: {fault}", markup=False, highlight=False, soft_wrap=True)
    for entry in () if faults else entries:
        if options.retract is not None:
            verdict = verify.retracted(entry, options.retract)
        else:
            verdict = verify.verify(entry, asked, _tell(Console(stderr=True)))
        _show_verdict(console, verdict)
        verdicts.append(verdict)
        if verdict.digest and written:
            sys.stdout.write(f"{verify.record(board, entry, verdict)}\n")
    if options.comment:
        write_new(options.comment, verify.comment(verdicts, faults).encode())
    shown = {"refused": faults, "verdicts": [verify.plain(verdict) for verdict in verdicts]}
    write_json(options.json, shown)
    if options.retract is not None:
        return 0
    return int(bool(faults) or not all(verdict.passed for verdict in verdicts))


def _leaderboard(words: Sequence[str]) -> None:
    parser = _parser("leaderboard", json=False)
    flag = parser.add_argument
    flag("--board", type=places.path, metavar="DIRECTORY", help=BOARD_HELP)
    flag("--html", type=places.path, metavar="DIRECTORY", help="write the site there")
    flag("--plain", action="store_true", help="a site without 3-D views and figures, in seconds")
    flag("--readme", action="store_true", help="write the tables into README.md of the board")
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench.core.errors import os_errors
    from tsbench.core.files import write_whole
    from tsbench.leaderboard import page
    from tsbench.viewer import report

    board = places.board(options.board, BOARD, written=options.readme)
    if options.html:
        render = None if options.plain else report.render
        written = page.write_site(board, options.html, render, _tell(Console(stderr=True)))
        sys.stdout.write(f"{written[0]}\n")
    if options.readme or not options.html:
        readme = board / "README.md"
        with os_errors(readme):
            before = readme.read_text(encoding="utf-8") if readme.exists() else "# Leaderboards\n"
            text = page.markdown(*page.tables(board), before.partition("\n## ")[0])
            if options.readme:
                write_whole(readme, text.encode())
        tables = text[text.index("\n## ") + 1 :]
        sys.stdout.write(f"{readme}\n" if options.readme else tables)


def _tell(console: Console) -> Callable[[str], None]:
    return lambda line: console.print(line, markup=False, highlight=False, soft_wrap=True)


def _show_verdict(console: Console, verdict: Any) -> None:
    from tsbench.core.words import number

    say = _tell(console)
    state = verdict.state or "refused"
    passed = "passed" if verdict.passed else "FAILED"
    say(f"{verdict.entry}: {state}, {passed}, {verdict.seconds:.0f} s")
    for reason in verdict.reasons:
        say(f"  {reason}")
    for one in verdict.figures:
        if one.verified is not None and one.verified != one.claimed:
            say(
                f"  seed {one.seed}, {one.name}: claimed {number(one.claimed)}, "
                f"verified {number(one.verified)}, difference {one.verified - one.claimed:+.2g}"
            )


def _count(word: str) -> int:
    return _whole_number(word, 0, 2**53 - 1)


def _seeds(word: str) -> list[int]:
    """Seeds as words say them: 0-2,5."""
    found: list[int] = []
    for part in word.split(","):
        first, dash, last = part.partition("-")
        low = _whole_number(first, 0, 2**32 - 1)
        high = _whole_number(last, low, 2**32 - 1) if dash else low
        if high - low >= 1000:
            raise argparse.ArgumentTypeError(f"more than 1000 seeds: {part!r}")
        found += range(low, high + 1)
    return found


VERBS = {
    "run": Verb("train a policy and evaluate it", _run),
    "evaluate": Verb("score a policy by a protocol", _evaluate),
    "view": Verb("show a run, a plan or a task in motion: live, as a page or as a video", _view),
    "report": Verb("write one page about a run: plan, motion, score and learning", _report),
    "tune": Verb("search for good settings of a method, shared by processes", _tune),
    "collect": Verb("keep the scores, curves and best policies of many runs as data", _collect),
    "compare": Verb("put runs beside each other: scores, learning curves, statistics", _compare),
    "figures": Verb("make the paper's figures and its table again, from runs or results", _figures),
    "export": Verb("write a policy for robots, or one of another library as tsbench's", _export),
    "submit": Verb("pack runs into an entry of the leaderboard", _submit),
    "verify": Verb("check whether entries of the leaderboard hold what they claim", _verify),
    "leaderboard": Verb("show the leaderboard: as tables, or as a site", _leaderboard),
    "bench": Verb("measure speed, beside alternatives", _bench),
    "list": Verb("name the tasks, methods and budgets", _list),
    "describe": Verb("show a task's card: spaces, reward, constants, what was reached", _describe),
    "doctor": Verb("say what works on this machine", _doctor),
}
