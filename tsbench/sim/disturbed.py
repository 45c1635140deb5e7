"""Training under disturbances: random pushes and random physics."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from tsbench.core.arrays import Array
from tsbench.core.state import Rng, S
from tsbench.core.task import SimulatedTask
from tsbench.sim.change import Change
from tsbench.sim.physics import Physics
from tsbench.sim.push import Push, direction

MOST_LATENCY = 100  # control steps; more is a mistake


@dataclass(frozen=True)
class Disturbances:
    """Random disturbances, all uniformly distributed; zeros disturb nothing.

    Attributes:
        push: largest force of a push in newtons, on the task's pushed body, at any heading.
        rise: environment steps over which pushes and latency grow linearly: the largest force from
            zero to `push`, and the latency's range from none to `latency`. A policy that is pushed
            over from the first step on learns nothing.
        calm: share of the episodes without a push, because scores start with the undisturbed task.
        interval: seconds from push to push. The first comes at random within one interval.
        duration: duration of a push in seconds.
        mass: largest change of all masses, as a share, up or down; drawn for each environment.
        friction: the same for friction.
        strength: the same for the strength of the motors.
        latency: control steps at most by which actions come late; of each episode its own, all
            numbers of steps equally likely after the rise. Actions of zero come before the first.
    """

    push: float = 0.0
    rise: int = 0
    calm: float = 0.0
    interval: float = 1.0
    duration: float = 0.1
    mass: float = 0.0
    friction: float = 0.0
    strength: float = 0.0
    latency: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.push < math.inf:
            raise ValueError(f"push must not be negative, not {self.push}")
        if self.rise < 0:
            raise ValueError(f"rise must not be negative, not {self.rise}")
        if not 0 <= self.latency <= MOST_LATENCY:
            raise ValueError(f"latency must lie between 0 and {MOST_LATENCY}, not {self.latency}")
        if not 0.0 < self.duration <= self.interval < math.inf:
            raise ValueError("duration must be positive and at most the interval")
        for name in ("calm", "mass", "friction", "strength"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise ValueError(f"{name} must lie in [0, 1), not {getattr(self, name)}")


def physics_factors(disturbances: Disturbances, rng: Rng, count: int) -> np.ndarray:
    """Factors of mass, friction and strength, shape (count, 3); none where nothing disturbs
    them."""
    bounds = [disturbances.mass, disturbances.friction, disturbances.strength]
    if not any(bounds):
        return np.ones((0, 3))
    factors: np.ndarray = 1.0 + rng.uniform(-1.0, 1.0, (count, 3)) * bounds
    return factors


def variants(model: mujoco.MjModel, factors: np.ndarray) -> list[mujoco.MjModel]:
    """Models with other mass, friction and strength, one for each row of `factors` (p, 3)."""
    models = [copy.copy(model) for _ in factors]
    for one, (mass, friction, strength) in zip(models, factors, strict=True):
        Change(mass, friction, strength).apply(one)
    return models


class DisturbedPhysics(Physics[S]):
    """Full physics under disturbances.

    Every environment keeps its own physics for good, drawn from `seed`. An episode's pushes and its
    latency are drawn when it begins, so that they depend on nothing that happens in it.
    """

    def __init__(
        self,
        task: SimulatedTask[S],
        count: int,
        disturbances: Disturbances,
        seed: int,
        *,
        threads: int | None = None,
    ) -> None:
        super().__init__(task, count, threads=threads)
        self.disturbances = disturbances
        pushes = math.ceil(task.horizon * task.timestep / disturbances.interval) + 1
        self._first = np.zeros(count)  # seconds into the episode
        self._forces = np.zeros((count, pushes, 3))
        self._latency = np.zeros(count, int)  # of each episode
        self._actions = np.zeros(
            (count, disturbances.latency + 1, task.action_size)
        )  # newest first
        self._factors = physics_factors(disturbances, np.random.default_rng(seed), count)
        if len(self._factors):
            self._models = variants(self.batch.model, self._factors)
            self.batch.set_models(self._models)

    def begin(self, rng: Rng, rows: np.ndarray) -> S:
        if self.disturbances.push:
            self._draw(rng, rows)
        if self.disturbances.latency:
            most = 1.0 + self._level() * self.disturbances.latency
            self._latency[rows] = rng.uniform(0.0, most, len(rows)).astype(int)
            self._actions[rows] = 0.0
        return super().begin(rng, rows)

    def advance(self, state: S, action: Array, rows: np.ndarray | None = None) -> S:
        if self.disturbances.latency:
            at = np.arange(len(self._actions)) if rows is None else rows
            self._actions[at, 1:] = self._actions[at, :-1]
            self._actions[at, 0] = action
            action = self._actions[at, self._latency[at]]
        return super().advance(state, action, rows)

    def unseen(self) -> tuple[np.ndarray, ...]:
        """Factors of mass, friction and motor strength, and the latency in control steps, where
        they are disturbed. How well an episode goes hangs on them, so a critic that does not know
        them takes them for merits of the actions."""
        factors = tuple(self._factors.T) if len(self._factors) else ()
        return (*factors, self._latency) if self.disturbances.latency else factors

    def _draw(self, rng: Rng, rows: np.ndarray) -> None:
        shape = (len(rows), self._forces.shape[1])
        heading = rng.uniform(0.0, 2.0 * math.pi, shape)
        size = rng.uniform(0.0, 1.0, shape) * (self.disturbances.push * self._level())
        size *= rng.uniform(0.0, 1.0, (len(rows), 1)) >= self.disturbances.calm
        self._forces[rows] = size[..., None] * direction(self.plant, heading)
        self._first[rows] = rng.uniform(0.0, self.disturbances.interval, len(rows))

    def _level(self) -> float:
        """Share of the rise that lies behind, in [0, 1]."""
        steps, rise = self.substeps / self.plant.substeps, self.disturbances.rise
        return 1.0 if steps >= rise else steps / rise

    def snapshot(self) -> dict[str, Any]:
        return {
            **super().snapshot(),
            "first": self._first,
            "forces": self._forces,
            "latency": self._latency,
            "actions": self._actions,
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        super().restore(snapshot)
        self._first, self._forces = snapshot["first"], snapshot["forces"]
        self._latency, self._actions = snapshot["latency"], snapshot["actions"]

    def push_force(self, time: np.ndarray, rows: np.ndarray | slice) -> np.ndarray:
        """The force of the latest push that begins before the end of the step. See `Physics`."""
        first, interval = self._first[rows], self.disturbances.interval
        number = np.floor((time + self.task.timestep - first) / interval).astype(int)
        number = np.clip(number, 0, self._forces.shape[1] - 1)
        force = self._forces[rows][np.arange(len(number)), number]
        push = Push(
            first + number * interval, np.full_like(first, self.disturbances.duration), force
        )
        return push.during(time, self.task.timestep)
