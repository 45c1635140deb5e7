"""Environments with the interface of rsl-rl: one stepped in numpy, one on a torch device.

Both hold an action for some steps, encode observations, and keep figures of finished episodes.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from tsbench.core.policy import ENCODINGS
from tsbench.core.task import MDP
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.device import DeviceEnvironment

RECENT = 100  # finished episodes whose mean return and length are reported

Extras = dict[str, torch.Tensor]


class LearnerEnvironment(VecEnv):
    """Episodes with float32 tensors, encoded observations, and actions held for some steps.

    Attributes:
        mdp: what is played.
        repeat: steps for which an action is held.
        device: torch's name of the device of the tensors.
        cfg: empty; rsl-rl requires the attribute.
    """

    def __init__(self, mdp: MDP[Any], count: int, encoding: str, repeat: int, device: str) -> None:
        self.mdp = mdp
        self.repeat = repeat
        self._encode = ENCODINGS[encoding]
        self.num_envs = count
        self.num_actions = mdp.action_size
        self.max_episode_length = mdp.horizon
        self.device = device
        self.cfg: dict[str, Any] = {}
        self._observation: TensorDict

    def get_observations(self) -> TensorDict:
        return self._observation

    @abstractmethod
    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """`repeat` steps. The reward is the mean of their rewards, not the sum, which keeps values
        small. If an episode ends on the way, the missing steps count as zero, and the next episode
        gets actions of zeros until its first own action. Extras, each of shape (num_envs,):
        `time_outs`, whether an episode ended with its last step; `spared`, how many steps one that
        ended at its goal did not need, and `quality`, what each of them is worth."""

    @abstractmethod
    def count(self, rewards: torch.Tensor, dones: torch.Tensor, extras: Extras) -> None:
        """Adds the results of `step` to the figures of the episodes."""

    @abstractmethod
    def finished(self) -> dict[str, float]:
        """Mean return and length of the episodes finished last, as metrics; empty if none was."""

    @property
    @abstractmethod
    def seconds(self) -> tuple[float, float]:
        """Wall-clock seconds so far of all steps, and of those in the physics."""

    @abstractmethod
    def check(self) -> None:
        """Called after each rollout.

        Raises:
            TsbenchError: a number was not finite in it, or its physics cannot be relied on.
        """

    @abstractmethod
    def snapshot(self) -> dict[str, Any]:
        """The snapshot of the environment, and the observation for the next action."""

    @abstractmethod
    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot."""


def learner_environment(
    environment: BatchedEnvironment[Any] | DeviceEnvironment[Any], encoding: str, repeat: int
) -> LearnerEnvironment:
    """The environment as a learner needs it. `encoding` is a name in `policy.ENCODINGS`; an action
    is held for `repeat` steps."""
    if isinstance(environment, DeviceEnvironment):
        return TensorEnvironment(environment, encoding, repeat)
    return TorchEnvironment(environment, encoding, repeat)


