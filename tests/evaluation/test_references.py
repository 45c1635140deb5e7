"""Stored reference scores against the code that makes them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tsbench import tasks
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.origin import constants_hash
from tsbench.evaluation.protocol import V1
from tsbench.evaluation.references import POLICIES, beside, random, stored

KEPT = {name: rows for name in tasks.names() if (rows := stored(name)) is not None}


def test_a_wrong_name_gets_one_line() -> None:
    line = [sys.executable, "-m", "tsbench.evaluation.references", "rocket_navigatoin"]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("tsbench: unknown task 'rocket_navigatoin'; allowed: ")
    assert done.stderr.count("\n") == 1


def test_there_are_some() -> None:
    assert KEPT


@pytest.mark.parametrize("name", KEPT)
def test_the_oracle_is_remade(name: str) -> None:
    task, content = tasks.make(name), KEPT[name]
    assert content["task_version"] == task.version
    assert content["protocol"] == V1.name
    assert content["best_return"] == pytest.approx(best_return(task), rel=1e-12)
    oracle = content["rows"]["oracle"]
    assert content["constants"] == constants_hash(task)
    assert oracle["solved_reward"] == oracle["normalized_reward"]
    assert oracle["normalized_reward"] * task.max_reward * task.horizon == pytest.approx(
        content["best_return"]
    )
    assert oracle["against_plan"] == 1.0


@pytest.mark.parametrize("policy", sorted(POLICIES))
@pytest.mark.parametrize("name", KEPT)
def test_the_reference_policies_are_remade(name: str, policy: str) -> None:
    """With those pushes alone between which half of them are survived."""
    task, row = tasks.make(name), KEPT[name]["rows"][policy]
    few = replace(V1, conditions=(), phases=8, forces=(100.0, 150.0, 200.0))
    score = evaluate(POLICIES[policy](task), task, protocol=few, threads=1)
    assert score.solved_reward == row["solved_reward"] == 0.0
    assert score.normalized_reward == pytest.approx(row["normalized_reward"], rel=1e-9)
    assert score.against_plan == pytest.approx(row["against_plan"], rel=1e-9)
    assert score.success == row["success"] == 0.0
    robustness = score.robustness
    assert robustness.survival_100N == row["survival_100N"]
    assert robustness.recovery_100N == row["recovery_100N"] == 0.0
    assert robustness.survival_impulse_50 == pytest.approx(row["survival_impulse_50"], rel=1e-9)
    assert robustness.recovery_impulse_50 == row["recovery_impulse_50"] == 0.0


def test_rows_stand_beside_scores_of_the_same_thing_only() -> None:
    task = tasks.make("laikago_walk")
    few = replace(V1, perturbed=1, conditions=(), phases=24, forces=(100.0,), headings=1)
    score = evaluate(POLICIES["zero"](task), task, protocol=few, threads=1)
    assert set(beside(score)) == {"zero", "random"}
    assert (
        beside(score)["zero"]["survival_100N"] == KEPT[task.name]["rows"]["zero"]["survival_100N"]
    )
    assert beside(replace(score, protocol="smoke")) == {}
    origin = score.origin
    for other in (replace(origin, constants="0"), replace(origin, task="another")):
        assert beside(replace(score, origin=other)) == {}


def test_the_random_policy_is_a_function() -> None:
    policy = random(tasks.make("laikago_walk"))
    observations = np.random.default_rng(0).normal(size=(2000, 43))
    actions = policy(observations)
    np.testing.assert_array_equal(policy(observations[5:6])[0], actions[5])
    assert abs(actions.mean()) < 0.02
    assert actions.std() == pytest.approx(1.0 / np.sqrt(3.0), rel=0.02)
    assert np.abs(actions).max() <= 1.0
