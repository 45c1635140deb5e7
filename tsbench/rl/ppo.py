"""Proximal policy optimisation by rsl-rl, and the artefact it leaves behind.

rsl-rl's `PPO`, models and storage do the learning, but for the update (`rl/update.py`). Its runner
is not used: it prints a page per iteration, stores the enclosing repository's diff and changes the
configuration it is given.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage

from tsbench.errors import NotFiniteError, TsbenchError
from tsbench.policy import ACTIVATIONS, ENCODINGS, Policy, PolicyInfo
from tsbench.rl.update import LeanPPO
from tsbench.rl.vec_env import TorchEnvironment
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.model import fingerprint
from tsbench.task import Task

Report = Callable[[int, Mapping[str, float]], None]  # (environment steps so far, metrics)


@dataclass(frozen=True)
class PPOSettings:
    """Attributes:
    environments: episodes stepped together.
    rollout: actions of each between two updates.
    repeat: time steps for which an action is held while learning, so that it does enough to be
        told from noise where a time step is short. The policy itself acts in every time step.
    epochs: passes over the collected steps in an update.
    minibatches: per pass.
    discount: gamma, per time step.
    gae_lambda: of generalised advantage estimation, per action.
    clip: range of the probability ratio.
    clip_value: whether the value loss is clipped too.
    entropy: weight of the entropy bonus.
    learning_rate: at first.
    final_learning_rate: that the learning rate falls to geometrically over a stage, or None; only
        without `desired_kl`. What is judged is the last policy, and a steady rate keeps it moving.
    desired_kl: that the learning rate is adapted to after every minibatch, or None to keep it.
    value_weight: of the value loss.
    gradient_norm: that gradients are clipped to.
    hidden: sizes of the hidden layers of actor and critic.
    activation: between the layers.
    encoding: of observations before they are normalised, a name in `policy.ENCODINGS`.
    initial_std: of the Gaussian policy, per unit of action.
    final_std: what it is held below at the end of a stage, by a bound that falls geometrically
        from `initial_std`; None for no bound. Where actions have dead zones, a policy can live on
        its own noise, and its mean alone then fails.
    bootstrap: whether an episode's last step counts as if it went on.
    """

    environments: int = 512
    rollout: int = 24
    repeat: int = 1
    epochs: int = 5
    minibatches: int = 4
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    clip_value: bool = False
    entropy: float = 0.0
    learning_rate: float = 1e-3
    final_learning_rate: float | None = None
    desired_kl: float | None = 0.01
    value_weight: float = 1.0
    gradient_norm: float = 1.0
    hidden: tuple[int, ...] = (256, 128)
    activation: str = "elu"
    encoding: str = "plain"
    initial_std: float = 1.0
    final_std: float | None = None
    bootstrap: bool = True

    def __post_init__(self) -> None:
        for name in ("environments", "rollout", "repeat", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("learning_rate", "gradient_norm", "initial_std", "clip"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive, not {getattr(self, name)}")
        if self.final_std is not None and not 0.0 < self.final_std <= self.initial_std:
            raise ValueError("final_std must be positive and at most initial_std, or null")
        if self.final_learning_rate is not None:
            if self.desired_kl is not None:
                raise ValueError("final_learning_rate needs desired_kl: null")
            if not 0.0 < self.final_learning_rate <= self.learning_rate:
                raise ValueError(
                    "final_learning_rate must be positive and at most learning_rate, or null"
                )
        for name in ("entropy", "value_weight"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative, not {getattr(self, name)}")
        if self.desired_kl is not None and not 0.0 < self.desired_kl < math.inf:
            raise ValueError(f"desired_kl must be positive or null, not {self.desired_kl}")
        for name in ("discount", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1], not {getattr(self, name)}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden must be sizes of at least 1, not {self.hidden}")
        if self.minibatches > self.environments * self.rollout:
            raise ValueError(f"minibatches are {self.minibatches}, more than the steps collected")
        if self.activation not in ACTIVATIONS:
            raise ValueError(f"activation must be one of {', '.join(ACTIVATIONS)}")
        if self.encoding not in ENCODINGS:
            raise ValueError(f"encoding must be one of {', '.join(ENCODINGS)}")

    @property
    def steps(self) -> int:
        """Environment steps between two updates, all environments together."""
        return self.environments * self.rollout * self.repeat


class Learner:
    """An actor and a critic that learn in one environment.

    Attributes:
        steps: environment steps taken.
    """

    def __init__(
        self,
        environment: BatchedEnvironment[Any],
        settings: PPOSettings,
        seed: int,
        actor_from: Learner | None = None,
    ) -> None:
        """`actor_from` lends its actor, normalisers and all, to go on from; the critic, whose
        values belong to another reward, starts anew but for its normaliser."""
        torch.manual_seed(seed)
        self.settings = settings
        self.environment = environment
        self._env = TorchEnvironment(environment, settings.encoding, settings.repeat)
        self.steps = 0
        self._returns: deque[float] = deque(maxlen=100)
        self._lengths: deque[int] = deque(maxlen=100)
        self._return = np.zeros(environment.count)
        self._length = np.zeros(environment.count, int)
        self._ppo = self._build()
        if actor_from is not None:
            self._ppo.actor.load_state_dict(actor_from._ppo.actor.state_dict())
            self._ppo.critic.obs_normalizer.load_state_dict(
                actor_from._ppo.critic.obs_normalizer.state_dict()
            )
            with torch.no_grad():
                self._ppo.actor.distribution.log_std_param.fill_(math.log(settings.initial_std))

    def _build(self) -> LeanPPO:
        s, env = self.settings, self._env
        observation = env.get_observations()
        groups = {"actor": ["policy"], "critic": ["value"]}
        shared = {
            "hidden_dims": list(s.hidden), "activation": s.activation, "obs_normalization": True,
        }  # fmt: skip
        actor = MLPModel(
            observation, groups, "actor", env.num_actions, **shared,
            # Of its logarithm's steps none is large when the spread is small: learned as it is, it
            # collapses within some updates of a seed that has not found out yet what pays.
            distribution_cfg={
                "class_name": "GaussianDistribution", "init_std": s.initial_std, "std_type": "log",
            },
        )  # fmt: skip
        with torch.no_grad():  # at first every mean action is nearly zero: the nominal pose
            actor.mlp[-1].weight.mul_(0.01)
            actor.mlp[-1].bias.zero_()
        critic = MLPModel(observation, groups, "critic", 1, **shared)
        storage = RolloutStorage("rl", env.num_envs, s.rollout, observation, [env.num_actions])
        return LeanPPO(
            actor,
            critic,
            storage,
            activation=s.activation,
            num_learning_epochs=s.epochs,
            num_mini_batches=s.minibatches,
            clip_param=s.clip,
            gamma=s.discount**s.repeat,
            lam=s.gae_lambda,
            value_loss_coef=s.value_weight,
            entropy_coef=s.entropy,
            learning_rate=s.learning_rate,
            max_grad_norm=s.gradient_norm,
            use_clipped_value_loss=s.clip_value,
            schedule="fixed" if s.desired_kl is None else "adaptive",
            desired_kl=s.desired_kl,
        )

    def learn(self, steps: int, report: Report | None = None) -> None:
        """Goes on until `steps` environment steps have been taken in all, in whole iterations.

        Raises:
            NotFiniteError: a number in state, reward, action or loss is not finite.
        """
        ppo, env = self._ppo, self._env
        ppo.train_mode()
        observation = env.get_observations()
        while self.steps < steps:
            started = time.perf_counter()
            before = (self.environment.seconds, self.environment.dynamics.seconds)
            with torch.inference_mode():
                for _ in range(self.settings.rollout):
                    actions = ppo.act(observation)
                    observation, rewards, dones, extras = env.step(actions)
                    self._count(rewards, dones, extras["spared"])
                    rewards += self._credit(extras["spared"])
                    if not self.settings.bootstrap:
                        del extras["time_outs"]
                    ppo.process_env_step(observation, rewards, dones, extras)
                ppo.compute_returns(observation)
            collected = time.perf_counter()
            losses = self._update()
            self.steps += self.settings.steps
            self._settle(min(self.steps / steps, 1.0))
            if report is not None:
                metrics = {
                    "collect_seconds": collected - started,
                    "environment_seconds": self.environment.seconds - before[0],
                    "physics_seconds": self.environment.dynamics.seconds - before[1],
                    "update_seconds": time.perf_counter() - collected,
                    "value_loss": losses["value"],
                    "learning_rate": ppo.learning_rate,
                    "std": ppo.actor.output_std.mean().item(),
                }
                if self._returns:
                    metrics["episode_return"] = float(np.mean(self._returns))
                    metrics["episode_length"] = float(np.mean(self._lengths))
                report(self.steps, metrics)

    def _update(self) -> dict[str, float]:
        losses = self._ppo.update()
        self._expect_finite(losses)
        self._expect_sound()
        return losses

    def _expect_finite(self, losses: Mapping[str, float]) -> None:
        for name, loss in losses.items():
            if not math.isfinite(loss):
                storage = self._ppo.storage
                names = ("actions", "rewards", "dones", "values", "returns", "advantages")
                arrays = {name: getattr(storage, name).numpy() for name in names}
                arrays |= _arrays(storage.observations.to_dict())
                message = f"the {name} loss is not finite in the iteration after {self.steps} steps"
                raise NotFiniteError(message, arrays)

    def _expect_sound(self) -> None:
        """The losses are those before the last update; what it left is looked at too."""
        networks = {"actor": self._ppo.actor, "critic": self._ppo.critic}
        finite = all(w.isfinite().all() for n in networks.values() for w in n.parameters())
        if not finite:
            arrays = {
                f"{network}.{name}": tensor.numpy()
                for network, model in networks.items()
                for name, tensor in model.state_dict().items()
            }
            message = f"a weight is not finite in the iteration after {self.steps} steps"
            raise NotFiniteError(message, arrays)

    def _settle(self, share: float) -> None:
        """Holds the policy's spread below its bound, and lowers the learning rate, after a share
        of the stage."""
        s = self.settings
        if s.final_std is not None:
            bound = s.initial_std * (s.final_std / s.initial_std) ** share
            with torch.no_grad():
                self._ppo.actor.distribution.log_std_param.clamp_(max=math.log(bound))
        if s.final_learning_rate is not None:
            rate = s.learning_rate * (s.final_learning_rate / s.learning_rate) ** share
            self._ppo.learning_rate = rate

    def _credit(self, spared: torch.Tensor) -> torch.Tensor:
        """What the steps that an arrival spares are credited with, as scores have it, in rewards
        per step and discounted by actions."""
        s = self.settings
        return self.environment.mdp.credit(spared / s.repeat, s.discount**s.repeat)

    def _count(self, rewards: torch.Tensor, dones: torch.Tensor, spared: torch.Tensor) -> None:
        repeat = self.settings.repeat  # an episode's last hold counts in full
        self._return += rewards.numpy() * repeat
        self._return += self.environment.mdp.credit(spared.numpy())
        self._length += repeat
        ended = np.flatnonzero(dones.numpy())
        self._returns.extend(self._return[ended].tolist())
        self._lengths.extend(self._length[ended].tolist())
        self._return[ended] = 0.0
        self._length[ended] = 0

    def snapshot(self) -> dict[str, Any]:
        """All that the next iteration depends on: plain values, and arrays that it will change."""
        ppo = self._ppo
        return {
            "steps": self.steps,
            "actor": _arrays(ppo.actor.state_dict()),
            "critic": _arrays(ppo.critic.state_dict()),
            "optimizer": {"policy": ppo.policy.snapshot(), "value": ppo.value.snapshot()},
            "learning_rate": ppo.learning_rate,
            "rng": torch.get_rng_state().numpy(),
            "environment": self._env.snapshot(),
            "episodes": {
                "returns": list(self._returns),
                "lengths": list(self._lengths),
                "return": self._return,
                "length": self._length,
            },
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Goes on from where `snapshot` was taken, to the last bit.

        Raises:
            TsbenchError: it was taken from another kind of learner.
        """
        ppo = self._ppo
        try:
            self.steps = snapshot["steps"]
            ppo.actor.load_state_dict(_tensors(snapshot["actor"]))
            ppo.critic.load_state_dict(_tensors(snapshot["critic"]))
            ppo.policy.restore(snapshot["optimizer"]["policy"])
            ppo.value.restore(snapshot["optimizer"]["value"])
            ppo.learning_rate = snapshot["learning_rate"]
            torch.set_rng_state(torch.from_numpy(snapshot["rng"]))
            self._env.restore(snapshot["environment"])
            episodes = snapshot["episodes"]
            self._returns.extend(episodes["returns"])
            self._lengths.extend(episodes["lengths"])
            self._return[:] = episodes["return"]
            self._length[:] = episodes["length"]
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise TsbenchError(f"the checkpoint does not fit this stage: {reason}") from None

    def policy(self, task: Task[Any], method: str) -> Policy:
        """What has been learned for the task, as an artefact."""
        actor = self._ppo.actor
        linear = [module for module in actor.mlp if isinstance(module, torch.nn.Linear)]
        weights = tuple(layer.weight.detach().numpy().copy() for layer in linear)
        normaliser = actor.obs_normalizer
        return Policy(
            info=PolicyInfo(
                task=task.name,
                task_version=task.version,
                physics=fingerprint(task.spec()),
                method=method,
                activation=self.settings.activation,
                encoding=self.settings.encoding,
                layers=(weights[0].shape[1], *(weight.shape[0] for weight in weights)),
            ),
            mean=normaliser.mean.numpy().copy(),
            scale=(normaliser.std + normaliser.eps).numpy().copy(),
            weights=weights,
            biases=tuple(layer.bias.detach().numpy().copy() for layer in linear),
        )


def _arrays(tensors: Mapping[str, torch.Tensor]) -> dict[str, np.ndarray]:
    return {name: tensor.numpy() for name, tensor in tensors.items()}


def _tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
