"""Control steps per second on a GPU: physics alone, the whole environment, and a training.

All figures are control steps per second, all environments together, on one GPU:

* `physics`: mujoco-warp alone, with constant controls: no observations, rewards, endings or resets.
* `environment`: the environment that a learner steps, from actions to observations, rewards,
  endings and resets.
* `plan`, `imitate`: whole trainings as in `tsbench run device=cuda budget=fast`, for fewer
  iterations, with the shares of their time.

Those whose name ends in `cpu` are the same on the processors of this machine, by C MuJoCo.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
import torch

from tsbench.bench import Findings, comparison
from tsbench.bench.domains import domains, planned, richest
from tsbench.bench.training import split, train
from tsbench.bench.turns import Effort, Range
from tsbench.core.errors import TsbenchError
from tsbench.core.task import Task
from tsbench.rl.devices import described, torch_device
from tsbench.rl.stages import settings
from tsbench.runs.config import compose
from tsbench.runs.execute import prepare
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.device import DeviceEnvironment
from tsbench.sim.physics import Physics

DEVICE = "cuda"
COUNTS = (1_024, 4_096, 16_384, 65_536)
SHARE = 0.5  # of the seconds of an effort's turn, for each figure
CHUNK = 20  # control steps between two looks at the clock
NOISE = 0.2  # standard deviation of actions: the robots move, and do not fall at once
DRAWN = 16  # different actions, drawn in advance


@comparison("gpu", named=True)
def compare(effort: Effort) -> Findings:
    """Of the task of each robot whose physics costs most, and of trainings of the first task with a
    planning variant: first on the GPU, then on the CPU. Prints each figure when it has been
    measured. What fails is a note."""
    findings = Findings()
    try:
        torch_device(DEVICE)
    except TsbenchError as error:
        findings.notes.append(f"gpu: not measured, {error}")
        return findings
    findings.machine |= described(DEVICE)
    seconds = SHARE * effort.seconds
    rates_on = {
        DEVICE: partial(rates, device=DEVICE, counts=COUNTS, seconds=seconds),
        "cpu": partial(rates_on_cpu, count=effort.count, seconds=seconds),
    }
    for device, rates_of in rates_on.items():
        for robot, group in domains().items():
            subject = planned(group)
            with noted(findings, f"{robot} on {device}"):
                for name, figure in rates_of(richest(group)):
                    note(findings, f"{robot}.{name}", figure)
            if subject is not None:
                with noted(findings, f"{robot}, training on {device}"):
                    findings.add(trained(robot, subject.name, device, effort.iterations))
    return findings


@contextmanager
def noted(findings: Findings, what: str) -> Iterator[None]:
    """Makes a note of an error, so that the other figures are measured."""
    try:
        yield
    except TsbenchError as error:
        findings.notes.append(f"{what}: {error}")


def note(findings: Findings, name: str, figure: Range) -> None:
    findings.figures[name] = figure
    sys.stdout.write(f"{name}: {figure.median:,.0f} {figure.unit}\n")
    sys.stdout.flush()


def rates(
    task: Task[Any], device: str, counts: tuple[int, ...], seconds: float
) -> Iterator[tuple[str, Range]]:
    """Rates of physics and environment by number of worlds.

    Args:
        task: that is stepped.
        device: as in a run's configuration.
        counts: numbers of worlds.
        seconds: of measuring each figure.
    """
    where = torch_device(device)
    warp = import_module("tsbench.sim.warp")  # of an extra
    for count in counts:
        physics = warp.WarpPhysics(task, count, device=where, seed=0)
        environment = DeviceEnvironment(task, physics, count, 0, where)
        environment.reset()
        yield f"physics.{count}", rate(physics.worlds.step, count, seconds, where)
        environment.reset()
        drawn = NOISE * torch.randn(DRAWN, count, task.action_size, device=where)
        step = partial(act, environment, itertools.cycle(drawn))
        yield f"environment.{count}", rate(step, count, seconds, where)
        environment.check()


def rates_on_cpu(task: Task[Any], count: int, seconds: float) -> Iterator[tuple[str, Range]]:
    """The rate of the environment by C MuJoCo, of `count` episodes."""
    batch = BatchedEnvironment(task, Physics(task, count), count, 0)
    batch.reset()
    noise = np.random.default_rng(0).normal(0.0, NOISE, (DRAWN, count, task.action_size))
    step = partial(act, batch, itertools.cycle(noise))
    yield f"environment.{count}.cpu", rate(step, count, seconds, torch.device("cpu"))


def act(environment: Any, actions: Iterator[Any]) -> None:
    """A step with the next of the actions."""
    environment.step(next(actions))


def rate(step: Callable[[], Any], count: int, seconds: float, device: torch.device) -> Range:
    """Control steps per second of a function that makes one for each of `count` worlds."""
    for _ in range(CHUNK):  # the first calls compile, record and allocate
        step()
    found: list[float] = []
    began = time.perf_counter()
    while not found or time.perf_counter() - began < seconds:
        with finished(device):
            start = time.perf_counter()
            for _ in range(CHUNK):
                step()
        found.append(CHUNK * count / (time.perf_counter() - start))
    return Range.of(found, "steps/s")


@contextmanager
def finished(device: torch.device) -> Iterator[None]:
    """Waits at both ends until a GPU has done what it was asked for."""
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    wait()
    yield
    wait()


def trained(robot: str, name: str, device: str, iterations: int) -> Findings:
    """Rates and shares of the time of the stages of a training."""
    findings = Findings(machine={})
    problem = prepare(compose([f"task={name}", f"device={device}"]))
    for stage in ("plan", "imitate"):
        steps = settings(problem, stage).steps
        part = split(
            f"{robot}.{stage}.{device}", train(problem, stage, steps * (iterations + 1)), steps
        )
        findings.add(part)
        for figure in part.figures.items():
            note(findings, *figure)
        shares = ", ".join(f"{key}: {share.median:.0%}" for key, share in part.ratios.items())
        sys.stdout.write(f"{shares}\n")
    return findings
