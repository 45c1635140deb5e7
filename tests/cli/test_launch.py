"""Sweeps through a launcher that starts its jobs in other processes, as plug-ins of Hydra do."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tsbench.cli.launch import directory
from tsbench.runs import config

WORDS = [
    "task=rocket_navigation",
    "budget=smoke",
    "method=monolithic",
    "threads=1",
    "task.budgets.smoke.act=512",
    "task.constants.distance=6.0",
    "seed=0,1",
]
RAY = "TSBENCH_TEST_RAY"  # set to test with Ray, in an environment that has hydra-ray-launcher
POLICY = "policy.safetensors"


def start(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """`tsbench run` in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "tsbench", "run", *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The second job of the sweeps, run by itself."""
    folder = tmp_path_factory.mktemp("alone")
    done = start(folder, *WORDS[:-1], "seed=1", "directory=run")
    assert done.returncode == 0, done.stderr
    return folder / "run"


@pytest.mark.parametrize(
    ("launcher", "words"),
    [
        ("joblib", ("hydra.launcher.n_jobs=2",)),
        ("ray", ("+hydra.launcher.ray.init.num_cpus=2",)),
    ],
)
def test_jobs_in_other_processes(
    launcher: str, words: Sequence[str], alone: Path, tmp_path: Path
) -> None:
    """A job finishes with its pages and with the bits of a run alone, and the error of the failed
    one is reported."""
    if launcher == "joblib":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs tsbench[joblib]")
    if launcher == "ray" and not os.environ.get(RAY):
        pytest.skip(f"{RAY} is not set: Ray takes 360 MB and older packages than constraints.txt")
    jobs = [[*WORDS[:-1], f"seed={seed}"] for seed in (0, 1)]
    places = [str(directory(config.compose(job), job)) for job in jobs]
    (tmp_path / places[0]).mkdir(parents=True)
    (tmp_path / places[0] / "notes.txt").touch()

    sweep = ("-m", f"hydra/launcher={launcher}", *words, *WORDS)
    done = start(tmp_path, *sweep)
    line = f"{places[0]} holds other files and nothing is overwritten: "
    assert done.returncode == 2
    assert line in done.stderr.splitlines()[-1]
    finished = tmp_path / places[1]
    assert (finished / "score.json").exists()
    assert (finished / "report.html").exists()
    assert (finished / POLICY).read_bytes() == (alone / POLICY).read_bytes()
