"""The policy and the task that words name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tsbench.core.errors import TsbenchError, unknown

VECNORMALIZE = "the model's VecNormalize, saved beside the .zip; loading it runs code too"


def read_policy(
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

    name = None if word is None else task_name(word)
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


def task_name(word: str) -> str:
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
