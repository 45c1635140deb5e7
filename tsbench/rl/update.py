"""PPO's update: rsl-rl's own, and the same in numpy for small networks on the CPU.

For networks of 64 x 64 units and minibatches of 256 actions, rsl-rl's update takes five times as
long as its arithmetic: torch dispatches, records and differentiates some 250 small operations. The
update in numpy computes the gradients by explicit formulas, in the memory of torch's parameters.
tests/rl/test_update.py compares the two updates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from torch import nn

from tsbench.core.errors import TsbenchError
from tsbench.rl import processes
from tsbench.rl.settings import PPOSettings

WIDE = 512  # hidden layer size from which numpy saves less than a third (docs/speed.md)
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8  # of Adam (Kingma and Ba 2015), as torch's defaults
KL_RATES = (1e-5, 1e-2)  # bounds of rsl-rl's adaptive learning rate
KL_FACTOR = 1.5  # factor between two adaptive learning rates
KL_ROUNDING = 1e-12  # divergences below it are rounding errors: keep the rate

Array = np.ndarray  # float32, as torch's


class Update(Protocol):
    """Improves an actor and a critic by the steps in a storage.

    Attributes:
        learning_rate: learning rate of both networks in the next update.
    """

    learning_rate: float

    def update(self) -> dict[str, float]:
        """Runs all epochs over minibatches of the stored steps, which are shuffled once. Then
        empties the storage and updates the normalisers. Returns the mean losses, `value` and
        `surrogate` among them."""

    def snapshot(self) -> dict[str, Any]:
        """The state that the next update depends on besides the networks: plain values, and arrays
        that the update will overwrite."""

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot."""


def make_update(
    actor: MLPModel, critic: MLPModel, storage: RolloutStorage, settings: PPOSettings
) -> Update:
    """The update that `settings.update` names.

    `auto` takes the one in numpy where the networks are on the CPU, every hidden layer has fewer
    than `WIDE` units, and numpy's implements all settings. Elsewhere it takes rsl-rl's.

    Raises:
        TsbenchError: numpy's is asked for networks that are not on the CPU.
    """
    on_cpu = torch.device(storage.device).type == "cpu"
    if settings.update == "numpy" and not on_cpu:
        raise TsbenchError(f"update: numpy works on the CPU, not on {storage.device}")
    small = on_cpu and max(settings.hidden) < WIDE and not settings.beyond_numpy
    if settings.update == "numpy" or (settings.update == "auto" and small):
        return NumpyUpdate(actor, critic, storage, settings)
    return RslUpdate(actor, critic, storage, settings)


