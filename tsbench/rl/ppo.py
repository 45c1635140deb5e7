"""Proximal policy optimisation (Schulman et al. 2017) by rsl-rl, and the resulting policy artefact.

The models and the storage are rsl-rl's. The update is rsl-rl's too or, for small networks, the one
in numpy (`rl/update.py`). rsl-rl's runner is not used: it prints a page per iteration, stores the
diff of the enclosing repository and changes the configuration passed to it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import GaussianDistribution
from rsl_rl.storage import RolloutStorage

from tsbench.core.errors import NotFiniteError, TsbenchError
from tsbench.core.policy import Policy, PolicyInfo
from tsbench.core.task import Task
from tsbench.rl import processes
from tsbench.rl.rollout import Rollout
from tsbench.rl.settings import PPOSettings
from tsbench.rl.threads import one_thread
from tsbench.rl.update import make_update
from tsbench.rl.vec_env import learner_environment
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.device import DeviceEnvironment
from tsbench.sim.model import fingerprint

Prepare = Callable[[int], None]  # (environment steps so far)
Report = Callable[[int, Mapping[str, float]], None]  # (environment steps so far, metrics)


class Gaussian(GaussianDistribution):
    """rsl-rl's, whose draws make a GPU wait: `torch.normal` looks whether a deviation is negative.
    These are the same to the last bit."""

    def sample(self) -> torch.Tensor:
        with torch.no_grad():
            drawn: torch.Tensor = self._distribution.rsample()
        return drawn


class Learner:
    """An actor and a critic that learn in one environment.

    Attributes:
        steps: environment steps taken, of all processes together.
    """

    @one_thread()
    def __init__(
        self,
        environment: BatchedEnvironment[Any] | DeviceEnvironment[Any],
        settings: PPOSettings,
        seed: int,
        actor_from: Learner | None = None,
    ) -> None:
        """`actor_from` is a learner whose actor and normalisers are copied. The critic's weights
        are new, because the other learner's values belong to another reward."""
        torch.manual_seed(seed)
        self.settings = settings
        self.environment = environment
        self._env = learner_environment(environment, settings.encoding, settings.repeat)
        self.steps = 0
        self._actor, self._critic = self._networks()
        storage = RolloutStorage(
            "rl",
            self._env.num_envs,
            settings.rollout,
            self._env.get_observations(),
            [self._env.num_actions],
            self._env.device,
        )
        self._rollout = Rollout(
            self._actor,
            self._critic,
            storage,
            discount=settings.discount**settings.repeat,
            gae_lambda=settings.gae_lambda,
            normalise=not settings.minibatch_advantages,
        )
        self._update = make_update(self._actor, self._critic, storage, settings)
        if actor_from is not None:
            self._actor.load_state_dict(actor_from._actor.state_dict())
            seen = actor_from._critic.obs_normalizer
            if seen.mean.shape == self._critic.obs_normalizer.mean.shape:  # the same disturbances
                self._critic.obs_normalizer.load_state_dict(seen.state_dict())
            with torch.no_grad():
                self._actor.distribution.log_std_param.fill_(math.log(settings.initial_std))
        if processes.count() > 1:  # the same weights, but other actions
            torch.manual_seed(processes.own(seed))

    def _networks(self) -> tuple[MLPModel, MLPModel]:
        """Actor and critic with initial weights."""
        s, env = self.settings, self._env
        observation = env.get_observations()
        groups = {"actor": ["policy"], "critic": ["value"]}
        shared = {
            "hidden_dims": list(s.hidden), "activation": s.activation, "obs_normalization": True,
        }  # fmt: skip
        actor = MLPModel(
            observation, groups, "actor", env.num_actions, **shared,
            # The logarithm of the standard deviation is learned, so a gradient step changes a small
            # deviation little. Learned directly, the deviation collapses within some updates on
            # seeds that have not found rewarding actions yet.
            distribution_cfg={
                "class_name": Gaussian, "init_std": s.initial_std, "std_type": "log",
            },
        )  # fmt: skip
        with torch.no_grad():  # so that initial mean actions are nearly zero, the nominal pose
            actor.mlp[-1].weight.mul_(0.01)
            actor.mlp[-1].bias.zero_()
        critic = MLPModel(observation, groups, "critic", 1, **shared)
        return actor.to(env.device), critic.to(env.device)

    @one_thread()
    def learn(
        self, steps: int, report: Report | None = None, prepare: Prepare | None = None
    ) -> None:
        """Trains in whole iterations until the learner has taken `steps` environment steps.

        Args:
            steps: total steps since the learner was made.
            report: receives the metrics of each iteration.
            prepare: called before each iteration, to change settings that depend on the steps
                taken.

        Raises:
            NotFiniteError: a number in state, reward, action or loss is not finite.
        """
        rollout, env = self._rollout, self._env
        self._actor.train()
        self._critic.train()
        observation = env.get_observations()
        while self.steps < steps:
            if prepare is not None:
                prepare(self.steps)
            started = time.perf_counter()
            before = env.seconds
            with torch.inference_mode():
                for _ in range(self.settings.rollout):
                    actions = rollout.act(observation)
                    observation, rewards, dones, extras = env.step(actions)
                    env.count(rewards, dones, extras)
                    rewards += self._credit(extras)
                    if not self.settings.bootstrap:
                        del extras["time_outs"]
                    rollout.add(rewards, dones, extras)
                rollout.finish(observation)
            std = self._actor.output_std.mean().item()
            env.check()
            collected = time.perf_counter()
            losses = self._update.update()
            self._expect_finite(losses)
            self._expect_sound()
            self.steps += self.settings.steps * processes.count()
            self._settle(min(self.steps / steps, 1.0))
            if report is not None:
                environment, physics = env.seconds
                metrics = {
                    "collect_seconds": collected - started,
                    "environment_seconds": environment - before[0],
                    "physics_seconds": physics - before[1],
                    "update_seconds": time.perf_counter() - collected,
                    "value_loss": losses["value"],
                    "learning_rate": self._update.learning_rate,
                    "std": std,
                    **env.finished(),
                }
                if "episode_return" in metrics:
                    mdp = self.environment.mdp
                    largest = mdp.max_reward * mdp.horizon
                    metrics["normalized_return"] = metrics["episode_return"] / largest
                report(self.steps, metrics)

    def _expect_finite(self, losses: Mapping[str, float]) -> None:
        for name, loss in losses.items():
            if not math.isfinite(loss):
                storage = self._rollout.storage
                names = ("actions", "rewards", "dones", "values", "returns", "advantages")
                arrays = _arrays({name: getattr(storage, name) for name in names})
                arrays |= _arrays(storage.observations.to_dict())
                message = f"the {name} loss is not finite in the iteration after {self.steps} steps"
                raise NotFiniteError(message, arrays)

    def _expect_sound(self) -> None:
        """Checks the weights. The losses were computed before the last gradient step, so they do
        not show a failure of that step."""
        networks = {"actor": self._actor, "critic": self._critic}
        finite = all(w.isfinite().all() for n in networks.values() for w in n.parameters())
        if not finite:
            arrays = {
                f"{network}.{name}": array
                for network, model in networks.items()
                for name, array in _arrays(model.state_dict()).items()
            }
            message = f"a weight is not finite in the iteration after {self.steps} steps"
            raise NotFiniteError(message, arrays)

    def _settle(self, share: float) -> None:
        """Limits the policy's standard deviation and lowers the learning rate, as scheduled after
        `share` of the stage."""
        s = self.settings
        if s.final_std is not None:
            bound = s.initial_std * (s.final_std / s.initial_std) ** share
            with torch.no_grad():
                self._actor.distribution.log_std_param.clamp_(max=math.log(bound))
        if s.final_learning_rate is not None:
            rate = s.learning_rate * (s.final_learning_rate / s.learning_rate) ** share
            self._update.learning_rate = rate

    def _credit(self, extras: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """The credit for the steps that an arrival spares, as in scores, in rewards per step and
        discounted by actions."""
        s = self.settings
        spared, quality = extras["spared"] / s.repeat, extras["quality"]
        return self.environment.mdp.credit(spared, quality, s.discount**s.repeat)

    def snapshot(self) -> dict[str, Any]:
        """Everything that the next iteration depends on: plain values, and arrays that the
        iteration will overwrite."""
        return {
            "steps": self.steps,
            "actor": _arrays(self._actor.state_dict()),
            "critic": _arrays(self._critic.state_dict()),
            "update": self._update.snapshot(),
            "rng": random_state(self._env.device),
            "environment": self._env.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot, to the last bit.

        Raises:
            TsbenchError: the snapshot belongs to another kind of learner.
        """
        try:
            self.steps = snapshot["steps"]
            self._actor.load_state_dict(_tensors(snapshot["actor"]))
            self._critic.load_state_dict(_tensors(snapshot["critic"]))
            self._update.restore(snapshot["update"])
            set_random_state(self._env.device, snapshot["rng"])
            self._env.restore(snapshot["environment"])
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise TsbenchError(f"the checkpoint does not fit this stage: {reason}") from None

    def policy(self, task: Task[Any], method: str) -> Policy:
        """The learned policy for the task, as an artefact."""
        linear = [module for module in self._actor.mlp if isinstance(module, torch.nn.Linear)]
        weights = tuple(layer.weight.numpy(force=True).copy() for layer in linear)
        normaliser = self._actor.obs_normalizer
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
            mean=normaliser.mean.numpy(force=True).copy(),
            scale=(normaliser.std + normaliser.eps).numpy(force=True).copy(),
            weights=weights,
            biases=tuple(layer.bias.numpy(force=True).copy() for layer in linear),
        )


def random_state(device: str) -> dict[str, np.ndarray]:
    """The states of torch's generators of the CPU and of the device, by kind."""
    states = {"cpu": torch.get_rng_state().numpy()}
    if torch.device(device).type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(device).numpy()
    return states


def set_random_state(device: str, states: Mapping[str, np.ndarray]) -> None:
    """Restores the states of torch's generators."""
    torch.set_rng_state(torch.from_numpy(states["cpu"]))
    if torch.device(device).type == "cuda":
        torch.cuda.set_rng_state(torch.from_numpy(states["cuda"]), device)


def _arrays(tensors: Mapping[str, torch.Tensor]) -> dict[str, np.ndarray]:
    return {name: tensor.numpy(force=True) for name, tensor in tensors.items()}


def _tensors(arrays: Mapping[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array) for name, array in arrays.items()}
