"""Stored reference scores against the code that makes them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tsbench import tasks
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.protocol import V1
from tsbench.evaluation.references import POLICIES, random, stored

KEPT = {name: rows for name in tasks.names() if (rows := stored(name)) is not None}


def test_there_are_some() -> None:
    assert KEPT


@pytest.mark.parametrize("name", KEPT)
def test_the_oracle_is_remade(name: str) -> None:
    task, content = tasks.make(name), KEPT[name]
    assert content["task_version"] == task.version
    assert content["protocol"] == V1.name
    assert content["best_return"] == pytest.approx(best_return(task), rel=1e-12)
    oracle = content["rows"]["oracle"]
    assert oracle["normalized_reward"] * task.max_reward * task.horizon == pytest.approx(
        content["best_return"]
    )
    assert oracle["optimality"] == 1.0


@pytest.mark.parametrize("policy", sorted(POLICIES))
@pytest.mark.parametrize("name", KEPT)
def test_the_reference_policies_are_remade(name: str, policy: str) -> None:
    """With those pushes alone between which half of them are survived."""
    task, row = tasks.make(name), KEPT[name]["rows"][policy]
    few = replace(V1, conditions=(), phases=8, forces=(100.0, 150.0))
    score = evaluate(POLICIES[policy](task), task, protocol=few, threads=1)
    assert score.normalized_reward == pytest.approx(row["normalized_reward"], rel=1e-9)
    assert score.optimality == pytest.approx(row["optimality"], rel=1e-9)
    assert score.success == row["success"]
    assert score.perturbed.success == row["perturbed_success"]
    assert score.robustness.survival_100N == row["survival_100N"]
    assert score.robustness.impulse_50 == pytest.approx(row["impulse_50"], rel=1e-9)


def test_the_random_policy_is_a_function() -> None:
    policy = random(tasks.make("laikago_walk"))
    observations = np.random.default_rng(0).normal(size=(2000, 43))
    actions = policy(observations)
    np.testing.assert_array_equal(policy(observations[5:6])[0], actions[5])
    assert abs(actions.mean()) < 0.02
    assert actions.std() == pytest.approx(1.0 / np.sqrt(3.0), rel=0.02)
    assert np.abs(actions).max() <= 1.0