class RslUpdate:
    """rsl-rl's own update, on any device, and of several processes together. An `Update`."""

    def __init__(
        self, actor: MLPModel, critic: MLPModel, storage: RolloutStorage, settings: PPOSettings
    ) -> None:
        self._ppo = PPO(
            actor,
            critic,
            storage,
            num_learning_epochs=settings.epochs,
            num_mini_batches=settings.minibatches,
            clip_param=settings.clip,
            value_loss_coef=settings.value_weight,
            entropy_coef=settings.entropy,
            learning_rate=settings.learning_rate,
            max_grad_norm=settings.gradient_norm,
            optimizer=settings.optimizer,
            use_clipped_value_loss=settings.clip_value,
            schedule="fixed" if settings.desired_kl is None else "adaptive",
            desired_kl=settings.desired_kl,
            normalize_advantage_per_mini_batch=settings.minibatch_advantages,
            device=str(storage.device),
            multi_gpu_cfg=_processes(),
        )

    @property
    def learning_rate(self) -> float:
        return self._ppo.learning_rate

    @learning_rate.setter
    def learning_rate(self, rate: float) -> None:
        self._ppo.learning_rate = rate
        for group in self._ppo.optimizer.param_groups:
            group["lr"] = rate

    def update(self) -> dict[str, float]:
        losses = self._ppo.update()
        if self._ppo.is_multi_gpu:
            # rsl-rl averages gradients and moments of observations: this keeps rounding alike too.
            self._ppo.broadcast_parameters()
        return losses

    def snapshot(self) -> dict[str, Any]:
        state = self._ppo.optimizer.state_dict()["state"]
        return {
            "learning_rate": self.learning_rate,
            "optimizer": {
                str(parameter): {
                    name: value.cpu().numpy() if isinstance(value, torch.Tensor) else value
                    for name, value in values.items()
                }
                for parameter, values in state.items()
            },
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        optimizer = self._ppo.optimizer
        state = {
            int(parameter): {
                name: torch.tensor(value) if isinstance(value, np.ndarray) else value
                for name, value in values.items()
            }
            for parameter, values in snapshot["optimizer"].items()
        }
        optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
        self.learning_rate = snapshot["learning_rate"]


def _processes() -> dict[str, int] | None:
    """What rsl-rl is told of the processes that learn together."""
    if processes.count() == 1:
        return None
    return {
        "global_rank": processes.rank(),
        "local_rank": processes.local_rank(),
        "world_size": processes.count(),
    }


def _elu(x: Array, out: Array) -> None:
    """In place; `out` is scratch memory."""
    np.exp(np.minimum(x, 0.0, out=out), out=out)
    out -= 1.0
    np.maximum(x, out, out=x)


def _elu_slope(y: Array, out: Array) -> None:
    np.minimum(y, 0.0, out=out)
    out += 1.0


def _relu(x: Array, out: Array) -> None:
    np.maximum(x, 0.0, out=x)


def _relu_slope(y: Array, out: Array) -> None:
    np.greater(y, 0.0, out=out, casting="unsafe")


def _tanh(x: Array, out: Array) -> None:
    np.tanh(x, out=x)


def _tanh_slope(y: Array, out: Array) -> None:
    np.multiply(y, y, out=out)
    np.subtract(1.0, out, out=out)


# For each of `policy.ACTIVATIONS`: the function, in place, and its slope, computed from its result.
_ACTIVATIONS: dict[str, tuple[Callable[[Array, Array], None], Callable[[Array, Array], None]]] = {
    "elu": (_elu, _elu_slope),
    "relu": (_relu, _relu_slope),
    "tanh": (_tanh, _tanh_slope),
}


class Network:
    """A torch multilayer perceptron whose parameters share one numpy vector, as do its gradients.

    Attributes:
        log_std: view of the parameter that belongs to no layer, the logarithm of the actions'
            standard deviation; empty without one.
        log_std_gradient: gradient of `log_std`, which the caller writes.
    """

    def __init__(self, model: nn.Module, activation: str, most: float) -> None:
        """`most` is the largest norm of the gradient; a larger one is clipped."""
        parameters = list(model.parameters())
        self._values = np.concatenate([p.detach().numpy().ravel() for p in parameters])
        self._gradient = np.zeros_like(self._values)
        self._moments = (np.zeros_like(self._values), np.zeros_like(self._values))
        self._updates = 0
        self._most = most
        self._activate, self._slope = _ACTIVATIONS[activation]
        layers = [layer for layer in model.modules() if isinstance(layer, nn.Linear)]
        inside = {id(p) for layer in layers for p in layer.parameters()}
        views: dict[int, tuple[Array, Array]] = {}
        self.log_std = self.log_std_gradient = self._values[:0]
        start = 0
        for p in parameters:
            part = slice(start, start := start + p.numel())
            value, gradient = (a[part].reshape(p.shape) for a in (self._values, self._gradient))
            p.data = torch.from_numpy(value)
            views[id(p)] = value, gradient
            if id(p) not in inside:
                self.log_std, self.log_std_gradient = value, gradient
        self._layers = [(*views[id(la.weight)], *views[id(la.bias)]) for la in layers]
        self._outputs: list[Array] = []  # of each layer, after activation
        self._deltas: list[Array] = []  # loss gradients by those before activation
        self._scratch: list[Array] = []

    def forward(self, x: Array) -> Array:
        """Inputs (batch, inputs) -> outputs (batch, outputs). The next call overwrites the
        outputs."""
        if not self._outputs or len(self._outputs[0]) != len(x):
            shapes = [(len(x), len(weight)) for weight, *_ in self._layers]
            self._outputs, self._deltas, self._scratch = (
                [np.empty(shape, np.float32) for shape in shapes] for _ in range(3)
            )
        self._input = x
        for i, (weight, _, bias, _) in enumerate(self._layers):
            y = self._outputs[i]
            np.matmul(x, weight.T, out=y)
            y += bias
            if i < len(self._layers) - 1:
                self._activate(y, self._scratch[i])
            x = y
        return x

    def backward(self, delta: Array) -> None:
        """Computes the gradients of a loss. `delta` (batch, outputs) is the gradient of the loss
        with respect to the outputs of the last `forward`."""
        for i in range(len(self._layers) - 1, -1, -1):
            weight, weight_gradient, _, bias_gradient = self._layers[i]
            x = self._outputs[i - 1] if i else self._input
            np.matmul(delta.T, x, out=weight_gradient)
            np.sum(delta, axis=0, out=bias_gradient)
            if i:
                before, slope = self._deltas[i - 1], self._scratch[i - 1]
                np.matmul(delta, weight, out=before)
                self._slope(x, slope)
                before *= slope
                delta = before

    def step(self, rate: float) -> None:
        """One step of Adam with the clipped gradient and learning rate `rate`."""
        gradient, (first, second) = self._gradient, self._moments
        norm = math.sqrt(float(gradient @ gradient))
        gradient *= min(self._most / (norm + 1e-6), 1.0)
        self._updates += 1
        first += (1.0 - BETA1) * (gradient - first)
        second *= BETA2
        gradient *= gradient
        second += (1.0 - BETA2) * gradient
        scale = rate / (1.0 - BETA1**self._updates)
        root = np.sqrt(second)
        root *= 1.0 / math.sqrt(1.0 - BETA2**self._updates)
        root += EPSILON
        np.divide(first, root, out=root)
        root *= scale
        self._values -= root

    def snapshot(self) -> dict[str, Any]:
        """The state of Adam. The parameters are saved with the torch model."""
        first, second = self._moments
        return {"updates": self._updates, "first": first, "second": second}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self._updates = int(snapshot["updates"])
        for moment, name in zip(self._moments, ("first", "second"), strict=True):
            moment[:] = snapshot[name]


class NumpyUpdate:
    """rsl-rl's update in numpy, for a Gaussian policy whose standard deviation does not depend on
    the state. An `Update`.

    Attributes:
        learning_rate: learning rate of both networks in the next update.
    """

    learning_rate: float

    def __init__(
        self, actor: MLPModel, critic: MLPModel, storage: RolloutStorage, settings: PPOSettings
    ) -> None:
        """Moves the networks' parameters, which must be on the CPU, to numpy arrays."""
        self.learning_rate = settings.learning_rate
        self._settings = settings
        self._actor = actor
        self._critic = critic
        self._storage = storage
        self._policy = Network(actor, settings.activation, settings.gradient_norm)
        self._value = Network(critic, settings.activation, settings.gradient_norm)

    def snapshot(self) -> dict[str, Any]:
        return {
            "learning_rate": self.learning_rate,
            "policy": self._policy.snapshot(),
            "value": self._value.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self._policy.restore(snapshot["policy"])
        self._value.restore(snapshot["value"])
        self.learning_rate = snapshot["learning_rate"]

    def update(self) -> dict[str, float]:
        storage, epochs, minibatches = (
            self._storage,
            self._settings.epochs,
            self._settings.minibatches,
        )
        size = storage.num_envs * storage.num_transitions_per_env // minibatches
        order = torch.randperm(size * minibatches)
        observation = storage.observations.flatten(0, 1)

        def split(steps: torch.Tensor) -> list[Array]:
            shuffled = steps[order].numpy()
            return [shuffled[i : i + size] for i in range(0, len(shuffled), size)]

        with torch.no_grad():
            seen = split(self._actor.get_latent(observation))
            valued = split(self._critic.get_latent(observation))
            mean, spread = (split(p.flatten(0, 1)) for p in storage.distribution_params)
        actions, log_prob, advantage, returns, values = (
            split(steps.flatten(0, 1))
            for steps in (
                storage.actions, storage.actions_log_prob, storage.advantages, storage.returns,
                storage.values,
            )
        )  # fmt: skip
        losses = np.zeros(2)
        with np.errstate(all="ignore"):  # the learner checks losses and weights
            for _ in range(epochs):
                for i in range(minibatches):
                    losses += (
                        self._update_policy(
                            seen[i], actions[i], log_prob[i], advantage[i], mean[i], spread[i]
                        ),
                        self._update_value(valued[i], returns[i], values[i]),
                    )
        self._actor.update_normalization(observation)
        self._critic.update_normalization(observation)
        storage.clear()
        surrogate, value = losses / (epochs * minibatches)
        return {"value": float(value), "surrogate": float(surrogate)}

    def _update_policy(
        self, seen: Array, actions: Array, log_prob: Array, advantage: Array, mean: Array,
        spread: Array,
    ) -> float:  # fmt: skip
        """One step on the clipped surrogate and the entropy bonus (Schulman et al. 2017, eq. 7 and
        9); adapts the learning rate if settings ask for that. Arrays have shape (batch, ...) and
        hold the values at the time of the actions. Returns the surrogate loss."""
        s = self._settings
        now = self._policy.forward(seen)
        log_std = self._policy.log_std
        std = np.exp(log_std)
        if s.desired_kl is not None:
            self._adapt(s.desired_kl, mean, spread, now, std)
        z = (actions - now) / std
        constant = 0.5 * math.log(2.0 * math.pi) * log_std.size
        new = -0.5 * np.sum(z * z, axis=1, keepdims=True) - (np.sum(log_std) + constant)
        ratio = np.exp(new - log_prob)
        low, high = 1.0 - s.clip, 1.0 + s.clip
        gain = advantage * ratio
        clipped = advantage * np.clip(ratio, low, high)
        # Where the clipped gain is the smaller one, the loss does not depend on the policy.
        by_log_prob = np.where(clipped < gain, np.float32(0.0), gain) * np.float32(-1.0 / len(gain))
        self._policy.backward(by_log_prob * z / std)
        by_log_std = by_log_prob * (z * z - 1.0)
        np.sum(by_log_std, axis=0, out=self._policy.log_std_gradient)
        self._policy.log_std_gradient -= s.entropy
        self._policy.step(self.learning_rate)
        return -float(np.mean(np.minimum(gain, clipped)))

    def _adapt(self, wanted: float, mean: Array, spread: Array, now: Array, std: Array) -> None:
        """Adapts the learning rate, so that the mean KL divergence of the current policy from the
        one that acted comes near `wanted`."""
        ratio, distance = (spread.astype(float) / std) ** 2, ((mean - now) / std) ** 2
        kl = 0.5 * float(np.mean(np.sum(ratio - 1.0 - np.log(ratio) + distance, axis=1)))
        if kl > 2.0 * wanted:
            self.learning_rate = max(KL_RATES[0], self.learning_rate / KL_FACTOR)
        elif KL_ROUNDING < kl < 0.5 * wanted:
            self.learning_rate = min(KL_RATES[1], self.learning_rate * KL_FACTOR)

    def _update_value(self, seen: Array, returns: Array, values: Array) -> float:
        s = self._settings
        now = self._value.forward(seen)
        error = now - returns
        square = error * error
        if s.clip_value:
            change = now - values
            bounded = values + np.clip(change, -s.clip, s.clip) - returns
            worse = bounded * bounded
            # Within the range both are equal but for rounding, and the gradient passes.
            stuck = (np.abs(change) > s.clip) & (worse > square)
            error = np.where(stuck, np.float32(0.0), error)
            square = np.maximum(square, worse)
        self._value.backward(error * np.float32(2.0 * s.value_weight / len(error)))
        self._value.step(self.learning_rate)
        return float(np.mean(square))
