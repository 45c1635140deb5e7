"""Whether a score repeats, and which comparison that was."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsbench import TsbenchError, tasks
from tsbench.core.motion import ActionLog
from tsbench.core.typed import typed
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.origin import constants_hash, machine
from tsbench.evaluation.protocol import SMOKE
from tsbench.evaluation.replay import compare, contradictions, differences, replay
from tsbench.evaluation.score import Score
from tsbench.tasks import laikago, rocket

PROTOCOL = replace(SMOKE, perturbed=3, logged=2, conditions=SMOKE.conditions[:1], forces=(100.0,))
TASK = tasks.make("laikago_trot", distance=0.4)  # 24 steps
BEST = best_return(TASK) / (TASK.max_reward * TASK.horizon)


def shuffle(observation: np.ndarray) -> np.ndarray:
    action: np.ndarray = 0.1 * np.sin(20.0 * observation[:, :12])
    return action


@pytest.fixture(scope="module")
def score() -> Score:
    return evaluate(shuffle, TASK, protocol=PROTOCOL, threads=1)


@pytest.fixture(scope="module")
def log(score: Score) -> ActionLog:
    assert score.log is not None
    return score.log


def elsewhere(score: Score, **changes: Any) -> Score:
    """The same, but made where something was different."""
    return replace(score, origin=replace(score.origin, **changes))


def with_perturbed(score: Score, **changes: Any) -> Score:
    """The same with other figures of the perturbed starts, which are its headlines too."""
    perturbed = replace(score.perturbed, **changes)
    headlines = ("solved_reward", "normalized_reward", "success")
    return replace(
        score, perturbed=perturbed, **{name: getattr(perturbed, name) for name in headlines}
    )


def on_another_machine(score: Score) -> Score:
    return elsewhere(score, machine=score.origin.machine | {"extensions": "other"})


def test_a_score_is_read_back_as_it_was(score: Score) -> None:
    assert typed(Score, json.loads(json.dumps(score.as_dict())), "") == score


def test_what_a_score_says_of_its_origin(score: Score) -> None:
    origin = score.origin
    assert (origin.protocol, origin.protocol.seed) == (PROTOCOL, 0)
    assert (origin.task, origin.task_version) == ("laikago_trot", TASK.version)
    assert set(origin.packages) == {"python", "mujoco", "numpy", "scipy", "tsbench"}
    assert origin.machine == machine()
    assert origin.machine["architecture"]
    assert origin.machine["blas"].split()[0] in ("openblas", "mkl", "blis", "flexiblas", "None")
    assert len({origin.mjcf, origin.model, origin.constants}) == 3
    assert origin.policy is None  # a function has no file


def test_a_machine_is_the_same_in_every_process() -> None:
    """numpy and scipy bring a BLAS each, and they are found in no order."""
    program = "import scipy.stats; from tsbench.evaluation.origin import machine; print(machine())"
    told = {
        subprocess.run(
            [sys.executable, "-c", program],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PYTHONHASHSEED": str(seed)},
        ).stdout.strip()
        for seed in range(4)
    }
    assert told == {str(machine())}


def test_the_constants_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    """It changes with every value that a task says decides its scores, and with nothing else."""
    before = constants_hash(TASK)
    assert before == constants_hash(tasks.make("laikago_trot", distance=0.4))
    assert before != constants_hash(tasks.make("laikago_trot"))
    assert before != constants_hash(tasks.make("laikago_walk", distance=0.4))
    for module, task in ((laikago, TASK), (rocket, tasks.make("rocket_obstacles"))):
        before = constants_hash(task)
        for field in fields(module.C):
            value = getattr(module.C, field.name)
            other = (*value[::-1], 7.0) if isinstance(value, tuple) else value * 1.01
            with monkeypatch.context() as changed:
                changed.setattr(module, "C", replace(module.C, **{field.name: other}))
                assert before != constants_hash(task), field.name
    monkeypatch.setattr(rocket, "TRACKING_DECAY", -1.0)
    assert before == constants_hash(tasks.make("rocket_obstacles"))


@dataclass(frozen=True)
class Bounds:
    """What a task may have among its constants."""

    speed: float
    names: tuple[str, ...]


@pytest.mark.parametrize(
    "changed",
    [
        {"decay": -11.0},
        {"steps": 4},
        {"bounds": Bounds(1.0, ("x", "z"))},
        {"table": {"0.5": Bounds(2.0, ("x",))}},
        {"another": 0},
    ],
)
def test_the_constants_hash_is_of_what_the_task_says(
    changed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is nested, in any order; the names of its module's constants do not count."""
    constants = {
        "decay": -10.0,
        "steps": 3,
        "bounds": Bounds(1.0, ("x", "y")),
        "table": {"0.5": Bounds(1.0, ("x",))},
    }
    assert constants_hash(TASK) == constants_hash(tasks.make("laikago_trot", distance=0.4))
    assert constants_hash(TASK) != constants_hash(tasks.make("laikago_trot"))
    monkeypatch.setattr(type(TASK), "constants", lambda _: constants)
    before = constants_hash(TASK)
    monkeypatch.setattr("tsbench.tasks.laikago.A_NEW_ONE", 1.0, raising=False)
    assert constants_hash(TASK) == before
    monkeypatch.setattr(type(TASK), "constants", lambda _: dict(reversed(constants.items())))
    assert constants_hash(TASK) == before
    monkeypatch.setattr(type(TASK), "constants", lambda _: constants | changed)
    assert constants_hash(TASK) != before


