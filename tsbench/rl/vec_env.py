"""A batched environment with the interface of rsl-rl."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from tsbench.core.policy import ENCODINGS
from tsbench.sim.batched import BatchedEnvironment


class TorchEnvironment(VecEnv):
    """A batched environment with float32 tensors, encoded observations, and actions that are held
    for some steps.

    Attributes:
        device: torch's name of the device of the tensors.
        cfg: empty; rsl-rl requires the attribute.
    """

    def __init__(
        self,
        environment: BatchedEnvironment[Any],
        encoding: str = "plain",
        repeat: int = 1,
        device: str = "cpu",
    ) -> None:
        """`encoding` is a name in `policy.ENCODINGS`; an action is held for `repeat` steps."""
        mdp = environment.mdp
        self.environment = environment
        self.repeat = repeat
        self._encode = ENCODINGS[encoding]
        self.num_envs = environment.count
        self.num_actions = mdp.action_size
        self.max_episode_length = mdp.horizon
        self.device = device
        self.cfg: dict[str, Any] = {}
        self._observation = self._tensors(environment.reset())

    @property
    def episode_length_buf(self) -> torch.Tensor:
        return torch.from_numpy(self.environment.steps)

    def get_observations(self) -> TensorDict:
        return self._observation

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """`repeat` steps. The reward is the mean of their rewards, not the sum, which keeps values
        small. If an episode ends on the way, the missing steps count as zero, and the next episode
        gets actions of zeros until its first own action. Extras, each of shape (num_envs,):
        `time_outs`, whether an episode ended with its last step; `spared`, how many steps one that
        ended at its goal did not need, and `quality`, what each of them is worth."""
        held = actions.numpy(force=True).astype("float64")
        transition = self.environment.step(held)
        reward = transition.reward
        terminal, time_outs = transition.terminal, transition.truncated
        spared, quality = transition.spared, transition.quality
        for _ in range(self.repeat - 1):
            over = terminal | time_outs
            held[over] = 0.0
            transition = self.environment.step(held)
            reward = reward + np.where(over, 0.0, transition.reward)
            spared = spared + np.where(over, 0, transition.spared)
            quality = quality + np.where(over, 0.0, transition.quality)
            terminal = terminal | (transition.terminal & ~over)
            time_outs = time_outs | (transition.truncated & ~over)
        self._observation = self._tensors(transition.observation)
        rewards = self._floats(reward / self.repeat)
        dones = torch.from_numpy(terminal | time_outs).to(self.device, torch.long)
        extras = {"time_outs": time_outs, "spared": spared, "quality": quality}
        return (
            self._observation,
            rewards,
            dones,
            {name: self._floats(values) for name, values in extras.items()},
        )

    def snapshot(self) -> dict[str, Any]:
        """The snapshot of the environment, and the observation for the next action."""
        observation = {name: tensor.numpy(force=True) for name, tensor in self._observation.items()}
        return {"observation": observation, "environment": self.environment.snapshot()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot."""
        self.environment.restore(snapshot["environment"])
        for name, value in snapshot["observation"].items():
            self._observation[name].copy_(torch.from_numpy(value))

    def _tensors(self, observation: np.ndarray) -> TensorDict:
        value = self.environment.value_observation()
        encoded = {"policy": self._encode(observation), "value": self._encode(value)}
        tensors = {name: self._floats(group) for name, group in encoded.items()}
        return TensorDict(tensors, batch_size=[self.num_envs])

    def _floats(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(self.device, torch.float32)
