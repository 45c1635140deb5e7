"""The methods, end to end with tiny budgets: their results can be read back and scored."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest

from tsbench import TsbenchError, methods, tasks
from tsbench.core.method import Budget, Problem
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.plugins import Plugin, Provider
from tsbench.core.policy import Policy, PolicyInfo
from tsbench.core.task import plannable
from tsbench.evaluation.evaluate import check_fit
from tsbench.methods import twostage
from tsbench.rl import stages
from tsbench.rl.stages import settings
from tsbench.runs.config import compose
from tsbench.runs.execute import prepare
from tsbench.sim.kinematic import Planning
from tsbench.sim.tracking import Imitation
from tsbench.tasks.laikago import Laikago
from tsbench.testing import MethodContract
from tsbench.testing.contracts import Desk, bits
from tsbench.testing.episodes import plannable_tasks

ENVIRONMENTS, ROLLOUT = 8, 8
TRAINING = {
    kind: {"rollout": ROLLOUT, "epochs": 1, "minibatches": 2, "hidden": [16]}
    for kind in ("plan", "imitate", "task")
}


class TestMethods(MethodContract):
    names = methods.names()
    task = "rocket_obstacles"
    constants: ClassVar[dict[str, float]] = {"distance": 5.0}


def problem(task_name: str, seed: int = 0, constants: Any = None, **options: Any) -> Problem:
    task = tasks.make(task_name, **(constants or {}))
    return Problem(
        task, Budget(192, 128, ENVIRONMENTS, audit="warn"), TRAINING, options, seed, threads=1
    )


@pytest.mark.parametrize("name", plannable_tasks())
def test_twostage(name: str, tmp_path: Path) -> None:
    desk, given = Desk(tmp_path), problem(name, name="twostage")
    policy = methods.find("twostage").train(given, desk)
    task = plannable(given.task)
    assert desk.stages == [("plan", 192), ("imitate", 128)]
    assert desk.reports == {"plan": [64, 128, 192], "imitate": [64, 128]}
    assert desk.substeps == {"plan": 0, "imitate": 128 * task.substeps}

    plan = Plan.load(tmp_path / "plan.npz")
    abstraction = task.abstraction()
    assert (plan.task, plan.task_version) == (name, task.version)
    assert plan.timestep == abstraction.timestep
    assert plan.states.shape[1] == len(abstraction.coordinates)
    np.testing.assert_array_equal(plan.states[0], abstraction.flatten(abstraction.start(1))[0])
    reference = ReferenceMotion.load(tmp_path / "reference.npz")
    assert reference.duration <= plan.times[-1] + 1e-9
    assert Imitation(task, reference).horizon >= 1
    # Each failed item of the audit is shown to the user, where it does not stop the run.
    audit = task.audit(plan, reference)
    if audit.passed:
        assert desk.notes == ["plan audit: passed"]
    else:
        assert desk.notes == [f"plan audit: {item}" for item in audit.failures]

    check_fit(policy, task)
    assert policy.info.method == "twostage"
    policy.save(tmp_path)
    again = Policy.load(tmp_path)
    assert bits(again) == bits(policy)
    observation = np.random.default_rng(0).normal(size=(5, task.observation_size))
    np.testing.assert_array_equal(again(observation), policy(observation))
    files = ["plan.npz", "policy.json", "policy.safetensors", "reference.npz"]
    assert sorted(file.name for file in tmp_path.iterdir()) == files


@pytest.mark.parametrize("name", tasks.names())
def test_monolithic(name: str, tmp_path: Path) -> None:
    """The method uses the budget of all stages together and returns only a policy."""
    desk, given = Desk(tmp_path), problem(name)
    policy = methods.find("monolithic").train(given, desk)
    assert desk.stages == [("train", 320)]
    assert desk.reports == {"train": [64, 128, 192, 256, 320]}
    assert desk.substeps == {"train": 320 * given.task.substeps}
    check_fit(policy, given.task)
    assert policy.info.method == "monolithic"
    assert not list(tmp_path.iterdir())
    policy.save(tmp_path)
    assert bits(Policy.load(tmp_path)) == bits(policy)


@pytest.mark.parametrize("method", methods.names())
def test_other_bits_under_another_seed(method: str, tmp_path: Path) -> None:
    results = []
    for seed in (1, 2):
        given = problem("rocket_obstacles", seed, constants={"distance": 5.0})
        results.append(bits(methods.find(method).train(given, Desk(tmp_path))))
    assert results[0] != results[1]


def test_finetuning(tmp_path: Path) -> None:
    """A last stage on the task's own reward, paid from the physics budget."""
    desk = Desk(tmp_path)
    twostage.train(problem("laikago_walk", finetune=0.5), desk)
    assert desk.stages == [("plan", 192), ("imitate", 64), ("finetune", 64)]
    assert desk.substeps["finetune"] == 64 * 20