class TorchEnvironment(LearnerEnvironment):
    """An environment in numpy, for a learner on the CPU."""

    def __init__(
        self, environment: BatchedEnvironment[Any], encoding: str = "plain", repeat: int = 1
    ) -> None:
        super().__init__(environment.mdp, environment.count, encoding, repeat, "cpu")
        self.environment = environment
        self._returns: deque[float] = deque(maxlen=RECENT)
        self._lengths: deque[int] = deque(maxlen=RECENT)
        self._return = np.zeros(environment.count)
        self._length = np.zeros(environment.count, int)
        self._observation = self._tensors(environment.reset())

    @property
    def episode_length_buf(self) -> torch.Tensor:
        return torch.from_numpy(self.environment.steps)

    @property
    def seconds(self) -> tuple[float, float]:
        return self.environment.seconds, self.environment.dynamics.seconds

    def check(self) -> None:
        """Each step has checked its numbers."""

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
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
        rewards = _floats(reward / self.repeat)
        dones = torch.from_numpy(terminal | time_outs).to(torch.long)
        extras = {"time_outs": time_outs, "spared": spared, "quality": quality}
        return (
            self._observation,
            rewards,
            dones,
            {name: _floats(values) for name, values in extras.items()},
        )

    def count(self, rewards: torch.Tensor, dones: torch.Tensor, extras: Extras) -> None:
        self._return += rewards.numpy() * self.repeat  # an episode's last hold counts in full
        self._return += self.mdp.credit(extras["spared"], extras["quality"]).numpy()
        self._length += self.repeat
        ended = np.flatnonzero(dones.numpy())
        self._returns.extend(self._return[ended].tolist())
        self._lengths.extend(self._length[ended].tolist())
        self._return[ended] = 0.0
        self._length[ended] = 0

    def finished(self) -> dict[str, float]:
        if not self._returns:
            return {}
        return {
            "episode_return": float(np.mean(self._returns)),
            "episode_length": float(np.mean(self._lengths)),
        }

    def snapshot(self) -> dict[str, Any]:
        return {
            "observation": _arrays(self._observation),
            "environment": self.environment.snapshot(),
            "episodes": {
                "returns": list(self._returns),
                "lengths": list(self._lengths),
                "return": self._return,
                "length": self._length,
            },
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.environment.restore(snapshot["environment"])
        for name, value in snapshot["observation"].items():
            self._observation[name].copy_(torch.from_numpy(value))
        episodes = snapshot["episodes"]
        self._returns.extend(episodes["returns"])
        self._lengths.extend(episodes["lengths"])
        self._return[:] = episodes["return"]
        self._length[:] = episodes["length"]

    def _tensors(self, observation: np.ndarray) -> TensorDict:
        value = self.environment.value_observation()
        encoded = {"policy": self._encode(observation), "value": self._encode(value)}
        tensors = {name: _floats(group) for name, group in encoded.items()}
        return TensorDict(tensors, batch_size=[self.num_envs])


class TensorEnvironment(LearnerEnvironment):
    """An environment on a torch device, for a learner there. In `step` and `count` nothing moves to
    the host."""

    def __init__(
        self, environment: DeviceEnvironment[Any], encoding: str = "plain", repeat: int = 1
    ) -> None:
        device = str(environment.device)
        super().__init__(environment.mdp, environment.count, encoding, repeat, device)
        self.environment = environment
        # Return and length of the current episodes; the sums of both and the number of the
        # episodes that have finished since `finished` was asked.
        self._running = torch.zeros(2, environment.count, device=device)
        self._sums = torch.zeros(3, dtype=torch.float64, device=device)
        self._means: dict[str, float] = {}
        self._observation = self._tensors(*environment.reset())

    @property
    def episode_length_buf(self) -> torch.Tensor:
        return self.environment.steps

    @property
    def seconds(self) -> tuple[float, float]:
        return self.environment.seconds, self.environment.physics_seconds

    def check(self) -> None:
        self.environment.check()

    @torch.inference_mode()
    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        transition = self.environment.step(actions)
        # Copies, because the next step overwrites its tensors.
        reward = transition.reward.clone()
        terminal, time_outs = transition.terminal.clone(), transition.truncated.clone()
        spared, quality = transition.spared.to(torch.float32), transition.quality.clone()
        for _ in range(self.repeat - 1):
            over = terminal | time_outs
            actions = actions * ~over[:, None]
            transition = self.environment.step(actions)
            reward += transition.reward * ~over
            spared += transition.spared * ~over
            quality += transition.quality * ~over
            terminal |= transition.terminal & ~over
            time_outs |= transition.truncated & ~over
        self._observation = self._tensors(transition.observation, transition.value_observation)
        extras = {"time_outs": time_outs.to(torch.float32), "spared": spared, "quality": quality}
        return self._observation, reward / self.repeat, (terminal | time_outs).long(), extras

    @torch.inference_mode()
    def count(self, rewards: torch.Tensor, dones: torch.Tensor, extras: Extras) -> None:
        # An episode's last hold counts in full.
        self._running[0] += rewards * self.repeat
        self._running[0] += self.mdp.credit(extras["spared"], extras["quality"])
        self._running[1] += self.repeat
        done = dones.to(torch.float32)
        self._sums[:2] += (self._running * done).sum(dim=1)
        self._sums[2] += done.sum()
        self._running *= 1.0 - done

    @torch.inference_mode()
    def finished(self) -> dict[str, float]:
        """Of the episodes finished since the last call or, if fewer than `RECENT` were, since the
        call before that gave new figures."""
        returns, lengths, number = self._sums.tolist()
        if number >= RECENT or (number and not self._means):
            self._means = {"episode_return": returns / number, "episode_length": lengths / number}
            self._sums.zero_()
        return dict(self._means)

    def snapshot(self) -> dict[str, Any]:
        return {
            "observation": _arrays(self._observation),
            "environment": self.environment.snapshot(),
            "episodes": {
                "running": self._running.numpy(force=True),
                "sums": self._sums.numpy(force=True),
                "means": self._means,
            },
        }

    @torch.inference_mode()
    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.environment.restore(snapshot["environment"])
        for name, value in snapshot["observation"].items():
            self._observation[name] = torch.from_numpy(value.copy()).to(self.device)
        episodes = snapshot["episodes"]
        self._running = torch.from_numpy(episodes["running"].copy()).to(self.device)
        self._sums = torch.from_numpy(episodes["sums"].copy()).to(self.device)
        self._means = dict(episodes["means"])

    def _tensors(self, observation: torch.Tensor, value: torch.Tensor) -> TensorDict:
        # `clone` for the encoding that returns its argument.
        encoded = {"policy": self._encode(observation), "value": self._encode(value)}
        tensors = {name: group.clone() for name, group in encoded.items()}
        return TensorDict(tensors, batch_size=[self.num_envs])


def _floats(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(values).to(torch.float32)


def _arrays(observation: TensorDict) -> dict[str, np.ndarray]:
    return {name: group.numpy(force=True) for name, group in observation.items()}