def test_bit_for_bit(score: Score, log: ActionLog) -> None:
    found = compare(score, score, TASK, log)
    assert (found.kind, found.agrees) == ("exact", True)
    assert found.words == "compared bit for bit: equal"
    perturbed = score.perturbed
    least = float(np.nextafter(perturbed.normalized_reward, 1.0))
    kept = with_perturbed(score, normalized_reward=least)
    found = compare(kept, score, TASK, log)
    assert (found.kind, found.agrees) == ("exact", False)
    assert found.words == "compared bit for bit: DIFFERENT"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"protocol": replace(PROTOCOL, name="v1")}, "another protocol (v1, not smoke)"),
        ({"protocol": replace(PROTOCOL, seed=1)}, "another seed"),
        ({"protocol": replace(PROTOCOL, perturbed=5)}, "other numbers in the protocol"),
        ({"protocol": replace(PROTOCOL, perturbed=5, seed=1)}, "other numbers in the protocol"),
        ({"task": "laikago_walk"}, "another task (laikago_walk, not laikago_trot)"),
        ({"task_version": 0}, "another version of the task (0, not 1)"),
        ({"mjcf": "0"}, "another MJCF"),
        ({"model": "0"}, "another model"),
        ({"constants": "0"}, "another set of constants of the task"),
        ({"policy": "0"}, "another policy"),
    ],
)
def test_nothing_to_compare(
    score: Score, log: ActionLog, changes: dict[str, Any], words: str
) -> None:
    found = compare(elsewhere(score, **changes), score, TASK, log)
    assert (found.kind, found.agrees) == ("none", None)
    assert found.words == f"not compared: made with {words}"


def test_another_mujoco(score: Score, log: ActionLog) -> None:
    """It compiles another model, and that is not what is to be told."""
    here = score.origin.packages["mujoco"]
    packages = score.origin.packages | {"mujoco": "3.16.0"}
    found = compare(elsewhere(score, packages=packages, model="0"), score, TASK, log)
    assert (found.kind, found.agrees) == ("none", None)
    assert found.words == f"not compared: made with another mujoco (3.16.0, not {here})"


