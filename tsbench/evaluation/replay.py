"""Whether a score can be had again: what it depends on, and how it is compared.

On the same kind of machine with the same versions, a score repeats bit for bit. On another kind,
numpy and BLAS choose other kernels, and a policy's output may differ in its last bits: the physics
is then replayed from the actions that were kept, and the rest compared within the protocol's
tolerance. mujoco uses none of their kernels, but the reward of a state does: from AVX2 to AVX-512
rewards were seen to differ by 4e-15 of themselves. With another mujoco, another model or another
policy there is nothing to compare.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from tsbench.adapters import ForeignPolicy
from tsbench.evaluation.protocol import Protocol
from tsbench.mdp import Start, Task
from tsbench.motion import ActionLog
from tsbench.policy import Policy
from tsbench.sim.batched import Physics
from tsbench.sim.episodes import PolicyFunction
from tsbench.sim.model import fingerprint

PACKAGES = ("mujoco", "numpy", "scipy", "tsbench")
SAME_REWARD = 1e-12  # of itself, from kernel to kernel; another physics is farther off


@dataclass(frozen=True)
class Origin:
    """What a score depends on.

    Attributes:
        protocol: its name; it holds the seeds.
        task: its name.
        task_version: of it.
        mjcf: sha256 of the task's MJCF, with what the task adds to it.
        model: sha256 of the compiled model.
        constants: sha256 of the values that define the task.
        policy: sha256 of the policy file, or None where there is none.
        packages: versions, Python's too.
        machine: what chooses kernels: architecture, vector extensions, C library.
    """

    protocol: str
    task: str
    task_version: int
    mjcf: str
    model: str
    constants: str
    policy: str | None
    packages: dict[str, str]
    machine: dict[str, str]

    @classmethod
    def here(cls, task: Task[Any], protocol: Protocol, policy: PolicyFunction) -> Origin:
        """Of a score that is made now, here."""
        spec = task.spec()
        model = fingerprint(spec)
        return cls(
            protocol=protocol.name,
            task=task.name,
            task_version=task.version,
            mjcf=hashlib.sha256(spec.to_xml().encode()).hexdigest(),
            model=model,
            constants=constants_hash(task),
            policy=policy.sha256 if isinstance(policy, (Policy, ForeignPolicy)) else None,
            packages={"python": platform.python_version()}
            | {name: version(name) for name in PACKAGES},
            machine=machine(),
        )


def machine() -> dict[str, str]:
    """What decides which numerical kernels run here."""
    extensions = np.show_config(mode="dicts")["SIMD Extensions"]
    return {
        "architecture": platform.machine(),
        "extensions": " ".join([*extensions["baseline"], *extensions["found"]]),
        "libc": " ".join(platform.libc_ver()),
    }


def constants_hash(task: Task[Any]) -> str:
    """sha256 of a task's own constants and of the numbers that its file defines, but for those
    named TRACKING_...: by the reward for imitating, nothing is judged."""
    module = vars(sys.modules[type(task).__module__])
    numbers = {
        name: value
        for name, value in module.items()
        if name.isupper() and not name.startswith("TRACKING_") and _numeric(value)
    }
    content = json.dumps([task.constants(), numbers], sort_keys=True, default=_plain)
    return hashlib.sha256(content.encode()).hexdigest()


def _numeric(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_numeric(part) for part in value)
    return isinstance(value, (int, float, np.ndarray))


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else vars(value)


def episode_starts(task: Task[Any], perturbed: Start) -> Start:
    """The starts of the logged episodes: the nominal one, then the perturbed ones."""
    return Start.joined([task.start(np.random.default_rng(0), 1), perturbed])


def replay(task: Task[Any], starts: Start, log: ActionLog) -> bool:
    """Whether the logged actions earn the logged rewards again, but for `SAME_REWARD`.

    Args:
        task: that the log is of.
        starts: of the nominal and then the perturbed episodes, at least as many as were logged.
        log: actions and rewards.
    """
    count = log.actions.shape[1]
    rows = np.arange(count)
    physics: Physics[Any] = Physics(task, count)
    state = physics.place(rows, starts.rows(slice(0, count)))
    going = np.ones(count, bool)
    for actions, rewards in zip(log.actions, log.rewards, strict=True):
        following = physics.advance(state, actions)
        earned = np.where(going, task.reward(state, actions, following), 0.0)
        if not np.allclose(earned, rewards, rtol=SAME_REWARD, atol=0.0):
            return False
        going &= ~task.terminal(following)
        state = following
    return True


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


def compare(
    kept: Mapping[str, Any],
    again: Mapping[str, Any],
    protocol: Protocol,
    task: Task[Any],
    starts: Start,
    log: ActionLog | None,
) -> Comparison:
    """Compares a kept score with one made again.

    Args:
        kept: a score as plain values.
        again: the same policy's, made here.
        protocol: of the score made here.
        task: of the score made here.
        starts: of the nominal and the perturbed episodes of the score made here.
        log: what was kept of the first score's actions, if anything.
    """
    before, now = kept.get("origin"), again["origin"]
    if not isinstance(before, Mapping):
        return Comparison("none", None, "not compared: the kept score is of an older protocol")
    for name, words in _NOTHING_TO_COMPARE.items():
        if before.get(name) != now[name]:
            seen = f" ({before.get(name)}, not {now[name]})" if name in _SHORT else ""
            return Comparison("none", None, f"not compared: made with another {words}{seen}")
    theirs, ours = before["packages"].get("mujoco"), now["packages"]["mujoco"]
    if theirs != ours:
        words = f"not compared: made with mujoco {theirs}, and this is mujoco {ours}"
        return Comparison("none", None, words)
    others = [
        f"{name} {before[group].get(name)} there, {value} here"
        for group in ("packages", "machine")
        for name, value in now[group].items()
        if before[group].get(name) != value
    ]
    if not others:
        same = _without_origin(kept) == _without_origin(again)
        words = f"compared bit for bit: {'equal' if same else 'DIFFERENT'}"
        return Comparison("exact", same, words)
    differing = differences(kept, again, protocol)
    agrees = not differing
    words = f"compared within {protocol.tolerance:g} ({'; '.join(others)}): "
    words += "in agreement" if agrees else f"DIFFERENT: {', '.join(differing)}"
    if log is None:
        words += "; no action log to replay the physics from"
    else:
        replayed = replay(task, starts, log)
        agrees &= replayed
        words += "; physics replayed from the action log: "
        words += "equal" if replayed else "DIFFERENT"
    return Comparison("tolerant", agrees, words)


_NOTHING_TO_COMPARE = {
    "protocol": "protocol",
    "task": "task",
    "task_version": "version of the task",
    "policy": "policy",
    "mjcf": "MJCF",
    "model": "model",
    "constants": "set of constants of the task",
}
_SHORT = ("protocol", "task", "task_version")


def differences(kept: Mapping[str, Any], again: Mapping[str, Any], protocol: Protocol) -> list[str]:
    """The figures of two scores that differ by more than the protocol tolerates."""
    first, second = _figures(kept), _figures(again)
    found = []
    for name in sorted(first.keys() | second.keys()):
        if name not in first or name not in second:
            found.append(name)
            continue
        bound = protocol.tolerance
        if name == "robustness.impulse_50":
            bound = protocol.impulse_tolerance * max(first[name], second[name])
        # Shares of twenty episodes differ by one: 0.05, which is more than 0.05 in binary.
        if not abs(first[name] - second[name]) <= bound * (1.0 + 1e-9):
            found.append(f"{name} {first[name]:.4g} there, {second[name]:.4g} here")
    return found


def _figures(score: Mapping[str, Any]) -> dict[str, float]:
    """The figures that are compared within a tolerance."""
    parts = {"perturbed": score["perturbed"], **score["changes"]}
    return {
        **{name: score[name] for name in ("normalized_reward", "optimality", "success")},
        **{
            f"{part}.{name}": values[name]
            for part, values in parts.items()
            for name in ("normalized_reward", "success", "violations")
        },
        **{
            f"robustness.{name}": score["robustness"][name]
            for name in ("survival_100N", "impulse_50")
        },
    }


def _without_origin(score: Mapping[str, Any]) -> Any:
    """As it is read back from a file, where tuples are lists."""
    return json.loads(json.dumps({n: v for n, v in score.items() if n != "origin"}))
