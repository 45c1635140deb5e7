"""PPO's update, against rsl-rl's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from tsbench.policy import ACTIVATIONS
from tsbench.rl.update import LeanPPO

ENVIRONMENTS, STEPS, OBSERVATIONS, ACTIONS = 32, 8, 5, 3


def filled(kind: type[PPO], seed: int = 0, **settings: Any) -> PPO:
    """A learner that has collected steps enough for one update; of one seed, always the same."""
    torch.manual_seed(seed)
    activation = settings.pop("activation", "elu")
    observation = TensorDict(
        {"policy": torch.zeros(ENVIRONMENTS, OBSERVATIONS)}, batch_size=[ENVIRONMENTS]
    )
    groups = {"actor": ["policy"], "critic": ["policy"]}
    shared: dict[str, Any] = {
        "hidden_dims": [16, 8], "activation": activation, "obs_normalization": True,
    }  # fmt: skip
    actor = MLPModel(
        observation, groups, "actor", ACTIONS, **shared,
        distribution_cfg={"class_name": "GaussianDistribution", "init_std": 0.7, "std_type": "log"},
    )  # fmt: skip
    critic = MLPModel(observation, groups, "critic", 1, **shared)
    storage = RolloutStorage("rl", ENVIRONMENTS, STEPS, observation, [ACTIONS])
    settings = {"num_learning_epochs": 3, "num_mini_batches": 4, "desired_kl": None,
                "schedule": "fixed", "use_clipped_value_loss": False} | settings  # fmt: skip
    own = {"activation": activation} if kind is LeanPPO else {}
    ppo = kind(actor, critic, storage, **settings, **own)
    collect(ppo)
    return ppo


def collect(ppo: PPO) -> None:
    with torch.inference_mode():
        for _ in range(STEPS):
            steps = torch.randn(ENVIRONMENTS, OBSERVATIONS)
            observation = TensorDict({"policy": steps}, batch_size=[ENVIRONMENTS])
            actions = ppo.act(observation)
            rewards = torch.randn(ENVIRONMENTS) + actions.sum(dim=-1) * observation["policy"][:, 0]
            dones = torch.rand(ENVIRONMENTS) < 0.1
            ppo.process_env_step(observation, rewards, dones, {})
        ppo.compute_returns(observation)


def weights(ppo: PPO) -> dict[str, np.ndarray]:
    return {
        f"{name}.{key}": value.detach().numpy().astype(float).copy()
        for name, model in (("actor", ppo.actor), ("critic", ppo.critic))
        for key, value in model.state_dict().items()
    }


@pytest.mark.parametrize(
    "settings",
    [
        {},
        *({"activation": name} for name in ACTIVATIONS),
        {"entropy_coef": 0.3},
        {"value_loss_coef": 0.2, "max_grad_norm": 0.05},
        {"max_grad_norm": 100.0},
        {"use_clipped_value_loss": True, "clip_param": 0.05, "learning_rate": 1e-2},
        {"clip_param": 0.02, "learning_rate": 1e-2},
        {"schedule": "adaptive", "desired_kl": 0.01},
        {"schedule": "adaptive", "desired_kl": 1e-3},
        {"schedule": "adaptive", "desired_kl": 10.0},
        {"num_mini_batches": 7},  # which leaves steps over
    ],
    ids=str,
)
def test_it_is_that_of_rsl_rl(settings: dict[str, Any]) -> None:
    """Two updates of twelve steps: the same weights, losses, rate and normalisers but for rounding,
    which is a thousandth of how far the weights come."""
    ours, theirs = filled(LeanPPO, **settings), filled(PPO, **settings)
    for seed in (1, 2):
        before = weights(theirs)
        losses = []
        for ppo in (ours, theirs):
            torch.manual_seed(seed)
            losses.append(ppo.update())
            torch.manual_seed(seed + 10)
            collect(ppo)
        assert losses[0]["value"] == pytest.approx(losses[1]["value"], rel=1e-4)
        assert losses[0]["surrogate"] == pytest.approx(losses[1]["surrogate"], rel=1e-3, abs=1e-5)
        assert ours.learning_rate == pytest.approx(theirs.learning_rate)
        after, wanted = weights(ours), weights(theirs)
        assert after.keys() == wanted.keys()
        for name, value in wanted.items():
            moved = np.abs(value - before[name]).max()
            assert moved > 0.0
            np.testing.assert_allclose(after[name], value, atol=1e-3 * moved, err_msg=name)


def test_it_goes_on_from_a_snapshot() -> None:
    """Adam's moments and count, put into a learner that has its own."""
    first, second = filled(LeanPPO), filled(LeanPPO, seed=5)
    torch.manual_seed(1)
    first.update()
    for mine, saved in ((second.policy, first.policy), (second.value, first.value)):
        mine.restore(saved.snapshot())
    second.actor.load_state_dict(first.actor.state_dict())
    second.critic.load_state_dict(first.critic.state_dict())
    second.storage.clear()
    for ppo in (first, second):
        torch.manual_seed(2)
        collect(ppo)
        ppo.update()
    np.testing.assert_equal(weights(first), weights(second))
