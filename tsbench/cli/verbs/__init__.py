"""The verbs of the command line. Each is a module of this package by its name, with a function
`call` that takes the words after the verb and returns the exit status, None for 0. A verb imports
the modules that it needs when it is called.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

# The purpose of each verb in a few words, in the order of the help.
VERBS = {
    "run": "train a policy and evaluate it",
    "evaluate": "score a policy by a protocol",
    "view": "show a run, a plan or a task in motion: live, as a page or as a video",
    "report": "write one page about a run: plan, motion, score and learning",
    "tune": "search for good settings of a method, shared by processes",
    "collect": "keep the scores, curves and best policies of many runs as data",
    "compare": "put runs beside each other: scores, learning curves, statistics",
    "figures": "make the paper's figures and its table again, from runs or results",
    "export": "write a policy for robots, or one of another library as tsbench's",
    "submit": "pack runs into an entry of the leaderboard",
    "verify": "check whether entries of the leaderboard hold what they claim",
    "leaderboard": "show the leaderboard: as tables, or as a site",
    "bench": "measure speed, beside alternatives",
    "list": "name the tasks, methods and budgets",
    "describe": "show the card of a task (spaces, reward, constants) or of a method (options)",
    "doctor": "say what works on this machine",
}


def call(verb: str, words: Sequence[str]) -> int:
    """Calls a verb with the words after it, and returns its exit status."""
    return import_module(f"{__name__}.{verb}").call(words) or 0