@pytest.mark.parametrize(("group", "name"), [("packages", "numpy"), ("machine", "extensions")])
def test_another_kind_of_machine(score: Score, log: ActionLog, group: str, name: str) -> None:
    """The physics is replayed from the actions, the rest may differ a little."""
    there = elsewhere(score, **{group: getattr(score.origin, group) | {name: "other"}})
    reward = score.perturbed.normalized_reward
    higher = reward + 0.9 * PROTOCOL.tolerance * BEST
    near = with_perturbed(there, normalized_reward=higher)
    assert "against_plan does not follow" in compare(near, score, TASK, log).words
    found = compare(replace(near, against_plan=higher / BEST), score, TASK, log)
    assert (found.kind, found.agrees) == ("tolerant", True)
    assert f"({name} other there, {getattr(score.origin, group)[name]} here)" in found.words
    assert "within 0.05" in found.words
    assert "in agreement" in found.words
    assert found.words.endswith("replayed from the action log: equal")

    impulse = score.robustness.survival_impulse_50
    other = replace(score, robustness=replace(score.robustness, survival_impulse_50=1.05 * impulse))
    assert differences(other, score, TASK) == []
    assert (
        "survival_impulse_50 is not that of the surface"
        in compare(replace(other, origin=there.origin), score, TASK, log).words
    )

    far = with_perturbed(there, normalized_reward=reward + 1.1 * PROTOCOL.tolerance * BEST)
    further = 3.0 + 2.0 * impulse
    kept = replace(far, robustness=replace(score.robustness, survival_impulse_50=further))
    found = compare(kept, score, TASK, log)
    assert (found.kind, found.agrees) == ("tolerant", False)
    assert "perturbed.normalized_reward" in found.words
    assert "robustness.survival_impulse_50" in found.words

    assert "no action log" in compare(kept, score, TASK, None).words


def test_a_difference_of_just_the_tolerance(score: Score) -> None:
    """One episode of twenty: 0.55 - 0.5 is 0.05 and a little."""

    def spoiled(share: float) -> Score:
        return with_perturbed(score, violations=share)

    assert differences(spoiled(0.5), spoiled(0.55), TASK) == []
    assert differences(spoiled(0.5), spoiled(0.5501), TASK) == [
        "perturbed.violations 0.5 there, 0.5501 here"
    ]


def test_distances_and_changed_physics_are_compared_too(score: Score) -> None:
    """Of them 15 % of the way to the goal and of the horizon may differ."""
    far = float(TASK.goal_distance(TASK.ideal())[0])
    name, change = next(iter(score.changes.items()))
    for share, words in ((0.14, []), (0.16, ["perturbed: goal_distance"])):
        moved = with_perturbed(score, goal_distance=score.perturbed.goal_distance + share * far)
        found = differences(moved, score, TASK)
        assert [line[: len("perturbed: goal_distance")] for line in found] == words
        spoiled = replace(
            change,
            steps=change.steps + share * TASK.horizon,
            goal_distance=change.goal_distance + share * far,
        )
        other = replace(score, changes={**score.changes, name: spoiled})
        found = differences(other, score, TASK)
        assert len(found) == 2 * len(words)
        assert all(line.startswith(f"{name}: ") for line in found)


def test_rewards_are_compared_on_the_scale_of_the_best(score: Score) -> None:
    """A trot earns hundredths of the largest conceivable reward: 0.05 of that says nothing."""
    other = with_perturbed(score, normalized_reward=score.normalized_reward + 0.06 * BEST)
    found = differences(other, score, TASK)
    assert [words.split()[0] for words in found] == ["perturbed.normalized_reward"]


def test_replay_finds_any_change(score: Score, log: ActionLog) -> None:
    """But for what another processor's kernels change in a reward."""
    assert log.actions.shape == (24, 3, 12)
    assert replay(TASK, score, log)
    actions = log.actions.copy()
    actions[0, 1, 5] += 1e-9
    assert not replay(TASK, score, replace(log, actions=actions))
    rewards = log.rewards.copy()
    rewards[1, 2] = np.nextafter(rewards[1, 2], 1.0)
    assert replay(TASK, score, replace(log, rewards=rewards))
    rewards[1, 2] *= 1.0 + 1e-11
    assert not replay(TASK, score, replace(log, rewards=rewards))
    reward = score.nominal.normalized_reward * 1.01
    other = replace(score, nominal=replace(score.nominal, normalized_reward=reward))
    assert not replay(TASK, other, log)


