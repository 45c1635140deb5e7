"""Compares a kept score with a score of the same policy that was made again.

On the same kind of machine with the same versions, a score repeats bit for bit. On another kind of
machine, numpy and BLAS choose other kernels, and a policy's output may differ in its last bits. The
physics is then replayed from the kept actions, and the other figures are compared within the
protocol's tolerance. mujoco uses none of these kernels, but the reward of a state does: rewards on
AVX2 and on AVX-512 differ by about 4e-15 of their value. Scores by another mujoco, another model or
another policy are not compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tsbench.core.arrays import Array
from tsbench.core.motion import ActionLog
from tsbench.core.state import Start
from tsbench.core.task import Task
from tsbench.evaluation.evaluate import summarised
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.protocol import perturbed_starts
from tsbench.evaluation.robustness import impulse_50, mass_scale
from tsbench.evaluation.score import Score, Summary
from tsbench.sim.episodes import play
from tsbench.sim.physics import Physics

SAME_REWARD = 1e-12  # relative difference between kernels; other physics differs by more
# Times the protocol's tolerance, for figures by which nothing is ranked: lengths and measures of
# the perturbed episodes as shares of themselves, and the share of pushes that end otherwise.
LOOSE = 3.0
_IMPULSES = ("impulse_50", "impulse_50_is_lower_bound")


def replay(task: Task[Any], score: Score, log: ActionLog) -> bool:
    """Whether the logged actions earn the logged rewards again, to within `SAME_REWARD`.

    The first logged episode must also have every nominal figure of the score, and the others must
    be solved where the score says so.

    Args:
        task: the task of the score.
        score: the score with which the log was kept.
        log: actions and rewards.
    """
    protocol = score.origin.protocol
    own = task.start(np.random.default_rng(0), 1)
    others = perturbed_starts(task, protocol).rows(slice(0, protocol.logged))
    shape = (task.horizon, 1 + len(others.time), task.action_size)
    if (log.task, log.task_version, log.actions.shape) != (task.name, task.version, shape):
        return False
    nominal = _again(task, own, log.actions[:, :1], log.rewards[:, :1])
    if nominal is None or not _equal(nominal, score.nominal):
        return False
    if not protocol.logged:
        return True
    perturbed = _again(task, others, log.actions[:, 1:], log.rewards[:, 1:])
    return perturbed is not None and (
        perturbed.solved == score.perturbed.solved[: len(perturbed.solved)]
    )


def _equal(first: Summary, second: Summary) -> bool:
    """Whether two summaries have the same figures, to within `SAME_REWARD`."""
    one, other = ({**vars(each), **each.measures} for each in (first, second))
    numbers = {name for name, value in one.items() if isinstance(value, float)}
    return all(
        isinstance(other.get(name), float)
        and np.isclose(one[name], other[name], rtol=SAME_REWARD, atol=0.0)
        for name in numbers
    ) and all(one[name] == other.get(name) for name in one.keys() - numbers - {"measures"})


def _again(task: Task[Any], start: Start, actions: Array, rewards: Array) -> Summary | None:
    """The summary of episodes that are played from their actions alone, or None if they earn other
    rewards.

    Args:
        task: what is played.
        start: of n episodes.
        actions: shape (T, n, action_size).
        rewards: that they earned, shape (T, n).
    """
    count = len(start.time)
    physics: Physics[Any] = Physics(task, count, threads=1)
    begin = physics.place(np.arange(count), start)
    found = play(task, physics, actions, count, begin=begin, measure=task.measured)
    same = np.allclose(found.rewards, rewards, rtol=SAME_REWARD, atol=0.0)
    return summarised(task, found) if same else None


@dataclass(frozen=True)
class Comparison:
    """Attributes:
    kind: "exact", "tolerant", or "none" for scores that cannot be compared.
    agrees: whether the scores agree; None for scores that cannot be compared.
    words: the comparison and its result, in words.
    """

    kind: str
    agrees: bool | None
    words: str


def compare(kept: Score, again: Score, task: Task[Any], log: ActionLog | None) -> Comparison:
    """Compares a kept score with one made again.

    Args:
        kept: the kept score.
        again: the score of the same policy that was made here.
        task: the task of the score that was made here.
        log: the kept actions of the first score, or None.
    """
    before, now = kept.origin, again.origin
    if words := incomparable(before, now):
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
    differing = contradictions(kept, task)
    differing += differences(kept, again, task)
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


def incomparable(before: Origin, now: Origin) -> str:
    """The first difference that makes two scores incomparable, in words; empty if there is none."""
    protocol = replace(now.protocol, seed=before.protocol.seed)
    named: list[tuple[str, object, object]] = [
        ("another protocol", before.protocol.name, now.protocol.name),
        ("another task", before.task, now.task),
        ("another version of the task", before.task_version, now.task_version),
        ("another mujoco", before.packages.get("mujoco"), now.packages["mujoco"]),
    ]
    unnamed: list[tuple[str, object, object]] = [  # too long to print, or a seed that may be secret
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


def differences(kept: Score, again: Score, task: Task[Any]) -> list[str]:
    """The figures of two scores that differ by more than the protocol tolerates.

    Args:
        kept: a score.
        again: another score by the same protocol.
        task: of both. The tolerance of rewards is a share of the normalized reward of the best
            motion known; that of distances a share of the distance from start to goal; that of
            steps in changed physics, of few episodes, a share of the horizon.
    """
    protocol = again.origin.protocol
    best = best_return(task) / (task.max_reward * task.horizon)
    far = float(task.goal_distance(task.ideal())[0])
    first, second = _figures(kept), _figures(again)
    found = []
    for name in sorted(first.keys() | second.keys()):
        if name not in first or name not in second:
            found.append(name)
            continue
        bound = protocol.tolerance
        if name.endswith("impulse_50"):
            bound = protocol.impulse_tolerance * max(first[name], second[name])
        elif name.endswith("_reward"):
            bound *= best
        elif name.endswith(": goal_distance"):
            bound *= LOOSE * far
        elif name.startswith("perturbed: "):
            bound *= LOOSE * max(abs(first[name]), abs(second[name]))
        elif name.endswith(": steps"):
            bound *= LOOSE * task.horizon
        # One of twenty episodes is a share of 0.05, which rounding may make larger than the bound.
        if not abs(first[name] - second[name]) <= bound * (1.0 + 1e-9):
            found.append(f"{name} {first[name]:.4g} there, {second[name]:.4g} here")
    for name in ("survived", "recovered"):
        cells = [np.array(getattr(one.robustness.surface, name)) for one in (kept, again)]
        other = float(np.mean(cells[0] != cells[1])) if cells[0].shape == cells[1].shape else 1.0
        if other > LOOSE * protocol.tolerance:
            found.append(f"{name}: {other:.0%} of the pushes")
    return found


def contradictions(score: Score, task: Task[Any]) -> list[str]:
    """What in a score cannot be, whatever the policy: figures that do not follow from each other
    or from the protocol.

    Args:
        score: that somebody claims.
        task: of the score.
    """
    protocol, robustness = score.origin.protocol, score.robustness
    surface, found = robustness.surface, []
    counts = {"nominal": (score.nominal, 1), "perturbed": (score.perturbed, protocol.perturbed)}
    counts |= {name: (one, protocol.changed) for name, one in score.changes.items()}
    for name, (summary, episodes) in counts.items():
        found += [f"{name}: {what}" for what in _impossible(summary, episodes, task)]
    if score.changes.keys() != {condition.name for condition in protocol.conditions}:
        found.append("the changes are not those of the protocol")
    plans = score.normalized_reward * task.max_reward * task.horizon / best_return(task)
    if not np.isclose(score.against_plan, plans, rtol=1e-9, atol=1e-12):
        found.append("against_plan does not follow from normalized_reward")
    scale = mass_scale(task)
    forces = np.array(protocol.forces, float) * scale
    asked = (tuple(forces.tolist()), tuple(protocol.directions().tolist()))
    phases = tuple(task.push_steps[:: protocol.phases])
    if (robustness.mass_scale, robustness.push_duration_s) != (scale, protocol.duration) or (
        surface.forces_N, surface.headings_rad, surface.phases
    ) != (*asked, phases):  # fmt: skip
        return [*found, "the pushes are not those of the protocol"]
    claim = protocol.forces.index(protocol.claim)
    for kind, cells in (("survival", surface.survived), ("recovery", surface.recovered)):
        held = np.array(cells)
        if not np.isin(held, (0, 1)).all():
            found.append(f"{kind}: a push has another outcome than 0 or 1")
            continue
        if getattr(robustness, f"{kind}_100N") != float(held[claim].mean()):
            found.append(f"{kind}_100N is not that of the surface")
        claimed = tuple(getattr(robustness, f"{kind}_{n}") for n in _IMPULSES)
        shares, impulses = held.mean(axis=(1, 2)), forces * protocol.duration
        # Whether the episode without a push was survived no figure says.
        possible = [impulse_50(impulses, shares, calm) for calm in (True, False)]
        if not any(np.allclose(claimed, one, rtol=1e-9, atol=0.0) for one in possible):
            found.append(f"{kind}_impulse_50 is not that of the surface")
    return found


def _impossible(summary: Summary, episodes: int, task: Task[Any]) -> list[str]:
    found = []
    if summary.episodes != episodes:
        found.append(f"{summary.episodes} episodes, not {episodes}")
    if not 0.0 < summary.steps <= task.horizon:
        found.append(f"{summary.steps:.4g} steps of {task.horizon}")
    for name in ("violations", "steps"):
        total = getattr(summary, name) * summary.episodes
        if not np.isclose(total, round(total), rtol=1e-12, atol=1e-9):
            found.append(f"{name} is no mean of {summary.episodes} counts")
    if not abs(summary.normalized_reward) <= 1.0:
        found.append("normalized_reward is beyond 1")
    if summary.success == 0.0 and summary.solved_reward != 0.0:
        found.append("solved_reward without a solved episode")
    if summary.success == 1.0 and summary.solved_reward != summary.normalized_reward:
        found.append("solved_reward is not normalized_reward, though every episode was solved")
    if abs(summary.solved_reward) > summary.success + 1e-12:
        found.append("solved_reward is larger than success")
    if not summary.goal_distance >= 0.0:
        found.append("goal_distance is negative")
    if set(summary.measures) != set(task.measure_notes):
        found.append("the measures are not the task's")
    return found


def _figures(score: Score) -> dict[str, float]:
    """The figures that are compared within a tolerance.

    The figures of the nominal episode are left out, because the last bit of an action may change
    the outcome of a single episode. Its physics is replayed instead. So are the measures in changed
    physics: of twenty episodes, few may have arrived.
    """
    return {
        "against_plan": score.against_plan,
        **{
            f"{part}.{name}": getattr(summary, name)
            for part, summary in {"perturbed": score.perturbed, **score.changes}.items()
            for name in ("solved_reward", "normalized_reward", "success", "violations")
        },
        **{f"{name}: steps": summary.steps for name, summary in score.changes.items()},
        **{
            f"{part}: goal_distance": summary.goal_distance
            for part, summary in {"perturbed": score.perturbed, **score.changes}.items()
        },
        "perturbed: steps": score.perturbed.steps,
        **{
            f"perturbed: {name}": value
            for name, value in score.perturbed.measures.items()
            if value is not None
        },
        **{
            f"robustness.{name}": getattr(score.robustness, name)
            for name in (
                "survival_100N",
                "recovery_100N",
                "survival_impulse_50",
                "recovery_impulse_50",
            )
        },
    }
