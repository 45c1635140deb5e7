"""The batched environment against bare physics, a plain loop and Gymnasium's AsyncVectorEnv.

Each robot has a comparison, under the name of its MJCF. All of its cases make control steps of the
same task with the same kind of random actions:

* `rollout`: bare `mujoco.rollout` over states and controls recorded from the batched environment.
  It computes states only: no sensors of the new state, no MDP, no resets. It is the upper limit.
* `batched`: tsbench's batched environment, from actions to observations, rewards, endings, resets.
* `loop`: a plain loop over one dm_control environment.
* `async`: Gymnasium's AsyncVectorEnv, with one process for each environment.
* `planning`: the batched planning variant, whose steps are kinematic.
* `planning_ik`: the planning variant's dm_control environment, where mink solves for full poses.

A task without a planning variant has no planning cases.
"""

from __future__ import annotations

import itertools
import os
from functools import partial
from typing import Any

import mujoco
import numpy as np
from gymnasium.vector import AsyncVectorEnv
from mujoco.rollout import Rollout

from tsbench.bench import Findings, comparison
from tsbench.bench.domains import domains, richest
from tsbench.bench.turns import Case, Effort, take_turns
from tsbench.core.task import MDP, Plannable, Task
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.gym import GymEnvironment
from tsbench.sim.kinematic import Planning
from tsbench.sim.physics import Physics
from tsbench.sim.single import environment

NOISE = 0.2  # standard deviation of actions: the robots move, and do not fall at once
RECORDED = 40  # control steps that the bare rollout repeats
SINGLE_STEPS = 8  # steps of a single environment between two looks at the clock
PROCESSES = 4  # AsyncVectorEnv's processes for each core, so that a slow one leaves no core idle

RATIOS = (
    ("batched", "rollout"),
    ("batched", "loop"),
    ("batched", "async"),
    ("planning", "batched"),
    ("planning", "planning_ik"),
)


def compare(domain: str, task: Task[Any], effort: Effort) -> Findings:
    """The rate of every case and the ratios of cases, under names that begin with the domain's."""
    cases = [
        rollout(task, effort.count),
        batched("batched", task, effort.count),
        asynchronous(task),
        loop("loop", task),
    ]
    if isinstance(task, Plannable):
        variant: Planning[Any] = Planning(task)
        cases += [batched("planning", variant, effort.count), loop("planning_ik", variant)]
    rates = take_turns(cases, effort)
    ratios = [pair for pair in RATIOS if rates.turns.keys() >= set(pair)]
    return Findings(
        figures={f"{domain}.{case.name}": rates.range(case.name) for case in cases},
        ratios={f"{domain}.{over}/{under}": rates.ratio(over, under) for over, under in ratios},
    )


for _domain, _group in domains().items():
    comparison(_domain)(partial(compare, _domain, richest(_group)))


def batched(
    name: str, mdp: Task[Any] | Planning[Any], count: int, threads: int | None = None
) -> Case:
    """`count` environments stepped together."""
    dynamics: Any = mdp if isinstance(mdp, Planning) else Physics(mdp, count, threads=threads)
    batch = BatchedEnvironment(mdp, dynamics, count, seed=0)
    rng = np.random.default_rng(0)
    batch.reset()

    def steps() -> int:
        batch.step(random_actions(rng, mdp, count))
        return count

    return Case(name, steps)


def loop(name: str, mdp: Task[Any] | Planning[Any]) -> Case:
    """A plain loop over one dm_control environment."""
    single = environment(mdp, seed=0)
    rng = np.random.default_rng(0)
    single.reset()

    def steps() -> int:
        for action in random_actions(rng, mdp, SINGLE_STEPS):
            single.step(action)  # starts the next episode by itself
        return SINGLE_STEPS

    return Case(name, steps)


def asynchronous(task: Task[Any]) -> Case:
    """Gymnasium's AsyncVectorEnv on all cores."""
    count = PROCESSES * (os.cpu_count() or 1)
    vector = AsyncVectorEnv([lambda: GymEnvironment(environment(task, seed=0))] * count)
    rng = np.random.default_rng(0)
    vector.reset(seed=0)

    def steps() -> int:
        vector.step(random_actions(rng, task, count))
        return count

    return Case("async", steps, vector.close)


def rollout(task: Task[Any], count: int) -> Case:
    """Bare physics from states and with controls recorded from the batched environment."""
    physics: Physics[Any] = Physics(task, count)
    batch = BatchedEnvironment(task, physics, count, seed=0)
    rng = np.random.default_rng(0)
    batch.reset()
    recorded = []
    for _ in range(RECORDED):
        state = full_states(physics.batch)
        batch.step(random_actions(rng, task, count))
        recorded.append((state, physics.batch.bind("ctrl").copy()))
    return bare("rollout", physics.batch.model, recorded, task.substeps)


def full_states(batch: mujoco.batch.Batch) -> np.ndarray:
    """The states of all n simulations in the layout of `mujoco.rollout`, shape (n, size)."""
    states = [batch.bind(name) for name in ("qpos", "qvel")]
    time = np.zeros((batch.nsim, 1))
    return np.concatenate([time, *states], axis=1)


def bare(
    name: str, model: mujoco.MjModel, recorded: list[tuple[np.ndarray, np.ndarray]], substeps: int
) -> Case:
    """`mujoco.rollout` over `substeps` from recorded states (n, size) with controls (n, nu)."""
    threads = os.cpu_count() or 1
    datas = [mujoco.MjData(model) for _ in range(threads)]
    pool = Rollout(nthread=threads)
    held = [(state, np.repeat(ctrl[:, None], substeps, axis=1)) for state, ctrl in recorded]
    turns = itertools.cycle(held)

    def steps() -> int:
        state, controls = next(turns)
        pool.rollout(model, datas, state, controls)
        return len(state)

    return Case(name, steps, pool.close)


def random_actions(rng: np.random.Generator, mdp: MDP[Any], count: int) -> np.ndarray:
    return rng.normal(0.0, NOISE, (count, mdp.action_size))
