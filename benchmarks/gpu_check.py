"""Checks on a GPU what no machine without one can: recorded graphs, order of streams, no waiting.

    python3 benchmarks/gpu_check.py

* Planning on the GPU agrees with planning on the CPU, step for step, over whole episodes.
* Recorded graphs give what the functions give that they were recorded from: in planning the same
  bits, and nearly the same in some steps of the physics, which adds numbers in any order.
* Neither a step nor the learner's inference waits for the GPU.
* With `deterministic`, an interrupted learner goes on to the same bits where nothing touches: in
  planning, and with a rocket.

Exits with status 1 if a check fails.
"""

from __future__ import annotations

import os
import sys
import traceback
from argparse import ArgumentParser
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest import mock

import torch

from tsbench import tasks
from tsbench.core.task import Plannable
from tsbench.rl.devices import WORKSPACE, working_on
from tsbench.rl.ppo import Learner
from tsbench.rl.settings import PPOSettings
from tsbench.runs.checkpoint import decode, encode
from tsbench.sim.device import DeviceEnvironment, DeviceKinematics, Replayed
from tsbench.sim.kinematic import Planning
from tsbench.sim.warp import WarpPhysics
from tsbench.tasks.rocket import Rocket

GPU, CPU = torch.device("cuda", 0), torch.device("cpu")
ROWS, STEPS = 256, 200
PHYSICS_STEPS = 8  # few, because what a last bit changes grows
WITHIN = 1e-3  # of observations and rewards, in float32
PHYSICS_WITHIN = 5e-2  # the same; a wrong graph is off by far more


def planning(task: Any, device: torch.device, explore: float = 0.0) -> DeviceEnvironment[Any]:
    variant: Planning[Any] = Planning(task, explore=explore)
    dynamics = DeviceKinematics(variant, ROWS, 0, device)
    return DeviceEnvironment(variant, dynamics, ROWS, 0, device)


def physics(task: Any, *, deterministic: bool = False) -> DeviceEnvironment[Any]:
    dynamics: WarpPhysics[Any] = WarpPhysics(
        task, ROWS, device=GPU, pool=ROWS, deterministic=deterministic
    )
    return DeviceEnvironment(task, dynamics, ROWS, 0, GPU)


def played(environment: DeviceEnvironment[Any], steps: int) -> tuple[torch.Tensor, ...]:
    """Observations, rewards and endings under random walks, on the CPU."""
    rng = torch.Generator().manual_seed(1)
    size = environment.mdp.action_size
    drift = 2.0 * torch.rand(ROWS, size, generator=rng) - 1.0
    kept: list[tuple[torch.Tensor, ...]] = []
    environment.reset()
    for _ in range(steps):
        action = drift + 0.3 * torch.randn(ROWS, size, generator=rng)
        got = environment.step(action.to(environment.device))
        kept.append(
            (got.observation.cpu(), got.reward.cpu(), got.terminal.cpu(), got.truncated.cpu())
        )
    environment.check()
    return tuple(torch.stack(values) for values in zip(*kept, strict=True))


def call(self: Replayed, *arguments: Any) -> Any:
    """`Replayed.__call__` without a recorded graph."""
    return self._function(*arguments)


def agrees_with_the_cpu(task: Any) -> str:
    found, wanted = played(planning(task, GPU), STEPS), played(planning(task, CPU), STEPS)
    # An ending that float32 puts a step earlier shifts all that follows in its row.
    ends = [(one[2] | one[3]).int().cumsum(dim=0) for one in (found, wanted)]
    alike = (ends[0] == ends[1]).all(dim=0)
    worst = max(float((found[i] - wanted[i]).abs()[:, alike].max()) for i in (0, 1))
    assert worst < WITHIN, worst
    assert alike.float().mean() > 0.98, alike.float().mean()
    return f"off by {worst:.1e} at most; {int((~alike).sum())} of {ROWS} rows ended at other steps"


def graphs_equal_functions(
    make: Callable[[], DeviceEnvironment[Any]], steps: int, within: float
) -> str:
    replayed = played(make(), steps)
    with mock.patch.object(Replayed, "__call__", call):
        called = played(make(), steps)
    worst = max(float((replayed[i] - called[i]).abs().max()) for i in (0, 1))
    assert worst <= within, worst
    assert torch.equal(replayed[2], called[2])
    assert torch.equal(replayed[3], called[3])
    return f"off by {worst:.1e} at most; {int((called[2] | called[3]).sum())} endings"


def nothing_waits(make: Callable[[], DeviceEnvironment[Any]]) -> str:
    settings = PPOSettings(environments=ROWS, rollout=8, hidden=(64, 64), update="rsl_rl")
    learner = Learner(make(), settings, 0)
    learner.learn(settings.steps)  # records
    rollout, env = learner._rollout, learner._env
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        with torch.inference_mode():
            observation = env.get_observations()
            for _ in range(4):
                observation, rewards, dones, extras = env.step(rollout.act(observation))
                env.count(rewards, dones, extras)
                rewards += learner._credit(extras)
                rollout.add(rewards, dones, extras)
            rollout.finish(observation)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    rollout.storage.clear()
    learner.learn(3 * settings.steps)
    return "four steps of a rollout"


def resumes(make: Callable[[], DeviceEnvironment[Any]]) -> str:
    settings = PPOSettings(environments=ROWS, rollout=8, hidden=(64, 64), update="rsl_rl")
    with working_on(GPU, deterministic=True):
        whole, part = Learner(make(), settings, 0), Learner(make(), settings, 0)
        whole.learn(6 * settings.steps)
        part.learn(2 * settings.steps)
        rest = Learner(make(), settings, 1)
        rest.restore(decode(encode(part.snapshot())))
        rest.learn(6 * settings.steps)
    for name, weight in whole._actor.state_dict().items():
        assert torch.equal(weight, rest._actor.state_dict()[name]), name
    return "the same weights"


def main() -> int:
    # Before the first product of matrices, which `working_on` comes after.
    os.environ.setdefault(*WORKSPACE)
    ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    if not torch.cuda.is_available():
        sys.stderr.write("gpu_check: PyTorch finds no GPU here\n")
        return 2
    failed = 0
    seen: set[type] = set()  # the physics of one task of each kind is enough
    for name in tasks.names():
        task = tasks.make(name)
        checks: dict[str, Callable[[], str]] = {}
        if isinstance(task, Plannable):
            make = partial(planning, task, GPU, 0.5)
            checks["planning agrees with the CPU"] = partial(agrees_with_the_cpu, task)
            checks["graphs of planning"] = partial(graphs_equal_functions, make, STEPS, 0.0)
            checks["planning waits for nothing"] = partial(nothing_waits, make)
            checks["planning resumes to the same bits"] = partial(resumes, make)
        if type(task) not in seen:
            seen.add(type(task))
            make = partial(physics, task)
            checks["graphs of physics"] = partial(
                graphs_equal_functions, make, PHYSICS_STEPS, PHYSICS_WITHIN
            )
            checks["physics waits for nothing"] = partial(nothing_waits, make)
            if isinstance(task, Rocket):  # mujoco-warp orders contacts as they come
                make = partial(physics, task, deterministic=True)
                checks["physics resumes to the same bits"] = partial(resumes, make)
        for what, check in checks.items():
            try:
                said = f"ok, {check()}"
            except Exception:
                failed += 1
                said = f"FAILED\n{traceback.format_exc()}"
            sys.stdout.write(f"{name}: {what}: {said}\n")
            sys.stdout.flush()
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
