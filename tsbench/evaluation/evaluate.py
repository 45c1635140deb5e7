"""Scores a policy by a protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from tsbench.core.errors import NotFiniteError, TsbenchError
from tsbench.core.motion import ActionLog
from tsbench.core.policy import Policy
from tsbench.core.state import Start
from tsbench.core.task import Task
from tsbench.evaluation.oracle import best_return, known_mean
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.protocol import V1, Condition, Protocol, perturbed_starts
from tsbench.evaluation.robustness import robustness
from tsbench.evaluation.score import Score, Summary
from tsbench.sim.dynamics import Engine
from tsbench.sim.episodes import Episodes, PolicyFunction, play
from tsbench.sim.model import fingerprint
from tsbench.sim.physics import Physics


def evaluate(
    policy: PolicyFunction,
    task: Task[Any],
    *,
    protocol: Protocol = V1,
    threads: int | None = None,
    progress: Callable[[float], None] | None = None,
    engine: Engine = Physics,
) -> Score:
    """Scores a policy.

    Args:
        policy: a function from observations of the task to actions.
        task: the task, with the constants under which the policy is scored.
        protocol: the protocol of the score.
        threads: of the physics, None for all cores. Their number changes only the time taken.
        progress: called now and then with the share that is done, up to 1.
        engine: the physics that plays everything. Only scores by `Physics` can be ranked; for
            another engine the protocol must be of other physics (`Protocol.elsewhere`).

    Raises:
        TsbenchError: the policy was trained for another task, version or physics.
        NotFiniteError: a number in action, state or reward is not finite. The message says in which
            part of the protocol.
    """
    if isinstance(policy, Policy):
        check_fit(policy, task)
    origin = Origin.here(task, protocol, policy)
    if progress is not None:
        policy = _watched(policy, task, protocol, progress)
    here = Condition("unchanged physics", protocol.physics)
    starts = perturbed_starts(task, protocol)
    some = starts.rows(slice(0, protocol.changed))
    nominal = _play(policy, task, task.start(np.random.default_rng(0), 1), here, threads, engine)
    perturbed = _play(policy, task, starts, here, threads, engine)
    summary = summarised(task, perturbed)
    changes = {
        condition.name: summarised(
            task, _play(policy, task, some, condition.on(protocol.physics), threads, engine)
        )
        for condition in protocol.conditions
    }
    with _told("pushed"):
        pushes = robustness(policy, task, protocol, threads, engine)
    return Score(
        protocol=protocol.name,
        solved_reward=summary.solved_reward,
        normalized_reward=summary.normalized_reward,
        success=summary.success,
        against_plan=float(perturbed.returns.mean()) / best_return(task),
        perturbed=summary,
        nominal=summarised(task, nominal),
        changes=changes,
        robustness=pushes,
        origin=origin,
        log=ActionLog(
            task=task.name,
            task_version=task.version,
            timestep=task.timestep,
            actions=_logged(nominal.actions, perturbed.actions, protocol),
            rewards=_logged(nominal.rewards, perturbed.rewards, protocol),
        ),
    )


def solved_rewards(
    policy: PolicyFunction, task: Task[Any], protocol: Protocol, threads: int | None = None
) -> np.ndarray:
    """The normalized reward of each perturbed episode, zero where it was not solved, shape (n,).
    `Score.solved_reward` is their mean."""
    here = Condition("unchanged physics", protocol.physics)
    episodes = _play(policy, task, perturbed_starts(task, protocol), here, threads, Physics)
    rewards: np.ndarray = episodes.normalized * task.success(episodes.final, episodes.course)
    return rewards


def _watched(
    policy: PolicyFunction, task: Task[Any], protocol: Protocol, progress: Callable[[float], None]
) -> PolicyFunction:
    """The same policy, which also reports the share of all observations that it has answered. An
    episode that ends early makes the share jump."""
    phases = np.array(task.push_steps[:: protocol.phases])
    pushes = len(protocol.forces) * protocol.headings * int((task.horizon - phases).sum())
    episodes = 2 + protocol.perturbed + len(protocol.conditions) * protocol.changed
    total, seen = episodes * task.horizon + pushes, 0

    def watched(observation: np.ndarray) -> np.ndarray:
        nonlocal seen
        seen += len(observation)
        progress(seen / total)
        return policy(observation)

    return watched


def _logged(nominal: np.ndarray, perturbed: np.ndarray, protocol: Protocol) -> np.ndarray:
    return np.concatenate([nominal, perturbed[:, : protocol.logged]], axis=1)


def check_fit(policy: Policy, task: Task[Any]) -> None:
    """Checks that a policy was trained for this task.

    Raises:
        TsbenchError: the policy was trained for another task, version or physics, or is of other
            sizes.
    """
    info = policy.info
    if (info.task, info.task_version) != (task.name, task.version):
        raise TsbenchError(
            f"the policy is for {info.task} version {info.task_version}, "
            f"not for {task.name} version {task.version}"
        )
    sizes, wanted = (info.layers[0], info.layers[-1]), (task.observation_size, task.action_size)
    if sizes != wanted:
        raise TsbenchError(
            f"the policy maps {sizes[0]} observations to {sizes[1]} actions, "
            f"{task.name} has {wanted[0]} and {wanted[1]}"
        )
    if info.physics != fingerprint(task.spec()):
        raise TsbenchError(
            f"the policy was trained for {task.name} with another model or other constants"
        )


def _play(
    policy: PolicyFunction,
    task: Task[Any],
    starts: Start,
    condition: Condition,
    threads: int | None,
    engine: Engine,
) -> Episodes[Any]:
    count = len(starts.time)
    physics = engine(task, count, threads=threads, change=condition.change)
    begin = physics.place(np.arange(count), starts)
    delay = condition.delay
    with _told(condition.name):
        return play(task, physics, policy, count, begin=begin, delay=delay, measure=task.measured)


@contextmanager
def _told(part: str) -> Iterator[None]:
    """Says of a number that is not finite in which part of a protocol it came up."""
    try:
        yield
    except NotFiniteError as error:
        raise NotFiniteError(f"{error} ({part})", error.arrays) from None


def summarised(task: Task[Any], episodes: Episodes[Any]) -> Summary:
    """The means over episodes that were played with `task.measured`."""
    solved = np.asarray(task.success(episodes.final, episodes.course), bool)
    found = task.measures(
        episodes.first, episodes.final, episodes.course, episodes.sums, episodes.lengths
    )
    return Summary(
        episodes=len(solved),
        normalized_reward=float(episodes.normalized.mean()),
        solved_reward=float((episodes.normalized * solved).mean()),
        success=float(solved.mean()),
        violations=float(episodes.course.violated.mean()),
        steps=float(episodes.lengths.mean()),
        goal_distance=float(task.goal_distance(episodes.final).mean()),
        measures={name: known_mean(values) for name, values in found.items()},
        solved=tuple(solved.astype(int).tolist()),
    )
