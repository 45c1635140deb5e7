from __future__ import annotations

import json
from pathlib import Path

import pytest

from tsbench import bench, tasks
from tsbench.cli import main
from tsbench.errors import TsbenchError


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "QUICK_REPEATS", 2)
    monkeypatch.setattr(bench, "QUICK_SECONDS", 0.01)
    monkeypatch.setattr(bench, "COUNT", 8)
    monkeypatch.setattr(bench, "RECORDED", 4)


def test_ratios_are_those_of_the_medians(tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    assert main(["bench", "--quick", "--only", "rocket", "--json", str(file)]) == 0
    result = json.loads(file.read_text())
    rates = {name: rate["median"] for name, rate in result["rates"].items()}
    assert set(rates) == {f"rocket.{case}" for case in ("batched", "rollout", "planning", "loop")}
    for ratio, value in result["ratios"].items():
        over, under = ratio.removeprefix("rocket.").split("/")
        assert value == pytest.approx(rates[f"rocket.{over}"] / rates[f"rocket.{under}"])
    for rate in result["rates"].values():
        assert 0.0 < rate["least"] <= rate["median"] <= rate["most"]


def test_every_case_says_how_many_steps_it_did() -> None:
    task = tasks.make("laikago_trot")
    for make in (bench.batched, bench.rollout, bench.planning):
        assert make(task, 8).steps() == 8
    assert bench.loop(task).steps() == 16


def test_unknown_domain_is_refused() -> None:
    with pytest.raises(TsbenchError, match="did you mean 'rocket'"):
        bench.measure(only="rockt")
