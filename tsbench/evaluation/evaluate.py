"""The score of a policy on a task, by a protocol."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from tsbench.errors import TsbenchError
from tsbench.evaluation.protocol import V1, Protocol
from tsbench.evaluation.replay import Origin
from tsbench.evaluation.robustness import Robustness, robustness
from tsbench.mdp import Start, Task
from tsbench.motion import ActionLog
from tsbench.policy import Policy
from tsbench.sim.batched import Physics
from tsbench.sim.change import Change
from tsbench.sim.episodes import Episodes, PolicyFunction, play
from tsbench.sim.model import fingerprint


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
    protocol: its name.
    normalized_reward: of the episode from the task's own start.
    optimality: its return over that of the best motion known (`Task.ideal`).
    success: whether that episode was solved, 0 or 1.
    nominal: that episode.
    perturbed: episodes from perturbed starts.
    changes: episodes in changed physics, by the name of the condition.
    robustness: survival under pushes.
    origin: what it depends on.
    log: actions to replay the physics from.
    """

    protocol: str
    normalized_reward: float
    optimality: float
    success: float
    nominal: Summary
    perturbed: Summary
    changes: dict[str, Summary]
    robustness: Robustness
    origin: Origin
    log: ActionLog = field(compare=False, repr=False)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, all but the log."""
        values = {name: value for name, value in vars(self).items() if name != "log"}
        for name in ("nominal", "perturbed", "robustness", "origin"):
            values[name] = asdict(values[name])
        return values | {"changes": {name: asdict(part) for name, part in self.changes.items()}}


def evaluate(
    policy: PolicyFunction,
    task: Task[Any],
    *,
    protocol: Protocol = V1,
    threads: int | None = None,
) -> Score:
    """Scores a policy. `threads` None means all cores, and changes nothing but the time.

    Raises:
        TsbenchError: the policy was trained for another task, version or physics.
    """
    if isinstance(policy, Policy):
        check_fit(policy, task)
    nominal = play(task, Physics(task, 1, threads=threads), policy, 1)
    starts = perturbed_starts(task, protocol)
    perturbed = _play(policy, task, starts, threads)
    some = starts.rows(slice(0, protocol.changed))
    first = _summary(task, nominal)
    return Score(
        protocol=protocol.name,
        normalized_reward=first.normalized_reward,
        optimality=float(nominal.returns[0]) / best_return(task),
        success=first.success,
        nominal=first,
        perturbed=_summary(task, perturbed),
        changes={
            condition.name: _summary(
                task, _play(policy, task, some, threads, condition.change, condition.delay)
            )
            for condition in protocol.conditions
        },
        robustness=robustness(policy, task, protocol, threads),
        origin=Origin.here(task, protocol, policy),
        log=ActionLog(
            task=task.name,
            task_version=task.version,
            timestep=task.timestep,
            actions=_logged(nominal.actions, perturbed.actions, protocol),
            rewards=_logged(nominal.rewards, perturbed.rewards, protocol),
        ),
    )


def _logged(nominal: np.ndarray, perturbed: np.ndarray, protocol: Protocol) -> np.ndarray:
    return np.concatenate([nominal, perturbed[:, : protocol.logged]], axis=1)


def perturbed_starts(task: Task[Any], protocol: Protocol) -> Start:
    """Episode i starts as a dm_control environment of the task seeded with (seed, i) does."""
    return Start.joined(
        [
            task.start(np.random.default_rng((protocol.seed, episode)), 1, perturbed=True)
            for episode in range(protocol.perturbed)
        ]
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
    starts: Start,
    threads: int | None,
    change: Change | None = None,
    delay: int = 0,
) -> Episodes[Any]:
    count = len(starts.time)
    physics: Physics[Any] = Physics(task, count, threads=threads, change=change)
    begin = physics.place(np.arange(count), starts)
    return play(task, physics, policy, count, begin=begin, delay=delay)


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
