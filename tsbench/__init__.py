"""tsbench: control problems that are too sparse or too sensitive for plain reinforcement learning.

import tsbench

environment = tsbench.load("laikago_trot")
time_step = environment.reset()
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from tsbench.core.errors import TsbenchError, quoted, unknown
from tsbench.gl import choose_backend

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np

    from tsbench.core.motion import ReferenceMotion
    from tsbench.core.policy import Policy
    from tsbench.evaluation.score import Score
    from tsbench.sim.batched import BatchedEnvironment
    from tsbench.sim.push import Push
    from tsbench.sim.single import Environment

    __version__: str

choose_backend()

__all__ = ["TsbenchError", "evaluate", "list_methods", "list_tasks", "load", "load_batched"]

Variant = Literal["planning", "imitation"]
VARIANTS: tuple[Variant, ...] = ("planning", "imitation")


if not TYPE_CHECKING:  # a type checker would take it for a definition of every name

    def __getattr__(name: str) -> str:
        if name != "__version__":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from tsbench.core import plugins  # takes longer than `tsbench --help` may

        return plugins.own().version


def __dir__() -> list[str]:
    """What a user may use: the public names, without what this file itself imports."""
    return [*__all__, "__version__"]


def list_tasks() -> tuple[str, ...]:
    """The names that `load` takes."""
    from tsbench import tasks

    return tasks.names()


def list_methods() -> tuple[str, ...]:
    """The names that `tsbench run method=...` takes."""
    from tsbench import methods

    return methods.names()


def load(
    name: str,
    variant: Variant | None = None,
    *,
    reference: ReferenceMotion | None = None,
    seed: int | None = None,
    perturbed: bool = False,
    push: Push | None = None,
    **constants: Any,
) -> Environment:
    """One dm_control environment of a task.

    It keeps dm_env's contract: a step before the first reset, or after the end of an episode,
    begins a new episode and ignores the action. `environment.task.random` is its only generator,
    and `environment.physics.get_state()` its whole state, to which `set_state` returns.

    Args:
        name: a task's name, as `list_tasks` gives it.
        variant: "planning" for the kinematic variant, "imitation" for the variant whose reward
            follows `reference`, None for the task itself.
        reference: the motion that the imitation variant follows.
        seed: seed of the random starts; None draws fresh entropy.
        perturbed: whether episodes begin near the task's start instead of at it.
        push: a force that acts in every episode.
        constants: changed constants of the task, for studies.

    Raises:
        TsbenchError: a name or a constant is unknown, an argument has the wrong type or range, or
            the variant lacks its reference or does not take the argument.
    """
    from tsbench.sim.single import environment

    _check_seed(seed)
    mdp = _variant(name, variant, reference, perturbed, push, constants)
    return environment(mdp, seed, perturbed=perturbed, push=push)


def load_batched(
    name: str,
    variant: Variant | None = None,
    *,
    count: int,
    reference: ReferenceMotion | None = None,
    seed: int | Sequence[int | None] | None = 0,
    perturbed: bool = False,
    push: Push | None = None,
    threads: int | None = None,
    **constants: Any,
) -> BatchedEnvironment[Any]:
    """`count` environments of a task, stepped together; the other arguments as in `load`.

    Args:
        count: number of environments, at least 1.
        seed: one seed for all starts, None for fresh entropy, or a list of one for each
            environment, which then begins as `load` with that seed does.
        push: one push for all environments, or with a leading axis (count,) one for each.
        threads: CPU threads of the physics; None takes all cores.

    Raises:
        TsbenchError: `count` is no whole number or less than 1, or there are more or fewer seeds.
            Beyond that, as `load`.
    """
    from tsbench.sim.batched import BatchedEnvironment
    from tsbench.sim.kinematic import Planning
    from tsbench.sim.physics import Physics

    for one in seed if isinstance(seed, Sequence) else [seed]:
        _check_seed(one)
    mdp = _variant(name, variant, reference, perturbed, push, constants)
    try:
        count = operator.index(count)
    except TypeError:
        raise TsbenchError(f"count must be a whole number, not {quoted(count)}") from None
    if count < 1:
        raise TsbenchError(f"count must be at least 1, not {count}")
    if isinstance(seed, Sequence) and len(seed) != count:
        raise TsbenchError(f"a list of seeds must have one for each of {count}, not {len(seed)}")
    dynamics: Any = mdp
    if not isinstance(mdp, Planning):
        dynamics = Physics(mdp, count, threads=threads, perturbed=perturbed, push=push)
    return BatchedEnvironment(mdp, dynamics, count, seed)


def evaluate(
    policy: Policy | Path | str | Callable[[np.ndarray], Any] | Any,
    task: str,
    *,
    protocol: str = "v1",
    threads: int | None = None,
    progress: bool = True,
) -> Score:
    """Scores a policy by an evaluation protocol (`tsbench/evaluation/protocol.py`).

    Args:
        policy: a `tsbench.core.policy.Policy`, the directory of one, an ONNX file, "zero" or
            "random", a model of stable-baselines3 or rsl-rl, a torch module, or any function of one
            observation (o,) that returns one action (a,) in [-1, 1]. For a file that
            stable-baselines3 saved there is `tsbench.evaluation.foreign.from_sb3`.
        task: its name.
        protocol: "v1", or "smoke" for a first look that cannot be ranked.
        threads: CPU threads of the physics; None takes all cores. The score does not depend on it.
        progress: whether a terminal shows how far the evaluation is.

    Raises:
        TsbenchError: a name is unknown, or the policy is for another task or does not fit.
    """
    from pathlib import Path

    from tsbench import tasks
    from tsbench.core.policy import Policy
    from tsbench.evaluation import foreign, references
    from tsbench.evaluation import protocol as protocols
    from tsbench.evaluation.evaluate import evaluate as score
    from tsbench.runs.progress import progress_bar

    made = tasks.make(task)
    if protocol not in protocols.PROTOCOLS:
        raise unknown("protocol", protocol, protocols.PROTOCOLS)
    if isinstance(policy, (str, Path)):
        policy = references.named(Path(policy), made) or foreign.load(Path(policy), made)
    if not isinstance(policy, (Policy, foreign.ForeignPolicy)):
        policy = foreign.made(policy, made)
    with progress_bar(None, "evaluate", shown=progress) as told:
        return score(
            policy, made, protocol=protocols.PROTOCOLS[protocol], threads=threads, progress=told
        )


def _check_seed(seed: int | None) -> None:
    if seed is None:
        return
    try:
        negative = operator.index(seed) < 0
    except TypeError:
        raise TsbenchError(f"seed must be a whole number or None, not {quoted(seed)}") from None
    if negative:
        raise TsbenchError(f"seed must not be negative, not {seed}")


def _variant(
    name: str,
    variant: str | None,
    reference: ReferenceMotion | None,
    perturbed: bool,
    push: Push | None,
    constants: dict[str, Any],
) -> Any:
    from tsbench import tasks
    from tsbench.core.motion import ReferenceMotion
    from tsbench.sim.kinematic import Planning
    from tsbench.sim.push import Push
    from tsbench.sim.tracking import Imitation

    task = tasks.make(name, **constants)
    for word, value, kind in (("reference", reference, ReferenceMotion), ("push", push, Push)):
        if not isinstance(value, (kind, type(None))):
            given = type(value).__name__
            raise TsbenchError(f"{word} must be a {kind.__name__} or None, not {given}")
    if variant is None:
        return task
    if variant == "planning":
        if perturbed:
            raise TsbenchError("the planning variant has no perturbed starts")
        if push is not None:
            raise TsbenchError("the planning variant has no body to push")
        return Planning(task)
    if variant == "imitation":
        if reference is None:
            raise TsbenchError("the imitation variant needs a reference motion: reference=...")
        return Imitation(task, reference)
    raise unknown("variant", str(variant), VARIANTS)
