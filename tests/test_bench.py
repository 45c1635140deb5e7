"""The benchmarks in small: they measure the things that they name."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tsbench import bench, tasks
from tsbench.bench import Comparison, Findings, gpu, scaling, stepping, training
from tsbench.bench.domains import domains, planned, richest
from tsbench.bench.training import split
from tsbench.bench.turns import Case, Effort, Range, take_turns
from tsbench.cli import main
from tsbench.core import plugins
from tsbench.core.errors import TsbenchError
from tsbench.core.motion import ReferenceMotion
from tsbench.core.task import Plannable
from tsbench.rl.settings import PPOSettings
from tsbench.sim import gym, single
from tsbench.sim.tracking import Imitation


def outside(name: str, folder: str = "benchmarks") -> Any:
    """A module outside the package: a comparison, which is registered thereby, or another test."""
    spec = spec_from_file_location(name, Path(__file__).parents[1] / folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module


sb3, envpool = outside("against_sb3"), outside("against_envpool")
interfaces = outside("test_interfaces", "tests/tasks")
TINY = Effort(repeats=2, seconds=0.01, count=6, counts=(1, 3), iterations=1, budget="smoke")
ROBOT = max(domains())  # any robot
PARTS = ("physics", "mdp", "inference", "update", "records")


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("QUICK", "FULL"):
        monkeypatch.setattr(bench, name, TINY)
    monkeypatch.setattr(stepping, "RECORDED", 3)
    monkeypatch.setattr(sb3, "PATIENCE", 0.0)


@pytest.mark.parametrize("name", sorted({*bench.names()} - {"gpu"}))  # it has tests below
def test_every_comparison(name: str) -> None:
    """Comparisons whose packages are missing say so; the others measure something."""
    findings = bench.measure(name, quick=True)
    missing = [m for m in bench.find(name).requires if find_spec(m) is None]
    assert bool(findings.figures) != bool(missing)
    assert bool(findings.ratios) != bool(missing)
    for value in (*findings.figures.values(), *findings.ratios.values()):
        assert value.least <= value.median <= value.most
    assert all(value.median > 0.0 for value in findings.figures.values())
    for stage in {key.rpartition(".")[0] for key in findings.ratios if key.endswith("/whole")}:
        shares = [findings.ratios[f"{stage}.{part}/whole"].median for part in PARTS]
        assert sum(shares) == pytest.approx(1.0)
        assert (shares[0] > 0.0) == stage.endswith("imitate")  # planning has no physics


def test_only_other_packages_may_be_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "__path__", [*bench.__path__, str(tmp_path)])
    (tmp_path / "lacking.py").write_text("import a_package_that_nobody_has\n")
    assert bench.names.__wrapped__() == bench.names()
    (tmp_path / "broken.py").write_text("import tsbench.core.a_module_that_has_moved\n")
    with pytest.raises(ModuleNotFoundError, match="a_module_that_has_moved"):
        bench.names.__wrapped__()


def test_what_is_written_is_what_was_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bench.json"
    assert main(["bench", "--quick", "--only", ROBOT, "--json", str(file)]) == 0
    result = json.loads(file.read_text())
    assert {f"{ROBOT}.batched/rollout", f"{ROBOT}.batched/async"} <= result["ratios"].keys()
    for name, (least, most) in result["ranges"].items():
        assert least <= result["ratios"][name] <= most
    assert result["figures"][f"{ROBOT}.loop"]["unit"] == "steps/s"
    assert result["machine"]["cores"] >= 1
    shown = capsys.readouterr().out
    assert f"{ROBOT}.batched/rollout" in shown
    assert result["machine"]["mujoco"] in shown


def test_the_rival_is_given_our_settings(
    naive_reference: Callable[[str], ReferenceMotion],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Stable-Baselines3 with our network, encoding and falling learning rate; it logs nothing."""
    pytest.importorskip("stable_baselines3")
    logs = tmp_path / "logs"
    monkeypatch.setenv("SB3_LOGDIR", str(logs))
    task = planned(domains()[ROBOT])
    assert task is not None
    imitation = Imitation(task, naive_reference(task.name))
    chosen = PPOSettings(
        environments=2, rollout=8, epochs=1, minibatches=2, hidden=(5, 4), activation="elu",
        encoding="symlog", desired_kl=None, learning_rate=1e-3, final_learning_rate=1e-5, repeat=3,
    )  # fmt: skip
    rival = sb3.Rival(imitation, chosen, 0, steps=96)
    actor = rival.model.policy.mlp_extractor.policy_net
    assert [type(layer).__name__ for layer in actor] == ["Linear", "ELU", "Linear", "ELU"]
    assert [layer.out_features for layer in actor[::2]] == [5, 4]
    rates = []
    for _ in range(3):  # sixteen actions each, of three steps
        rival.model.learn(16, reset_num_timesteps=False)
        rates.append(rival.model.policy.optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-4, 1e-5, 1e-5])
    assert rival.steps == 144
    assert not logs.exists()
    far = np.full((1, imitation.observation_size), 1e6)
    assert np.all(np.isfinite(rival(far)))


