"""`tsbench tune`: search for good settings of a method, shared by processes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from tsbench.cli import places
from tsbench.cli.arguments import Parser, new_file, whole_number
from tsbench.cli.usage import fitted
from tsbench.core.errors import TsbenchError

HELP = """\
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


def call(words: Sequence[str]) -> None:
    if "-h" in words or "--help" in words:
        sys.stdout.write(fitted(HELP))
        return
    try:
        from tsbench.runs import tune
    except ModuleNotFoundError as error:
        if error.name != "optuna":
            raise
        raise TsbenchError("optuna is missing: pip install 'tsbench[tune]'") from None
    from tsbench.core.files import write_json
    from tsbench.core.words import command, several

    parser = Parser("tsbench tune", add_help=False, allow_abbrev=False)
    parser.add_argument("--best", action="store_true")
    parser.add_argument("--json", type=new_file)
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
            trials = whole_number(own["trials"], 1, 10**6)
        except argparse.ArgumentTypeError as error:
            raise TsbenchError(f"trials {error}") from None
        tune.tune(study, trials, told=lambda line: sys.stderr.write(f"{line}\n"))
    trial, spent = tune.best(study)
    chosen = study.chosen(trial.params)
    best = f"trial {trial.number} is the best of {several(spent, 'trial')}"
    sys.stderr.write(f"{best}, worth {trial.value:.4g}\n")
    sys.stdout.write(f"{command('run', *chosen)}\n")
    figures = {"words": chosen, "value": trial.value, "trial": trial.number, "trials": spent}
    write_json(options.json, {**figures, "seeds": study.seeds})
