"""EnvPool's Ant-v5, a fast CPU environment, against bare physics of the same model.

EnvPool 1.2.5 links its own MuJoCo 3.6. The bare physics uses tsbench's MuJoCo.
"""

from __future__ import annotations

import importlib
import os
from importlib.resources import files
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from tsbench.bench import Findings, comparison
from tsbench.bench.stepping import RECORDED, bare, full_states
from tsbench.bench.turns import Case, Effort, take_turns

ANT = "envs/mujoco/assets/ant.xml"  # in gymnasium; EnvPool's copy differs by a notice only
FRAME_SKIP = 5  # as in Ant-v5
SETTLE = 20  # control steps until the ants, which start in the air, are on the ground


@comparison("envpool", requires=("envpool",))
def compare(effort: Effort) -> Findings:
    rates = take_turns([rollout(effort.count), envpool(effort.count)], effort)
    return Findings(
        figures={f"ant.{name}": rates.range(name) for name in ("rollout", "envpool")},
        ratios={"ant.envpool/rollout": rates.ratio("envpool", "rollout")},
        notes=["ant: EnvPool steps its own MuJoCo, the bare rollout the one listed below"],
    )


def envpool(count: int) -> Case:
    """EnvPool's synchronous mode: all environments at once, on all cores."""
    module: Any = importlib.import_module("envpool")  # an extra
    pool = module.make_gymnasium("Ant-v5", num_envs=count, num_threads=os.cpu_count() or 1, seed=0)
    rng = np.random.default_rng(0)
    pool.reset()

    def steps() -> int:
        pool.step(rng.uniform(-1.0, 1.0, (count, 8)).astype(np.float32))
        return count

    return Case("envpool", steps)


def rollout(count: int) -> Case:
    """Bare physics from states that random actions lead to."""
    model = mujoco.MjModel.from_xml_path(str(files("gymnasium") / ANT))
    batch = Batch(model, count)
    rng = np.random.default_rng(0)
    batch.bind("qpos")[:] += rng.uniform(-0.1, 0.1, (count, model.nq))  # Ant-v5's start
    batch.bind("qvel")[:] = rng.normal(0.0, 0.1, (count, model.nv))
    recorded = []
    for step in range(SETTLE + RECORDED):
        state = full_states(batch)
        control = rng.uniform(-1.0, 1.0, (count, model.nu))
        batch.bind("ctrl")[:] = control
        batch.step(nstep=FRAME_SKIP)
        if step >= SETTLE:
            recorded.append((state, control))
    return bare("rollout", model, recorded, FRAME_SKIP)