def test_the_rival_holds_its_actions() -> None:
    """An action is held for four steps, or until the episode ends; missing steps earn nothing."""
    task = tasks.make("rocket_navigation", distance=3.0)
    plain, environment = (gym.GymEnvironment(single.environment(task)) for _ in range(2))
    held = sb3.Held(environment, 4)
    action = np.array([1.0, 0.0])
    plain.reset(seed=0)
    held.reset(seed=0)
    left = task.horizon
    while left > 0:
        steps = [plain.step(action) for _ in range(min(left, 4))]
        observation, reward, terminated, truncated, _ = held.step(action)
        np.testing.assert_array_equal(observation, steps[-1][0])
        assert reward == pytest.approx(sum(step[1] for step in steps) / 4)
        left -= 4
        assert (terminated, truncated) == (False, left <= 0)
    assert task.horizon % 4  # the last hold is cut short


def test_a_missing_package_is_named_and_the_rest_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    one = Findings(figures={"a": Range.of([1.0])})
    table = {
        "first": Comparison(lambda _: one, requires=("no_such_module",), named=False),
        "second": Comparison(lambda _: one, requires=("numpy",), named=False),
        "third": Comparison(lambda _: pytest.fail("was not named"), requires=(), named=True),
    }
    monkeypatch.setattr(bench, "_comparisons", table)
    monkeypatch.setattr(bench, "names", lambda: tuple(table))
    told: list[str] = []
    findings = bench.measure(tell=told.append)
    assert findings.notes == [
        "first: not measured, lacks no_such_module (pip install 'tsbench[bench]')"
    ]
    assert told == ["second"]
    assert findings.figures == one.figures


def test_the_measured_tasks_are_those_of_the_registry() -> None:
    """Every task that tsbench brings has a comparison of its robot; nothing lists names."""
    own = [name for name in tasks.names() if tasks.provider(name) == plugins.own()]
    found = domains()
    assert sorted(task.name for group in found.values() for task in group) == sorted(own)
    assert found.keys() <= set(bench.names())
    for group in found.values():
        assert len({task.spec().modelname for task in group}) == 1
        geoms = [task.spec().compile().ngeom for task in group]
        assert richest(group) == group[geoms.index(max(geoms))]
        with_plan = [task for task in group if isinstance(task, Plannable)]
        assert planned(group) == (with_plan[0] if with_plan else None)


def test_a_new_task_of_tsbench_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """A task of another robot, without a planning variant, brought by tsbench or by a plug-in."""
    monkeypatch.setattr(tasks, "_factories", {})
    monkeypatch.setattr(tasks, "provider", {"cart": plugins.own(), "sled": None}.get)

    def cart() -> Any:
        return interfaces.Cart()

    tasks.register("cart")(cart)
    tasks.register("sled")(cart)
    ((robot, group),) = domains().items()
    assert group == (interfaces.Cart(),)
    assert planned(group) is None
    assert training.compare(TINY).figures == {}
    assert scaling.compare(TINY).figures.keys() >= {f"{robot}.environments_1"}
    found = stepping.compare("cart", richest(group), TINY)
    assert found.figures.keys() == {
        f"cart.{case}" for case in ("rollout", "batched", "async", "loop")
    }
    assert found.ratios.keys() == {f"cart.batched/{case}" for case in ("rollout", "async", "loop")}