def test_stages_after_the_imitation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first still earns the imitation's reward, the second the task's own, and each goes on
    with the policy of the one before."""
    seen: list[tuple[type, Any]] = []

    def learn(*given: Any) -> Any:
        seen.append((type(given[3]), given[6] if len(given) > 6 else None))
        learners.append(original(*given))
        return learners[-1]

    learners: list[Any] = []
    original = stages.learn_physics
    monkeypatch.setattr(stages, "learn_physics", learn)
    desk = Desk(tmp_path)
    twostage.train(problem("laikago_walk", settle=0.25, finetune=0.25), desk)
    assert desk.stages == [("plan", 192), ("imitate", 64), ("settle", 32), ("finetune", 32)]
    assert seen == [(Imitation, None), (Imitation, learners[0]), (Laikago, learners[1])]


def test_a_failed_audit_stops_the_run(tmp_path: Path) -> None:
    """The plan of 192 steps does not arrive, so the run stops before physics, unless it is told to
    go on or the budget is too small for any plan."""
    given = problem("rocket_navigation", constants={"distance": 60.0})
    strict = replace(given, budget=replace(given.budget, audit="stop"))
    desk = Desk(tmp_path)
    with pytest.raises(TsbenchError, match=r"fails its audit: .* or go on with method\.audit=warn"):
        twostage.train(strict, desk)
    assert [stage for stage, _ in desk.stages] == ["plan"]
    assert (tmp_path / "plan.npz").exists()
    desk = Desk(tmp_path)
    twostage.train(replace(strict, options={"audit": "warn"}), desk)
    assert [stage for stage, _ in desk.stages] == ["plan", "imitate"]
    assert desk.notes
    assert all(note.startswith("plan audit: ") for note in desk.notes)
    with pytest.raises(TsbenchError, match="the plan fails its audit"):
        twostage.train(replace(given, options={"audit": "stop"}), Desk(tmp_path))


def test_the_papers_imitation_reward(tmp_path: Path) -> None:
    """Another form of the reward trains another policy from the same plan."""
    forms: list[Any] = [None, "progress", "paper"]
    results = []
    for form in forms:
        given = problem("rocket_navigation", constants={"distance": 5.0}, imitation=form)
        results.append(bits(twostage.train(given, Desk(tmp_path))))
    assert results[0] == results[1] != results[2]


def test_the_plan_is_one_deterministic_episode() -> None:
    """The plan of a policy that always flies up and to the left, out of the world."""
    task = tasks.make("rocket_navigation")
    planning = Planning(task)

    class Always(Policy):
        def __call__(self, observation: np.ndarray) -> np.ndarray:
            return np.tile([-1.0, 0.4, 0.0], (len(observation), 1))

    info = PolicyInfo(task.name, task.version, "", "", "elu", (7, 3))
    plan = twostage.extract(planning, Always(info, np.zeros(7), np.ones(7), (), ()))
    # 0.25 m to the left per step: -10 m after 40 steps, and out of the world in the 41st.
    assert plan.states.shape == (42, 3)
    assert plan.rewards.shape == (41,)
    np.testing.assert_allclose(plan.states[:, 0], -0.25 * np.arange(42))
    np.testing.assert_allclose(plan.states[:, 1], 0.1 * np.arange(42))


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("twostage", {"finetun": 0.1}, r"unknown key in method 'finetun'.*did you mean 'finetune'"),
        ("twostage", {"finetune": 1.0}, r"method.finetune must lie in \[0, 1\)"),
        ("twostage", {"finetune": "half"}, r"method.finetune must be a number"),
        ("twostage", {"settle": -0.1}, r"method.settle must lie in \[0, 1\)"),
        ("prm", {"settle": 0.5, "finetune": 0.5}, r"settle and finetune must leave a share"),
        ("twostage", {"audit": "skip"}, r"method.audit must be stop, warn or null, not skip"),
        ("twostage", {"explore": -0.1}, r"method.explore must lie in \[0, 1\]"),
        ("twostage", {"imitation": "papr"}, r"'papr'.*allowed: paper, progress"),
        ("monolithic", {"finetune": 0.1}, r"unknown key in method 'finetune'"),
    ],
)
def test_options_that_make_no_sense(
    method: str, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(TsbenchError, match=message):
        methods.find(method).train(problem("rocket_navigation", **options), Desk(tmp_path))


def test_stages_of_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """A method can have its own kinds of stages; kinds of no method are refused."""
    distilled = ModuleType("distilled")
    vars(distilled).update(Options=Nothing, train=lambda *_: None, STAGES=("distill",))
    monkeypatch.setitem(sys.modules, "distilled", distilled)
    found, _ = methods._found()
    plugin = Plugin("distilled", "distilled", Provider("distilled", "distilled", "1.0"))
    given = compose(["task=rocket_navigation"])

    def prepared(method: str, **training: Any) -> Problem:
        changed = replace(given.task, training={**given.task.training, **training})
        return prepare(replace(given, task=changed, method={"name": method}))

    with pytest.raises(TsbenchError, match=r"unknown key in task\.training 'distill'; allowed: "):
        prepared("twostage", distill={"clip": 0.3})
    both = {**found, "distilled": {"distilled": plugin}}
    monkeypatch.setattr(methods, "_found", lambda: (both, ()))
    for method in ("distilled", "twostage"):
        ready = prepared(method, distill={"clip": 0.3})
        assert settings(ready, "distill").clip == 0.3
    with pytest.raises(TsbenchError, match=r"task\.training\.distill 'cilp'.*mean 'clip'"):
        prepared("distilled", distill={"cilp": 0.3})
    with pytest.raises(TsbenchError, match=r"task\.training 'distil';.*mean 'distill'") as caught:
        prepared("distilled", distil={})
    assert "\n" not in str(caught.value)
    del vars(distilled)["STAGES"]
    assert methods.stages("distilled") == ()


@dataclass(frozen=True)
class Nothing:
    """A method without options."""


def test_no_such_method() -> None:
    with pytest.raises(TsbenchError, match=r"unknown method 'twostag'.*did you mean 'twostage'\?"):
        methods.find("twostag")
