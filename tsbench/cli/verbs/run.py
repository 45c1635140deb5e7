"""`tsbench run`: train a policy and evaluate it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tsbench.cli.arguments import Parser, new_file
from tsbench.cli.streams import loading
from tsbench.cli.usage import fitted

HELP = """\
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
  device=NAME      what learns: cpu, cuda, cuda:N, auto for a GPU where there is one, or warp for
                   tests of a GPU's code on the CPU (cpu)
  deterministic=true
                   the same bits each time on a GPU, for more time
  resume=RUN       continues an interrupted run to the same result, bit for bit; takes no other
                   words
  method.KEY=...   an option of the method
  task.training.STAGE.KEY=...
                   a PPO setting of the plan, imitate, settle, finetune or task stages
  task.budgets.B.act=N
                   the steps of budget B in physics; task.budgets.B.plan=N those of planning
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


def call(words: Sequence[str]) -> None:
    if "-h" in words or "--help" in words:
        sys.stdout.write(fitted(HELP))
        return
    with loading():
        from tsbench.cli import launch

    parser = Parser("tsbench run", add_help=False, allow_abbrev=False)
    parser.add_argument("--json", type=new_file)
    options, others = parser.parse_known_args(words)
    launch.launch(others, options.json)
