"""Distillation: a network is fitted to actions that something else chose."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from tsbench.core.policy import ENCODINGS, Policy, PolicyInfo
from tsbench.core.task import Task
from tsbench.rl.settings import PPOSettings
from tsbench.rl.threads import one_thread
from tsbench.sim.model import fingerprint

MINIBATCH = 512
ACTIVATIONS = {"elu": torch.nn.ELU, "relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}


@dataclass(frozen=True)
class Lesson:
    """Attributes:
    observations: of the task, shape (n, observation_size).
    actions: the right ones, shape (n, action_size).
    """

    observations: np.ndarray
    actions: np.ndarray


@one_thread()
def distilled(
    task: Task[Any], method: str, lesson: Lesson, settings: PPOSettings, seed: int, epochs: int
) -> tuple[Policy, float]:
    """A policy with the network of the settings that acts as the lesson says, by least squares
    with Adam, whose rate falls to zero.

    Args:
        task: that the policy is for.
        method: that makes it.
        lesson: what to learn.
        settings: of the network, and the first rate.
        seed: of the first weights and the minibatches.
        epochs: passes over the lesson, in random minibatches.

    Returns:
        The policy, and the mean squared error of its actions in the last tenth of the updates.
    """
    torch.manual_seed(seed)
    encoded = ENCODINGS[settings.encoding](lesson.observations.astype(np.float32))
    mean, scale = encoded.mean(axis=0), encoded.std(axis=0) + np.float32(1e-2)
    inputs = torch.from_numpy((encoded - mean) / scale)
    wanted = torch.from_numpy(lesson.actions.astype(np.float32))
    sizes = (inputs.shape[1], *settings.hidden, wanted.shape[1])
    linear = [torch.nn.Linear(n, m) for n, m in itertools.pairwise(sizes)]
    layers: list[torch.nn.Module] = [linear[0]]
    for layer in linear[1:]:
        layers += [ACTIVATIONS[settings.activation](), layer]
    network = torch.nn.Sequential(*layers)
    updates = -(-epochs * len(inputs) // MINIBATCH)
    optimizer = torch.optim.Adam(network.parameters(), settings.learning_rate)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, updates)
    errors = []
    for _ in range(updates):
        rows = torch.randint(len(inputs), (MINIBATCH,))
        loss = torch.nn.functional.mse_loss(network(inputs[rows]), wanted[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        errors.append(loss.item())
    info = PolicyInfo(
        task=task.name,
        task_version=task.version,
        physics=fingerprint(task.spec()),
        method=method,
        activation=settings.activation,
        encoding=settings.encoding,
        layers=sizes,
    )
    policy = Policy(
        info=info,
        mean=mean,
        scale=scale,
        weights=tuple(layer.weight.numpy(force=True).copy() for layer in linear),
        biases=tuple(layer.bias.numpy(force=True).copy() for layer in linear),
    )
    return policy, float(np.mean(errors[-max(1, updates // 10) :]))
