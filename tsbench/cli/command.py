"""The command line: finds the verb, and turns errors into a line and an exit status."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress

from tsbench.cli import verbs
from tsbench.cli.streams import open_closed, warnings_as_usual
from tsbench.cli.usage import fitted
from tsbench.cli.verbs import VERBS
from tsbench.core.errors import Stopped, TsbenchError, unknown
from tsbench.gl import draw_nothing, find_working_backend

PICTURES = ("--video", "--strip")  # options that need OpenGL


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
        return verbs.call(words[0], words[1:])
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
    listed = "\n".join(f"  {name:<13}{summary}" for name, summary in VERBS.items())
    return f"""\
usage: tsbench COMMAND ...

Sparse-reward robot tasks, as a planning MDP and as a physics MDP, and the methods that solve them.

commands (each with --help):
{listed}

first steps:
  tsbench list
  tsbench run task=rocket_navigation budget=smoke
"""


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
