"""The steps that an update learns from."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict


class Rollout:
    """Collects steps in rsl-rl's storage and computes their returns and advantages.

    This is the first half of rsl-rl's `PPO`, to the last bit (tests/rl/test_update.py). `PPO` does
    not collect without building an optimiser, for which the update in numpy has no use. As there,
    all methods are called under `torch.inference_mode`.

    Attributes:
        storage: of the steps since the last update.
    """

    def __init__(
        self,
        actor: MLPModel,
        critic: MLPModel,
        storage: RolloutStorage,
        *,
        discount: float,
        gae_lambda: float,
        normalise: bool,
    ) -> None:
        """
        Args:
            actor: chooses the actions.
            critic: estimates what an observation is worth.
            storage: empty.
            discount: per action.
            gae_lambda: of generalised advantage estimation (Schulman et al. 2016), per action.
            normalise: whether advantages are normalised over all steps.
        """
        self.storage = storage
        self._actor = actor
        self._critic = critic
        self._discount = discount
        self._lambda = gae_lambda
        self._normalise = normalise
        self._step = RolloutStorage.Transition()

    def act(self, observation: TensorDict) -> torch.Tensor:
        """Actions drawn from the policy, shape (environments, action_size)."""
        step = self._step
        step.observations = observation
        step.actions = self._actor(observation, stochastic_output=True)
        step.values = self._critic(observation)
        step.actions_log_prob = self._actor.get_output_log_prob(step.actions)
        step.distribution_params = self._actor.output_distribution_params
        return step.actions

    def add(
        self, rewards: torch.Tensor, dones: torch.Tensor, extras: Mapping[str, torch.Tensor]
    ) -> None:
        """Stores what the actions led to; all of shape (environments,). An episode that ended by
        its last step, which `time_outs` in `extras` says, earns its last observation's value."""
        step = self._step
        step.rewards = rewards.clone()
        step.dones = dones
        if "time_outs" in extras:
            assert step.values is not None
            lasting = step.values * extras["time_outs"].unsqueeze(1)
            step.rewards += self._discount * lasting.squeeze(1)
        self.storage.add_transition(step)
        step.clear()

    def finish(self, observation: TensorDict) -> None:
        """Computes returns and advantages; `observation` is the one after the last step."""
        storage = self.storage
        following = self._critic(observation)
        advantage = torch.zeros_like(following)
        for step in reversed(range(storage.num_transitions_per_env)):
            value, lasts = storage.values[step], 1.0 - storage.dones[step].float()
            error = storage.rewards[step] + lasts * self._discount * following - value
            advantage = error + lasts * self._discount * self._lambda * advantage
            storage.returns[step] = advantage + value
            following = value
        storage.advantages = storage.returns - storage.values
        if self._normalise:
            mean, spread = storage.advantages.mean(), storage.advantages.std()
            storage.advantages = (storage.advantages - mean) / (spread + 1e-8)
