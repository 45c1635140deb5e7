"""Threads: one while networks learn, and the former number afterwards."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import numpy, torch
from threadpoolctl import threadpool_info, threadpool_limits

def threads():
    blas = [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]
    return torch.get_num_threads(), max(blas)

torch.set_num_threads(3)
threadpool_limits(2, user_api="blas")
import tsbench.bench, tsbench.rl.stages, tsbench.runs.execute
print(*threads())

from tsbench import tasks
from tsbench.rl.ppo import Learner
from tsbench.rl.settings import PPOSettings
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.kinematic import Planning

class Watched(Planning):
    def begin(self, rng, rows):
        print(*threads())
        return super().begin(rng, rows)

planning = Watched(tasks.make("rocket_navigation"))
environment = BatchedEnvironment(planning, planning, 4, 0)
learner = Learner(environment, PPOSettings(environments=4, rollout=4, minibatches=2), 0)
print(*threads())
learner.learn(16, lambda steps, metrics: print(*threads()))
print(*threads())
"""


def test_networks_learn_on_one_thread() -> None:
    """An import changes no limit. A learner is made and trained on one thread; then the former
    limits are restored."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["3 2", "1 1", "3 2", "1 1", "3 2"]
