"""mujoco's warnings: counted, not written, and unchanged outside the simulations of tsbench."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

from tsbench.sim.quiet import Quiet

# A program that steps two robots, one of which is too fast to be computed.
BATCH = """
import mujoco, numpy
from tsbench import tasks
from tsbench.sim.physics import Physics
assert mujoco.get_mju_user_warning() is None, "an import has replaced the handler"
heard = []
if {own}:
    mujoco.set_mju_user_warning(heard.append)
before = mujoco.get_mju_user_warning()
task = tasks.make("laikago_trot")
physics = Physics(task, 2, threads=2)
state = physics.begin(numpy.random.default_rng(0), numpy.arange(2))
physics.batch.qvel[1] = 1e9
physics.advance(state, numpy.zeros((2, 12)))
assert physics.warned() == {{"mjWARN_BADQACC": 1}}
assert mujoco.get_mju_user_warning() is before
assert not heard
"""
ONE = """
import numpy
from tsbench import tasks
from tsbench.sim.single import environment
alone = environment(tasks.make("laikago_trot"), 0)
alone.reset()
alone.physics.data.qvel[:] = 1e9
assert alone.step(numpy.zeros(12)).last()
"""
AFTERWARDS = """
data = mujoco.MjData(model := task.spec().compile())
data.qvel[:] = 1e9
mujoco.mj_step(model, data)
assert heard, "its own simulations are still heard of"
"""


@pytest.mark.parametrize(
    "program",
    [BATCH.format(own=False), BATCH.format(own=True) + AFTERWARDS, ONE],
    ids=["batch", "batch of one who listens", "one"],
)
def test_nothing_is_written(program: str, tmp_path: Path) -> None:
    """No warning on the error stream or in a file, where mujoco's own handler would write it."""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not list(tmp_path.iterdir())


def test_the_last_one_puts_the_handler_back() -> None:
    before, quiet = mujoco.get_mju_user_warning(), Quiet()
    with quiet:
        during = mujoco.get_mju_user_warning()
        assert during is not before
        with quiet:
            assert mujoco.get_mju_user_warning() is during
        assert mujoco.get_mju_user_warning() is during
    assert mujoco.get_mju_user_warning() is before
