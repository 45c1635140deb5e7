"""Whether a score can be had again, and how that is found out.

On the same kind of machine with the same versions, a score repeats bit for bit. On another kind,
numpy and BLAS choose other kernels, and a policy's output may differ in its last bits: the physics
is then replayed from the actions that were kept, and the rest compared within the protocol's
tolerance. mujoco uses none of their kernels, but the reward of a state does: from AVX2 to AVX-512
rewards were seen to differ by 4e-15 of themselves. With another mujoco, another model or another
policy there is nothing to compare.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tsbench.core.motion import ActionLog
from tsbench.core.state import Start
from tsbench.core.task import Task
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.protocol import perturbed_starts
from tsbench.evaluation.score import Score
from tsbench.sim.episodes import Episodes, play
from tsbench.sim.physics import Physics

SAME_REWARD = 1e-12  # of itself, from kernel to kernel; another physics is farther off


def replay(task: Task[Any], score: Score, log: ActionLog) -> bool:
    """Whether the logged actions earn the logged rewards again, and those of the first episode the
    score, but for `SAME_REWARD`.

    Args:
        task: of the score.
        score: that the log was kept with.
        log: actions and rewards.
    """
    protocol = score.origin.protocol
    starts = Start.joined(
        [
            task.start(np.random.default_rng(0), 1),
            perturbed_starts(task, protocol).rows(slice(0, protocol.logged)),
        ]
    )
    shape = (task.horizon, len(starts.time), task.action_size)
    if (log.task, log.task_version, log.actions.shape) != (task.name, task.version, shape):
        return False
    for i, rewards in enumerate(log.rewards.T):
        episode = _again(task, starts.rows(slice(i, i + 1)), log.actions[:, i : i + 1])
        if not np.allclose(episode.rewards[:, 0], rewards, rtol=SAME_REWARD, atol=0.0):
            return False
        earned = episode.normalized[0]
        if i == 0 and not np.isclose(earned, score.normalized_reward, rtol=SAME_REWARD, atol=0.0):
            return False
    return True


def _again(task: Task[Any], start: Start, actions: np.ndarray) -> Episodes[Any]:
    """One episode, by its actions alone, shape (T, 1, action_size)."""
    physics: Physics[Any] = Physics(task, 1)
    following = iter(actions)
    begin = physics.place(np.arange(1), start)
    return play(task, physics, lambda _: next(following), 1, begin=begin)


@dataclass(frozen=True)
class Comparison:
    """Attributes:
    kind: "exact", "tolerant", or "none" where there was nothing to compare.
    agrees: whether the scores do; None where there was nothing to compare.
    words: which comparison was made, and what came of it.
    """

    kind: str
    agrees: bool | None
    words: str


def compare(kept: Score, again: Score, task: Task[Any], log: ActionLog | None) -> Comparison:
    """Compares a kept score with one made again.

    Args:
        kept: the first score.
        again: the same policy's, made here.
        task: of the score made here.
        log: what was kept of the first score's actions, if anything.
    """
    before, now = kept.origin, again.origin
    if words := _incomparable(before, now):
        return Comparison("none", None, f"not compared: made with {words}")
    others = [
        f"{name} {there.get(name)} there, {value} here"
        for there, here in ((before.packages, now.packages), (before.machine, now.machine))
        for name, value in here.items()
        if there.get(name) != value
    ]
    if not others:
        same = replace(kept, origin=now) == again
        words = f"compared bit for bit: {'equal' if same else 'DIFFERENT'}"
        return Comparison("exact", same, words)
    differing = differences(kept, again, best_return(task) / (task.max_reward * task.horizon))
    agrees = not differing
    words = f"compared within {now.protocol.tolerance:g} ({'; '.join(others)}): "
    words += "in agreement" if agrees else f"DIFFERENT: {', '.join(differing)}"
    if log is None:
        words += "; no action log to replay the physics from"
    else:
        replayed = replay(task, kept, log)
        agrees &= replayed
        words += "; physics replayed from the action log: "
        words += "equal" if replayed else "DIFFERENT"
    return Comparison("tolerant", agrees, words)


def _incomparable(before: Origin, now: Origin) -> str:
    """What two scores do not have in common that makes them scores of different things."""
    protocol = replace(now.protocol, seed=before.protocol.seed)
    named: list[tuple[str, object, object]] = [
        ("another protocol", before.protocol.name, now.protocol.name),
        ("another task", before.task, now.task),
        ("another version of the task", before.task_version, now.task_version),
        ("another mujoco", before.packages.get("mujoco"), now.packages["mujoco"]),
    ]
    unnamed: list[tuple[str, object, object]] = [  # long, or a seed that may be secret
        ("other numbers in the protocol", before.protocol, protocol),
        ("another seed", before.protocol.seed, now.protocol.seed),
        ("another policy", before.policy, now.policy),
        ("another MJCF", before.mjcf, now.mjcf),
        ("another model", before.model, now.model),
        ("another set of constants of the task", before.constants, now.constants),
    ]
    for words, there, here in named:
        if there != here:
            return f"{words} ({there}, not {here})"
    return next((words for words, there, here in unnamed if there != here), "")


def differences(kept: Score, again: Score, best: float) -> list[str]:
    """The figures of two scores that differ by more than the protocol tolerates.

    Args:
        kept: a score.
        again: another, by the same protocol.
        best: normalized reward of the best motion known: the tolerance of rewards is a share of it.
    """
    protocol = again.origin.protocol
    first, second = _figures(kept), _figures(again)
    found = []
    for name in sorted(first.keys() | second.keys()):
        if name not in first or name not in second:
            found.append(name)
            continue
        bound = protocol.tolerance
        if name == "robustness.impulse_50":
            bound = protocol.impulse_tolerance * max(first[name], second[name])
        elif name.endswith("normalized_reward"):
            bound *= best
        # Shares of twenty episodes differ by one: 0.05, which is more than 0.05 in binary.
        if not abs(first[name] - second[name]) <= bound * (1.0 + 1e-9):
            found.append(f"{name} {first[name]:.4g} there, {second[name]:.4g} here")
    return found


def _figures(score: Score) -> dict[str, float]:
    """The figures that are compared within a tolerance."""
    return {
        "normalized_reward": score.normalized_reward,
        "optimality": score.optimality,
        "success": score.success,
        **{
            f"{part}.{name}": getattr(summary, name)
            for part, summary in {"perturbed": score.perturbed, **score.changes}.items()
            for name in ("normalized_reward", "success", "violations")
        },
        "robustness.survival_100N": score.robustness.survival_100N,
        "robustness.impulse_50": score.robustness.impulse_50,
    }
