"""The methods learn. Rounding, which differs between processors, decides the outcome of a single
training, so the tests ask for a share of several, far from the share that chance gives."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from tsbench import tasks
from tsbench.rl.ppo import Learner
from tsbench.rl.settings import PPOSettings
from tsbench.runs import config, execute
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.kinematic import Planning

DISTANCE = 30.0  # metres to the goal: half of the task's
WORDS = [
    "task=rocket_navigation",
    "method=twostage",
    "budget=smoke",
    "threads=1",
    f"task.constants.distance={DISTANCE}",
    "task.budgets.smoke.plan=150_000",
    "task.budgets.smoke.act=300_000",
    "task.budgets.smoke.environments=null",
]


def test_most_trainings_fly_the_rocket_to_its_goal(tmp_path: Path) -> None:
    """At the end of an episode at most 30 % of the way is left, from perturbed starts too.

    Of 24 trainings, seeds 0 to 7 each with weights perturbed by 0, 1e-6 and 2e-6, the worst left
    14 %. A rocket without thrust ends further off than it began.
    """
    near = []
    for seed in range(3):
        words = [*WORDS, f"seed={seed}"]
        chosen = replace(config.compose(words), directory=str(tmp_path / str(seed)))
        score = execute.execute(chosen, words, Console(quiet=True))
        near.append(score.perturbed.goal_distance <= 0.3 * DISTANCE)
        if sum(near) == 2:
            return  # the third one decides nothing
    assert sum(near) >= 2, near


def test_the_switch_perturbs_every_network(
    perturbed: Callable[[float], AbstractContextManager[None]],
) -> None:
    """The perturbation has the given size and is always the same; see TSBENCH_TEST_PERTURB in
    conftest.py."""
    planning = Planning(tasks.make("rocket_navigation", distance=3.0))

    def weights(around: AbstractContextManager[None]) -> dict[str, np.ndarray]:
        settings = PPOSettings(environments=4, rollout=4, hidden=(16,))
        with around:
            snapshot = Learner(BatchedEnvironment(planning, planning, 4, 0), settings, 0).snapshot()
        return {
            f"{network}.{name}": array
            for network in ("actor", "critic")
            for name, array in snapshot[network].items()
            if name.startswith("mlp.") and array.any()
        }

    plain, first, again = (
        weights(around) for around in (nullcontext(), perturbed(1e-3), perturbed(1e-3))
    )
    assert len(plain) == 7  # of two networks with two layers each, but for the bias of the actions
    for name, array in plain.items():
        np.testing.assert_array_equal(first[name], again[name])
        moved = np.abs(first[name] / array - 1.0)
        assert 0.0 < moved.max() < 6e-3, name
