"""Fixtures that many tests share: plans, reference motions and records made without training."""

from __future__ import annotations

import itertools
import os
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

# Set before numpy and torch are loaded, in the tests and in the commands that they start. Tests run
# in parallel, and threads that wait for each other's cores slow a small network down tenfold.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

from tsbench import tasks
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.evaluation.origin import Origin
from tsbench.evaluation.protocol import SMOKE
from tsbench.evaluation.robustness import Robustness, Surface
from tsbench.evaluation.score import Score, Summary
from tsbench.runs.directory import Record, Stage
from tsbench.testing.episodes import plan_of, reference_of
from tsbench.testing.rounding import perturbed

# The speed and the load of a machine are no property of the code.
settings.register_profile("any", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any")


_PROGRAM = """
import os, runpy, sys
os.chdir(folder)
for number, name in enumerate(("out", "err"), 1):
    os.dup2(os.open(f"{streams}/{name}", os.O_WRONLY | os.O_CREAT), number)
sys.path[:0] = path
sys.argv = ["tsbench", *words]
runpy.run_module("tsbench", run_name="__main__")
"""


class Forks:
    """Starts processes in which torch and rsl-rl, which take seconds to load, are loaded already,
    and nothing of tsbench.

    Attributes:
        context: of multiprocessing.
    """

    def __init__(self, folder: Path) -> None:
        self.context = get_context("forkserver")
        self.context.set_forkserver_preload(["torch", "tensordict", "rsl_rl.algorithms"])
        self._folder, self._numbers = folder, itertools.count()

    def start(self, folder: Path, *words: str, path: Sequence[Path] = ()) -> Any:
        """Starts `tsbench WORDS` in a folder, with what lies in `path` installed."""
        streams = self._folder / str(next(self._numbers))
        streams.mkdir()
        given = {
            "folder": folder, "words": words, "path": list(map(str, path)), "streams": streams,
        }  # fmt: skip
        process = self.context.Process(target=exec, args=(_PROGRAM, given))
        process.start()
        return process, streams

    def call(
        self, folder: Path, *words: str, path: Sequence[Path] = ()
    ) -> subprocess.CompletedProcess[str]:
        """Carries out `tsbench WORDS` in a folder. See `start`."""
        process, streams = self.start(folder, *words, path=path)
        process.join()
        out, err = ((streams / name).read_text() for name in ("out", "err"))
        return subprocess.CompletedProcess(words, process.exitcode, out, err)


@pytest.fixture(scope="session")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Forks:
    return Forks(tmp_path_factory.mktemp("forks"))


@pytest.fixture(scope="session", autouse=True)
def another_rounding() -> Iterator[None]:
    """TSBENCH_TEST_PERTURB=1e-6 perturbs all learners of the session by that much. Tests that pass
    only with one processor's rounding then fail."""
    size = float(os.environ.get("TSBENCH_TEST_PERTURB", "0"))
    with perturbed(size) if size else nullcontext():
        yield


@pytest.fixture(name="perturbed", scope="session")
def perturbed_fixture() -> Callable[[float], AbstractContextManager[None]]:
    return perturbed


@pytest.fixture(scope="session")
def naive_plan() -> Callable[[str], Plan]:
    """A function from a task's name to the plan of its hand-made planner."""
    return plan_of


@pytest.fixture(scope="session")
def naive_reference() -> Callable[[str], ReferenceMotion]:
    """A function from a task's name to its hand-made plan as full poses."""
    return reference_of


@pytest.fixture(name="invented_record", scope="session")
def invented_record_fixture() -> Callable[[str], Record]:
    """A function from a task's name to an invented content of score.json."""
    return _invented_record


def _invented_record(name: str) -> Record:
    task = tasks.make(name)
    nominal = Summary(
        episodes=1,
        normalized_reward=0.01,
        solved_reward=0.0,
        success=0.0,
        violations=0.25,
        steps=180.0,
        goal_distance=3.5,
        measures=dict.fromkeys(task.measure_notes, 0.5),
        solved=(0,),
    )
    perturbed = replace(
        nominal, episodes=100, steps=170.0, solved_reward=0.004, success=0.4,
        solved=(1,) * 40 + (0,) * 60,
    )  # fmt: skip
    score = Score(
        protocol=SMOKE.name,
        solved_reward=0.004,
        normalized_reward=0.01,
        success=0.4,
        against_plan=0.125,
        perturbed=perturbed,
        nominal=nominal,
        changes={"mass x 0.8": nominal},
        robustness=Robustness(
            survival_100N=0.25,
            recovery_100N=0.125,
            survival_impulse_50=7.5,
            survival_impulse_50_is_lower_bound=False,
            recovery_impulse_50=60.0,
            recovery_impulse_50_is_lower_bound=True,
            mass_scale=1.0,
            push_duration_s=0.1,
            surface=Surface(
                forces_N=(50.0, 100.0),
                headings_rad=(0.0, 1.5707963),
                phases=(30, 34, 38, 42),
                survived=(((1, 1, 1, 1), (1, 1, 1, 1)), ((1, 0, 1, 0), (0, 0, 0, 0))),
                recovered=(((1, 1, 1, 0), (1, 1, 1, 0)), ((1, 0, 0, 0), (0, 0, 0, 0))),
            ),
        ),
        origin=Origin.here(task, SMOKE, lambda observation: observation),
    )
    stage = Stage("plan", 1000, steps=1000, seconds=61.0)
    return Record(name, task.version, True, "twostage", 0, "smoke", score, (stage,))
