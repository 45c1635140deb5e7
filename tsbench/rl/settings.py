"""The settings of proximal policy optimisation, checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tsbench.core.policy import ACTIVATIONS, ENCODINGS

UPDATES = ("auto", "numpy", "rsl_rl")  # `make_update` in rl/update.py resolves `auto`
OPTIMIZERS = ("adam", "adamw", "rmsprop", "sgd")  # rsl-rl's

# Stages that may follow `imitate`, in this order. They go on with its policy, and their settings
# are changes to its settings.
AFTER_IMITATION = ("settle", "finetune")


@dataclass(frozen=True)
class PPOSettings:
    """Attributes:
    environments: episodes stepped together.
    rollout: actions of each between two updates.
    repeat: time steps for which an action is held while learning. Where time steps are short, the
        effect of an action held for one step is lost in noise. The trained policy acts in every
        step.
    epochs: passes over the collected steps in an update.
    minibatches: minibatches per pass.
    discount: gamma, per time step.
    gae_lambda: lambda of generalised advantage estimation, per action.
    clip: range of the probability ratio.
    clip_value: whether the value loss is clipped too.
    entropy: weight of the entropy bonus.
    learning_rate: initial learning rate.
    final_learning_rate: learning rate at the end of a stage, to which it falls geometrically, or
        None; only without `desired_kl`. Only the last policy is scored, and a constant rate keeps
        changing it.
    desired_kl: divergence between old and new policy that the learning rate is adapted to after
        every minibatch, or None not to adapt it.
    value_weight: weight of the value loss.
    gradient_norm: largest norm of a gradient; larger ones are clipped.
    hidden: sizes of the hidden layers of actor and critic.
    activation: activation of the hidden layers, a name in `policy.ACTIVATIONS`.
    encoding: encoding of observations before normalisation, a name in `policy.ENCODINGS`.
    initial_std: initial standard deviation of the Gaussian policy, per unit of action.
    final_std: bound on the standard deviation at the end of a stage; the bound falls geometrically
        from `initial_std`. None for no bound. If actions have dead zones, a policy can come to
        depend on its own noise, and its mean action alone then fails.
    bootstrap: whether a value is added to the reward when an episode ends by its last step: as in
        rsl-rl that of the observation on which the last action was chosen, `repeat` steps before.
    update: which update learns from the collected steps, a name in `UPDATES`.
    optimizer: a name in `OPTIMIZERS`.
    minibatch_advantages: whether advantages are normalised within each minibatch, instead of over
        all collected steps.
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
    update: str = "auto"
    optimizer: str = "adam"
    minibatch_advantages: bool = False

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
        if self.update not in UPDATES:
            raise ValueError(f"update must be one of {', '.join(UPDATES)}")
        if self.optimizer not in OPTIMIZERS:
            raise ValueError(f"optimizer must be one of {', '.join(OPTIMIZERS)}")
        if self.update == "numpy" and (beyond := self.beyond_numpy):
            raise ValueError(f"update must be rsl_rl or auto for {', '.join(beyond)}")

    @property
    def steps(self) -> int:
        """Environment steps between two updates, all environments together."""
        return self.environments * self.rollout * self.repeat

    @property
    def beyond_numpy(self) -> list[str]:
        """The settings, with their values, that the update in numpy does not implement."""
        only = {"optimizer": "adam", "minibatch_advantages": False}
        given = {name: getattr(self, name) for name in only}
        return [f"{name}: {value}" for name, value in given.items() if value != only[name]]


def environments(changes: Mapping[str, Any], most: int | None) -> int:
    """How many episodes are stepped together under these changes to the settings, and a budget that
    allows `most`."""
    wanted: int = changes.get("environments", PPOSettings.environments)
    return wanted if most is None else min(wanted, most)


def iteration_steps(training: Mapping[str, Mapping[str, Any]], kind: str, most: int | None) -> int:
    """`PPOSettings.steps` of a kind of stage, of settings that need not be valid.

    Args:
        training: changes to the settings of each kind.
        kind: of stage; the defaults hold for one without changes.
        most: environments that the budget allows; None for any number.
    """
    given = {**training.get("imitate", {})} if kind in AFTER_IMITATION else {}
    given |= training.get(kind, {})
    sizes = {}
    for name in ("environments", "rollout", "repeat"):
        size = given.get(name, getattr(PPOSettings, name))
        sizes[name] = max(size, 1) if isinstance(size, int) else 1
    sizes["environments"] = environments(sizes, most)
    return math.prod(sizes.values())