def test_unknown_comparison_is_refused() -> None:
    with pytest.raises(TsbenchError, match=f"did you mean '{ROBOT}'"):
        bench.measure(f"{ROBOT}s")


def test_cases_say_how_many_steps_they_did() -> None:
    task = richest(domains()[ROBOT])
    assert stepping.batched("batched", task, 6).steps() == 6
    assert stepping.rollout(task, 6).steps() == 6
    assert stepping.loop("loop", task).steps() == stepping.SINGLE_STEPS


def test_turns_are_taken_in_order_and_cases_closed() -> None:
    told: list[str] = []

    def case(name: str) -> Case:
        def steps() -> int:
            told.append(name)
            return 4

        return Case(name, steps, lambda: told.append(f"{name} closed"))

    rates = take_turns([case("a"), case("b")], Effort(2, 0.0, 1, (1,), 1, "smoke"))
    assert told[:2] == ["a", "b"]  # the first calls, which are not timed
    assert told[-2:] == ["a closed", "b closed"]
    assert rates.turns["a"].shape == (2,)
    expected = rates.turns["a"] / rates.turns["b"]
    assert rates.ratio("a", "b") == Range(np.median(expected), min(expected), max(expected))


def test_a_training_is_split_without_rest() -> None:
    """Iterations of 10 s and 20 s: 4 s and 12 s of physics, 1 s and 2 s of MDP math and so on."""
    times = {
        "seconds": (0.0, 10.0, 30.0),
        "collect_seconds": (99.0, 6.0, 16.0),
        "update_seconds": (99.0, 3.0, 3.0),
        "environment_seconds": (99.0, 5.0, 14.0),
        "physics_seconds": (99.0, 4.0, 12.0),
    }
    rows = [{name: values[i] for name, values in times.items()} for i in range(3)]
    findings = split("x", rows, 100)
    assert findings.figures == {"x": Range(7.5, 5.0, 10.0, "steps/s")}
    expected = {
        "physics": (0.4, 0.6), "mdp": (0.1, 0.1), "inference": (0.1, 0.1),
        "update": (0.15, 0.3), "records": (0.05, 0.1),
    }  # fmt: skip
    for part, (least, most) in expected.items():
        found = findings.ratios[f"x.{part}/whole"]
        assert (found.least, found.most) == pytest.approx((least, most))


def test_the_gpu_comparison_says_that_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    findings = bench.measure("gpu")
    assert not findings.figures
    (line,) = findings.notes
    assert line.startswith("gpu: not measured, device=cuda")
    assert "gpu" not in [name for name in bench.names() if not bench.find(name).named]


def _full() -> None:
    raise TsbenchError("no room for contacts")


def test_a_fault_on_a_gpu_leaves_the_other_figures() -> None:
    findings = Findings()
    with gpu.noted(findings, "laikago on cuda"):
        _full()
    assert findings.notes == ["laikago on cuda: no room for contacts"]


def test_rates_on_a_device_are_of_whole_environments(capsys: pytest.CaptureFixture[str]) -> None:
    task = tasks.make("rocket_obstacles")
    found = dict(gpu.rates(task, "warp", (2, 3), 0.01)) | dict(gpu.rates_on_cpu(task, 4, 0.01))
    names = [f"{kind}.{count}" for count in (2, 3) for kind in ("physics", "environment")]
    assert list(found) == [*names, "environment.4.cpu"]
    assert all(figure.least > 0.0 for figure in found.values())
    findings = Findings()
    gpu.note(findings, "rocket.physics.2", found["physics.2"])
    assert findings.figures["rocket.physics.2"].unit == "steps/s"
    assert capsys.readouterr().out.startswith("rocket.physics.2: ")
