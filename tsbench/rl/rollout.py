"""Collection of the steps that an update learns from."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict


class Rollout:
    """Collects steps in rsl-rl's storage and computes their returns and advantages.

    The results equal those of rsl-rl's `PPO` to the last bit (tests/rl/test_update.py). `PPO`
    itself always builds an optimiser, which the update in numpy does not need. As in rsl-rl, all
    methods must be called under `torch.inference_mode`.

    Attributes:
        storage: storage of the steps since the last update.
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
            actor: network that chooses the actions.
            critic: network that estimates the value of an observation.
            storage: an empty storage.
            discount: discount per action, not per time step.
            gae_lambda: lambda of generalised advantage estimation (Schulman et al. 2016).
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
        """Stores the results of the actions; all tensors have shape (environments,). Where
        `time_outs` in `extras` is one, the episode ended by its last step, and the discounted value
        of the observation that its last action was chosen on is added to the reward, as rsl-rl
        does."""
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
