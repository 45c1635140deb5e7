"""The score of a policy on a task."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tsbench.errors import TsbenchError
from tsbench.mdp import Task
from tsbench.policy import Policy
from tsbench.sim.batched import Physics
from tsbench.sim.episodes import Episodes, PolicyFunction, play
from tsbench.sim.model import fingerprint

EPISODES = 100  # with perturbed starts
SEED = 0


@dataclass(frozen=True)
class Summary:
    """Means over episodes.

    Attributes:
        episodes: how many.
        normalized_reward: return over the largest conceivable one.
        success: share of episodes solved, as judged at their end.
        violations: share spoiled on the way: a fall, a collision.
        steps: mean length in control steps.
        goal_distance: mean at the end, in metres.
    """

    episodes: int
    normalized_reward: float
    success: float
    violations: float
    steps: float
    goal_distance: float


@dataclass(frozen=True)
class Score:
    """Attributes:
    normalized_reward: of the episode from the task's own start.
    optimality: its return over that of the best motion known (`Task.ideal`).
    success: whether that episode was solved, 0 or 1.
    nominal: that episode.
    perturbed: episodes from perturbed starts.
    seed: of the perturbed starts.
    """

    normalized_reward: float
    optimality: float
    success: float
    nominal: Summary
    perturbed: Summary
    seed: int

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def evaluate(
    policy: PolicyFunction,
    task: Task[Any],
    *,
    episodes: int = EPISODES,
    seed: int = SEED,
    threads: int | None = None,
) -> Score:
    """Plays the task's own start once and `episodes` perturbed starts.

    Raises:
        TsbenchError: the policy was trained for another task, version or physics.
    """
    if isinstance(policy, Policy):
        check_fit(policy, task)
    nominal = _play(policy, task, 1, seed, threads, perturbed=False)
    perturbed = _play(policy, task, episodes, seed, threads, perturbed=True)
    first = _summary(task, nominal)
    return Score(
        normalized_reward=first.normalized_reward,
        optimality=float(nominal.returns[0]) / best_return(task),
        success=first.success,
        nominal=first,
        perturbed=_summary(task, perturbed),
        seed=seed,
    )


def check_fit(policy: Policy, task: Task[Any]) -> None:
    """
    Raises:
        TsbenchError: the policy was trained for another task, version or physics.
    """
    info = policy.info
    if (info.task, info.task_version) != (task.name, task.version):
        raise TsbenchError(
            f"the policy is for {info.task} version {info.task_version}, "
            f"not for {task.name} version {task.version}"
        )
    if info.physics != fingerprint(task.spec()):
        raise TsbenchError(
            f"the policy was trained for {task.name} with another model or other constants"
        )


def best_return(task: Task[Any]) -> float:
    """The return of `Task.ideal`: what is reachable, since no motion earns the largest
    conceivable reward at every step."""
    states = task.ideal()
    before, after = states.rows(slice(0, -1)), states.rows(slice(1, None))
    rewards = task.reward(before, np.zeros((task.horizon, task.action_size)), after)
    length = int(np.argmax([*task.terminal(after), True])) + 1
    credit = (task.horizon - length) * task.max_reward if length <= task.horizon else 0.0
    return float(rewards[:length].sum()) + credit


def _play(
    policy: PolicyFunction,
    task: Task[Any],
    count: int,
    seed: int,
    threads: int | None,
    *,
    perturbed: bool,
) -> Episodes[Any]:
    physics: Physics[Any] = Physics(task, count, threads=threads, perturbed=perturbed)
    return play(task, physics, policy, count, seed)


def _summary(task: Task[Any], episodes: Episodes[Any]) -> Summary:
    solved = task.success(episodes.final) & ~episodes.violated
    return Summary(
        episodes=len(solved),
        normalized_reward=float(episodes.normalized.mean()),
        success=float(solved.mean()),
        violations=float(episodes.violated.mean()),
        steps=float(episodes.lengths.mean()),
        goal_distance=float(task.goal_distance(episodes.final).mean()),
    )