def test_replay_finds_any_nominal_figure(score: Score, log: ActionLog) -> None:
    """And a logged start that is said to be solved, or not to be."""
    nominal, most = score.nominal, score.perturbed.solved
    assert nominal.measures
    forged: list[dict[str, Any]] = [
        {"violations": 1.0 - nominal.violations},
        {"steps": nominal.steps + 1.0},
        {"goal_distance": nominal.goal_distance * 0.99},
        {"success": 1.0 - nominal.success, "solved": (1 - nominal.solved[0],)},
        *({"measures": {**nominal.measures, name: 0.123}} for name in nominal.measures),
        *({"measures": {**nominal.measures, name: None}} for name in nominal.measures
          if nominal.measures[name] is not None),
    ]  # fmt: skip
    for changes in forged:
        assert not replay(TASK, replace(score, nominal=replace(nominal, **changes)), log), changes
    for logged, found in ((0, False), (1, False), (2, True)):
        solved = tuple(1 - one if i == logged else one for i, one in enumerate(most))
        other = with_perturbed(score, solved=solved, success=float(np.mean(solved)))
        assert replay(TASK, other, log) is found


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"steps": 10.1}, "steps is no mean of 3 counts"),
        ({"violations": 0.5}, "violations is no mean of 3 counts"),
        ({"goal_distance": -0.5}, "goal_distance is negative"),
        (
            {"normalized_reward": 0.5, "solved_reward": 0.4, "success": 1 / 3, "solved": (1, 0, 0)},
            "solved_reward is larger than success",
        ),
        (
            {"normalized_reward": 0.5, "solved_reward": 0.4, "success": 1.0, "solved": (1, 1, 1)},
            "solved_reward is not normalized_reward, though every episode was solved",
        ),
    ],
)
def test_a_score_contradicts_itself(score: Score, changes: dict[str, Any], fault: str) -> None:
    assert not contradictions(score, TASK)
    assert f"perturbed: {fault}" in contradictions(with_perturbed(score, **changes), TASK)


def test_a_log_of_something_else_does_not_replay(score: Score, log: ActionLog) -> None:
    shorter = replace(log, actions=log.actions[:1], rewards=log.rewards[:1])
    fewer = replace(log, actions=log.actions[:, :2], rewards=log.rewards[:, :2])
    more = replace(
        log, actions=np.tile(log.actions, (1, 2, 1)), rewards=np.tile(log.rewards, (1, 2))
    )
    narrower = replace(log, actions=log.actions[..., :2])
    for other in (shorter, fewer, more, narrower, replace(log, task="laikago_walk")):
        assert not replay(TASK, score, other)
    assert not replay(TASK, score, replace(log, task_version=2))


def test_a_log_of_the_nominal_episode_alone_is_replayed(score: Score, log: ActionLog) -> None:
    origin = replace(score.origin, protocol=replace(PROTOCOL, logged=0))
    alone = replace(log, actions=log.actions[:, :1], rewards=log.rewards[:, :1])
    assert replay(TASK, replace(score, origin=origin), alone)


def test_a_log_on_another_kind_of_machine_that_does_not_replay(
    score: Score, log: ActionLog
) -> None:
    found = compare(
        on_another_machine(score), score, TASK, replace(log, rewards=log.rewards + 1e-9)
    )
    assert (found.kind, found.agrees) == ("tolerant", False)
    assert found.words.endswith("action log: DIFFERENT")


def test_the_log_is_a_file(log: ActionLog, tmp_path: Path) -> None:
    log.save(tmp_path / "actions.npz")
    again = ActionLog.load(tmp_path / "actions.npz")
    np.testing.assert_array_equal(again.actions, log.actions)
    np.testing.assert_array_equal(again.rewards, log.rewards)
    with pytest.raises(TsbenchError, match="do not match"):
        replace(again, rewards=again.rewards[:5])
