"""Whether a score repeats, and which comparison that was."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsbench import TsbenchError, tasks
from tsbench.evaluation.evaluate import Score, evaluate, perturbed_starts
from tsbench.evaluation.protocol import SMOKE
from tsbench.evaluation.replay import (
    Comparison,
    compare,
    constants_hash,
    differences,
    episode_starts,
    machine,
    replay,
)
from tsbench.mdp import Start
from tsbench.motion import ActionLog

PROTOCOL = replace(SMOKE, perturbed=3, logged=2, conditions=SMOKE.conditions[:1], forces=(100.0,))
TASK = tasks.make("laikago_trot", distance=0.4)  # 19 steps


def shuffle(observation: np.ndarray) -> np.ndarray:
    action: np.ndarray = 0.1 * np.sin(20.0 * observation[:, :12])
    return action


@pytest.fixture(scope="module")
def score() -> Score:
    return evaluate(shuffle, TASK, protocol=PROTOCOL, threads=1)


@pytest.fixture(scope="module")
def starts() -> Start:
    return episode_starts(TASK, perturbed_starts(TASK, PROTOCOL))


@pytest.fixture
def kept(score: Score) -> Any:
    """As it is read back from a file."""
    return json.loads(json.dumps(score.as_dict()))


def compared(kept: Any, score: Score, starts: Start, log: ActionLog | None) -> Comparison:
    return compare(kept, score.as_dict(), PROTOCOL, TASK, starts, log)


def test_what_a_score_says_of_its_origin(kept: Any) -> None:
    origin = kept["origin"]
    assert (origin["protocol"], origin["task"], origin["task_version"]) == (
        "smoke", "laikago_trot", TASK.version,
    )  # fmt: skip
    assert set(origin["packages"]) == {"python", "mujoco", "numpy", "scipy", "tsbench"}
    assert origin["machine"] == machine()
    assert origin["machine"]["architecture"]
    assert len({origin["mjcf"], origin["model"], origin["constants"]}) == 3
    assert origin["policy"] is None  # a function has no file


def test_the_constants_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    """It changes with the task's own constants and with the numbers in its file that a score
    depends on."""
    before = constants_hash(TASK)
    assert before == constants_hash(tasks.make("laikago_trot", distance=0.4))
    assert before != constants_hash(tasks.make("laikago_trot"))
    assert before != constants_hash(tasks.make("laikago_walk", distance=0.4))
    for name, value in (("SLIP_DECAY", -11.0), ("FILTER_B", (0.1, 0.2, 0.1))):
        with monkeypatch.context() as changed:
            changed.setattr(f"tsbench.tasks.laikago.{name}", value)
            assert before != constants_hash(TASK)
    rocket = tasks.make("rocket_navigation")
    before = constants_hash(rocket)
    monkeypatch.setattr("tsbench.tasks.rocket.TRACKING_DECAY", -1.0)
    assert before == constants_hash(rocket)
    monkeypatch.setattr("tsbench.tasks.rocket.DEAD_ZONE", 0.4)
    assert before != constants_hash(rocket)


def test_bit_for_bit(kept: Any, score: Score, starts: Start) -> None:
    found = compared(kept, score, starts, score.log)
    assert (found.kind, found.agrees) == ("exact", True)
    assert found.words == "compared bit for bit: equal"
    kept["perturbed"]["normalized_reward"] = np.nextafter(
        kept["perturbed"]["normalized_reward"], 1.0
    )
    found = compared(kept, score, starts, score.log)
    assert (found.kind, found.agrees) == ("exact", False)
    assert found.words == "compared bit for bit: DIFFERENT"


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("protocol", "v1", "another protocol (v1, not smoke)"),
        ("task_version", 0, "another version of the task (0, not 1)"),
        ("mjcf", "0", "another MJCF"),
        ("model", "0", "another model"),
        ("constants", "0", "another set of constants of the task"),
        ("policy", "0", "another policy"),
    ],
)
def test_nothing_to_compare(
    kept: Any, score: Score, starts: Start, key: str, value: Any, words: str
) -> None:
    kept["origin"][key] = value
    found = compared(kept, score, starts, score.log)
    assert (found.kind, found.agrees) == ("none", None)
    assert found.words == f"not compared: made with {words}"


def test_another_mujoco(kept: Any, score: Score, starts: Start) -> None:
    here = kept["origin"]["packages"]["mujoco"]
    kept["origin"]["packages"]["mujoco"] = "3.16.0"
    found = compared(kept, score, starts, score.log)
    assert (found.kind, found.agrees) == ("none", None)
    assert found.words == f"not compared: made with mujoco 3.16.0, and this is mujoco {here}"


def test_a_score_from_before_there_were_protocols(score: Score, starts: Start) -> None:
    found = compared({"normalized_reward": 0.5}, score, starts, None)
    assert (found.kind, found.agrees) == ("none", None)


@pytest.mark.parametrize(("group", "name"), [("packages", "numpy"), ("machine", "extensions")])
def test_another_kind_of_machine(
    kept: Any, score: Score, starts: Start, group: str, name: str
) -> None:
    """The physics is replayed from the actions, the rest may differ a little."""
    kept["origin"][group][name] = "other"
    kept["perturbed"]["normalized_reward"] += 0.9 * PROTOCOL.tolerance
    kept["robustness"]["impulse_50"] *= 1.05
    found = compared(kept, score, starts, score.log)
    assert (found.kind, found.agrees) == ("tolerant", True)
    assert f"({name} other there, {score.as_dict()['origin'][group][name]} here)" in found.words
    assert "within 0.05" in found.words
    assert "in agreement" in found.words
    assert found.words.endswith("replayed from the action log: equal")

    kept["perturbed"]["normalized_reward"] += 0.2 * PROTOCOL.tolerance
    kept["robustness"]["impulse_50"] = 3.0 + 2.0 * score.robustness.impulse_50
    found = compared(kept, score, starts, score.log)
    assert (found.kind, found.agrees) == ("tolerant", False)
    assert "DIFFERENT: perturbed.normalized_reward" in found.words
    assert "robustness.impulse_50" in found.words

    found = compared(kept, score, starts, None)
    assert "no action log" in found.words


def test_a_difference_of_just_the_tolerance(score: Score) -> None:
    """One episode of twenty: 0.55 - 0.5 is 0.05 and a little."""
    there, here = (json.loads(json.dumps(score.as_dict())) for _ in range(2))
    there["perturbed"]["violations"], here["perturbed"]["violations"] = 0.5, 0.55
    assert differences(there, here, PROTOCOL) == []
    here["perturbed"]["violations"] = 0.5501
    assert differences(there, here, PROTOCOL) == ["perturbed.violations 0.5 there, 0.5501 here"]


def test_replay_finds_any_change(score: Score, starts: Start) -> None:
    """But for what another processor's kernels change in a reward."""
    assert score.log.actions.shape == (19, 3, 12)
    assert replay(TASK, starts, score.log)
    actions = score.log.actions.copy()
    actions[0, 1, 5] += 1e-9
    assert not replay(TASK, starts, replace(score.log, actions=actions))
    rewards = score.log.rewards.copy()
    rewards[1, 2] = np.nextafter(rewards[1, 2], 1.0)
    assert replay(TASK, starts, replace(score.log, rewards=rewards))
    rewards[1, 2] *= 1.0 + 1e-11
    assert not replay(TASK, starts, replace(score.log, rewards=rewards))


def test_a_log_on_another_kind_of_machine_that_does_not_replay(
    kept: Any, score: Score, starts: Start
) -> None:
    kept["origin"]["machine"]["libc"] = "other"
    log = replace(score.log, rewards=copy.deepcopy(score.log.rewards) + 1e-9)
    found = compared(kept, score, starts, log)
    assert (found.kind, found.agrees) == ("tolerant", False)
    assert found.words.endswith("action log: DIFFERENT")


def test_the_log_is_a_file(score: Score, tmp_path: Path) -> None:
    score.log.save(tmp_path / "actions.npz")
    again = ActionLog.load(tmp_path / "actions.npz")
    np.testing.assert_array_equal(again.actions, score.log.actions)
    np.testing.assert_array_equal(again.rewards, score.log.rewards)
    with pytest.raises(TsbenchError, match="do not match"):
        replace(again, rewards=again.rewards[:5])
