"""How fast episodes are stepped, as ratios measured side by side in one run.

Every case does the same control steps of the same task with the same random actions. The cases
take turns, so that whatever else the machine does meanwhile falls on all of them.
"""

from __future__ import annotations

import itertools
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from statistics import median
from typing import Any

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from tsbench import tasks
from tsbench.errors import unknown
from tsbench.mdp import Task
from tsbench.sim.batched import BatchedEnvironment, Physics
from tsbench.sim.kinematic import Planning
from tsbench.sim.single import environment

TASKS = {"laikago": "laikago_trot", "rocket": "rocket_obstacles"}
COUNT = 512  # environments in a batch
REPEATS = 5
SECONDS = 2.0  # that a case runs in a turn
QUICK_REPEATS, QUICK_SECONDS = 3, 0.3
NOISE = 0.2  # standard deviation of actions: robots move, and stand for a while

RECORDED = 60  # control steps that the bare rollout repeats
RATIOS = (("batched", "rollout"), ("batched", "loop"), ("planning", "batched"))

Steps = Callable[[], int]  # does some control steps and says how many


@dataclass(frozen=True)
class Case:
    """Attributes:
    name: what is measured.
    steps: does some control steps, all environments counted, and returns their number.
    """

    name: str
    steps: Steps


@dataclass(frozen=True)
class Rate:
    """Control steps per second over the turns of a case."""

    median: float
    least: float
    most: float


@dataclass(frozen=True)
class Result:
    """Attributes:
    rates: by domain and case, such as `laikago.batched`.
    ratios: of medians, such as `laikago.batched/rollout`.
    machine: where they were measured, and with which versions.
    """

    rates: dict[str, Rate]
    ratios: dict[str, float]
    machine: dict[str, Any]


def batched(task: Task[Any], count: int) -> Case:
    """Our batched environment: actions in, observations, rewards, endings and resets out."""
    batch = BatchedEnvironment(task, Physics(task, count), count, seed=0)
    return _case("batched", batch, task.action_size, count)


def planning(task: Task[Any], count: int) -> Case:
    """The batched planning variant."""
    variant: Planning[Any] = Planning(task)
    batch = BatchedEnvironment(variant, variant, count, seed=0)
    return _case("planning", batch, variant.action_size, count)


def _case(name: str, batch: BatchedEnvironment[Any], actions: int, count: int) -> Case:
    rng = np.random.default_rng(0)
    batch.reset()

    def steps() -> int:
        batch.step(rng.normal(0.0, NOISE, (count, actions)))
        return count

    return Case(name, steps)


def loop(task: Task[Any]) -> Case:
    """A plain loop over one dm_control environment."""
    single = environment(task, seed=0)
    rng = np.random.default_rng(0)
    single.reset()

    def steps() -> int:
        for _ in range(16):
            single.step(rng.normal(0.0, NOISE, task.action_size))  # begins anew by itself
        return 16

    return Case("loop", steps)


def rollout(task: Task[Any], count: int) -> Case:
    """Bare `mujoco.rollout` from states and with controls that the batched environment went
    through: states out, no sensors of the new state, no MDP, no resets. The limit."""
    physics: Physics[Any] = Physics(task, count)
    batch = BatchedEnvironment(task, physics, count, seed=0)
    rng = np.random.default_rng(0)
    model = physics.batch.model
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    batch.reset()
    recorded = []
    for _ in range(RECORDED):
        state = np.zeros((count, mujoco.mj_stateSize(model, kind)))  # time, qpos, qvel
        state[:, 1:] = np.concatenate([physics.batch.qpos, physics.batch.qvel], axis=1)
        batch.step(rng.normal(0.0, NOISE, (count, task.action_size)))
        recorded.append((state, np.repeat(physics.batch.ctrl[:, None], task.substeps, axis=1)))
    threads = os.cpu_count() or 1
    datas = [mujoco.MjData(model) for _ in range(threads)]
    pool = Rollout(nthread=threads)
    turns = itertools.cycle(recorded)

    def steps() -> int:
        state, controls = next(turns)
        pool.rollout(model, datas, state, controls)
        return count

    return Case("rollout", steps)


def measure(*, only: str | None = None, quick: bool = False) -> Result:
    """Runs the cases of the domains, or of one of them.

    Raises:
        TsbenchError: `only` names no domain.
    """
    if only is not None and only not in TASKS:
        raise unknown("benchmark", only, TASKS)
    repeats, seconds = (QUICK_REPEATS, QUICK_SECONDS) if quick else (REPEATS, SECONDS)
    rates: dict[str, Rate] = {}
    ratios: dict[str, float] = {}
    for domain, name in TASKS.items():
        if only in (None, domain):
            task = tasks.make(name)
            make = (batched, rollout, planning)
            cases = [*(case(task, COUNT) for case in make), loop(task)]
            found = _take_turns(cases, repeats, seconds)
            rates |= {f"{domain}.{case}": rate for case, rate in found.items()}
            for over, under in RATIOS:
                ratios[f"{domain}.{over}/{under}"] = found[over].median / found[under].median
    return Result(rates, ratios, _machine())


def _take_turns(cases: list[Case], repeats: int, seconds: float) -> dict[str, Rate]:
    measured: dict[str, list[float]] = {case.name: [] for case in cases}
    for case in cases:
        case.steps()  # the first one allocates
    for _ in range(repeats):
        for case in cases:
            done, began = 0, time.perf_counter()
            while (elapsed := time.perf_counter() - began) < seconds:
                done += case.steps()
            measured[case.name].append(done / elapsed)
    return {name: Rate(median(all_), min(all_), max(all_)) for name, all_ in measured.items()}


def _machine() -> dict[str, Any]:
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("mujoco", "numpy", "dm-control")},
    }
