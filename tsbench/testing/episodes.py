"""Whole episodes by dm_control and by the batched simulation, and a comparison of the two."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, cast

import dm_env
import numpy as np

import tsbench
from tsbench import tasks
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.state import Start, State
from tsbench.core.task import Plannable, SimulatedTask, plannable
from tsbench.sim.kinematic import naive_plan
from tsbench.sim.physics import Physics
from tsbench.sim.single import Adapter, environment

Actions = Callable[[], np.ndarray]  # the action of each step in turn


@cache
def plan_of(name: str) -> Plan:
    """The plan of a task's hand-made planner."""
    return naive_plan(tasks.make(name))


@cache
def reference_of(name: str) -> ReferenceMotion:
    """The plan of a task's hand-made planner as full poses."""
    return plannable(tasks.make(name)).reference(plan_of(name))


@cache
def plannable_tasks() -> tuple[str, ...]:
    """The tasks that have a planning variant."""
    return tuple(name for name in tasks.names() if isinstance(tasks.make(name), Plannable))


@cache
def one_of_each_kind() -> tuple[str, ...]:
    """One task of each class with a planning variant, for tests that are too slow for all tasks."""
    kinds: dict[type, str] = {}
    for name in plannable_tasks():
        kinds.setdefault(type(tasks.make(name)), name)
    return tuple(kinds.values())


@dataclass(frozen=True)
class Case:
    """A task or one of its variants.

    Attributes:
        name: name of the task.
        variant: the variant, as `tsbench.load` takes it.
    """

    name: str
    variant: tsbench.Variant | None = None

    @property
    def reference(self) -> ReferenceMotion | None:
        return reference_of(self.name) if self.variant == "imitation" else None

    def load(self, seed: int = 0, *, perturbed: bool = True) -> dm_env.Environment:
        """The environment, with random starts if the case has them and `perturbed` is true."""
        return tsbench.load(
            self.name,
            self.variant,
            reference=self.reference,
            seed=seed,
            perturbed=perturbed and self.variant is None,
        )

    def __str__(self) -> str:
        return f"{self.name}-{self.variant or 'task'}"


def mdp(environment: dm_env.Environment) -> Any:
    """The task or variant of an environment."""
    return cast(Adapter, environment.task).mdp


def state_of(environment: dm_env.Environment) -> Any:
    """The present state of an environment, with a batch axis of length one."""
    return cast(Adapter, environment.task).state


def values(time_step: dm_env.TimeStep) -> np.ndarray:
    """The observation of a time step."""
    (observation,) = time_step.observation.values()
    return cast(np.ndarray, observation)


def episode(environment: dm_env.Environment, policy: Actions) -> Iterator[dm_env.TimeStep]:
    """The time steps of a new episode. It fails if the episode exceeds the horizon."""
    time_step = environment.reset()
    yield time_step
    for _ in range(mdp(environment).horizon):
        time_step = environment.step(policy())
        yield time_step
        if time_step.last():
            return
    raise AssertionError("the episode goes on beyond the horizon")


def at_random(environment: dm_env.Environment, seed: int) -> Actions:
    """A policy of uniform random actions in [-1, 1]."""
    rng = np.random.default_rng(seed)
    size = environment.action_spec().shape
    return lambda: rng.uniform(-1.0, 1.0, size)


def ending(environment: dm_env.Environment, policy: Actions) -> bool:
    """Plays an episode, and checks that its discount ends at 0 in a terminal state or at 1 at the
    horizon's last step. Returns whether the last state was terminal."""
    subject = mdp(environment)
    steps, last = 0, None
    for time_step in episode(environment, policy):
        if time_step.first():  # an imitation episode may begin anywhere along its reference
            steps = round(float(state_of(environment).time[0]) / subject.timestep)
        else:
            steps += 1
        last = time_step
    assert last is not None
    terminal = bool(subject.terminal(state_of(environment))[0])
    assert last.discount == (0.0 if terminal else 1.0)
    assert terminal or steps == subject.horizon
    return terminal


def same(first: State, second: State) -> bool:
    """Whether two states are equal to the last bit."""
    pairs = [(getattr(first, f.name), getattr(second, f.name)) for f in fields(first)]
    return all(a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs)


@dataclass
class Placed:
    """A task whose episodes begin at the given starts."""

    task: SimulatedTask[Any]
    starts: Start

    def start(self, rng: np.random.Generator, count: int, *, perturbed: bool = False) -> Start:
        assert count == len(self.starts.time)
        return self.starts

    def __getattr__(self, name: str) -> Any:
        return getattr(self.task, name)


def play_batched(
    task: SimulatedTask[Any], starts: Start, actions: np.ndarray, threads: int = 1
) -> tuple[list[Any], np.ndarray]:
    """The states (T + 1) and rewards (T, rows) that `actions` (T, rows, a) lead to."""
    physics = Physics(task, len(starts.time), threads=threads)
    states = [physics.place(np.arange(len(starts.time)), starts)]
    rewards = []
    for action in actions:
        states.append(physics.advance(states[-1], action))
        rewards.append(task.reward(states[-2], action, states[-1]))
    return states, np.array(rewards)


def compare(task: SimulatedTask[Any], starts: Start, actions: np.ndarray) -> list[int]:
    """Plays `actions` (T, rows, a) from `starts` by the batched simulation and by dm_control, and
    checks that both agree to the last bit. Returns the steps at which the episodes end."""
    states, rewards = play_batched(task, starts, actions, threads=2)
    observations = [task.observation(state) for state in states]
    ends = []
    for index in range(len(starts.time)):
        single = environment(cast(Any, Placed(task, starts.rows(slice(index, index + 1)))), seed=0)
        time_step = single.reset()
        first = round(float(starts.time[index]) / task.timestep)
        step = 0
        while True:
            assert values(time_step).tobytes() == observations[step][index].tobytes(), (index, step)
            at = states[step].rows(slice(index, index + 1))
            assert same(state_of(single), at), (index, step)
            if time_step.last():
                break
            time_step = single.step(actions[step, index])
            assert time_step.reward == rewards[step, index], (index, step)
            step += 1
            terminal = bool(task.terminal(states[step])[index])
            assert time_step.last() == (terminal or first + step >= task.horizon)
            assert time_step.discount == (0.0 if terminal else 1.0)
        ends.append(first + step)
    return ends
