"""That a beginner's first run learns what the README says: nothing shorter shows that it does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from tsbench import config, run
from tsbench.evaluation.protocol import V1


def test_the_rocket_learns_to_fly_to_its_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seeds 0 to 4 all solve the task from 100 of 100 starts (docs/calibration.md)."""
    words = ["task=rocket_navigation", "method=twostage", "budget=fast", "threads=1"]
    chosen = replace(config.compose(words), directory=str(tmp_path / "run"))
    # All pushes at once reserve 15 GB of address space, beside which other tests cannot fork.
    monkeypatch.setattr(run, "V1", replace(V1, conditions=(), phases=8, forces=(100.0,)))
    score = run.execute(chosen, words, Console(quiet=True))
    assert score.success == 1.0
    assert score.perturbed.success >= 0.9
    assert score.robustness.survival_100N >= 0.9
