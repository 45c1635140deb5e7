"""Sweeps through a launcher that starts its jobs in other processes, as plug-ins of Hydra do."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
PLUGIN = """
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.config_store import ConfigStore


@dataclass
class Config:
    _target_: str = "hydra_plugins.elsewhere.Elsewhere"


class Elsewhere(BasicLauncher):
    def launch(self, job_overrides, initial_job_idx):
        with ProcessPoolExecutor(1, get_context("fork")) as pool:
            return pool.submit(
                BasicLauncher.launch, self, job_overrides, initial_job_idx
            ).result()


ConfigStore.instance().store(group="hydra/launcher", name="elsewhere", node=Config)
"""


def test_jobs_in_another_process(tmp_path: Path) -> None:
    """All jobs finish with their pages, and the error of the failed one is reported."""
    plugins = tmp_path / "plugins"
    (plugins / "hydra_plugins").mkdir(parents=True)
    (plugins / "hydra_plugins" / "elsewhere.py").write_text(PLUGIN)
    words = [[*WORDS[:-1], f"seed={seed}"] for seed in (0, 1)]
    places = [str(directory(config.compose(one), one)) for one in words]
    (tmp_path / places[0]).mkdir(parents=True)
    (tmp_path / places[0] / "notes.txt").touch()
    path = os.pathsep.join([str(plugins), *sys.path])
    done = subprocess.run(
        [sys.executable, "-m", "tsbench", "run", "-m", "hydra/launcher=elsewhere", *WORDS],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    line = f"tsbench: {places[0]} holds other files and nothing is overwritten: "
    assert (done.returncode, done.stderr.splitlines()[-1][: len(line)]) == (2, line)
    assert (tmp_path / places[1] / "score.json").exists()
    assert (tmp_path / places[1] / "report.html").exists()
