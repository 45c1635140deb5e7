"""The devices to learn on: what is refused, and a stage on a torch device."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tsbench import tasks
from tsbench.core.errors import NotFiniteError, TsbenchError
from tsbench.core.method import Budget, Problem
from tsbench.rl import devices
from tsbench.rl.ppo import Learner
from tsbench.rl.settings import PPOSettings
from tsbench.rl.stages import learn_planning, settings
from tsbench.rl.vec_env import TensorEnvironment, TorchEnvironment
from tsbench.runs.checkpoint import decode, encode
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.device import DeviceEnvironment, DeviceKinematics
from tsbench.sim.disturbed import Disturbances
from tsbench.sim.kinematic import Planning
from tsbench.sim.warp import WarpPhysics
from tsbench.testing.operations import WAITING, Operations

CPU = torch.device("cpu")
ROWS, SEED = 16, 3
SETTINGS = PPOSettings(
    environments=ROWS, rollout=8, minibatches=2, epochs=2, hidden=(16,), update="rsl_rl"
)


def planning(name: str = "laikago_trot", explore: float = 0.5) -> DeviceEnvironment[Any]:
    variant: Planning[Any] = Planning(tasks.make(name), explore=explore)
    dynamics = DeviceKinematics(variant, ROWS, SEED, CPU, pool=32)
    return DeviceEnvironment(variant, dynamics, ROWS, SEED, CPU)


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the extra `gpu` were installed, on a machine without a GPU."""
    monkeypatch.setattr(devices, "find_spec", lambda name: object())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.mark.usefixtures("here")
def test_a_machine_without_a_gpu() -> None:
    assert devices.pick() == "cpu"
    assert devices.torch_device("cpu") == devices.torch_device("warp") == CPU
    with pytest.raises(TsbenchError, match="torch finds no GPU here; allowed: cpu, warp"):
        devices.torch_device("cuda")


@pytest.mark.usefixtures("here")
def test_a_gpu_that_there_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert devices.pick() == "cuda"
    assert devices.torch_device("cuda") == torch.device("cuda:0")
    assert devices.torch_device("cuda:1") == torch.device("cuda:1")
    monkeypatch.setenv("LOCAL_RANK", "1")  # the second process that torchrun has started
    assert devices.torch_device("cuda") == torch.device("cuda:1")
    with pytest.raises(TsbenchError, match="no such GPU here; allowed: cuda:0, cuda:1"):
        devices.torch_device("cuda:2")


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "find_spec", lambda name: None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert devices.pick() == "cpu"
    for name in ("cuda", "warp"):
        with pytest.raises(TsbenchError, match="needs mujoco_warp, warp: pip install"):
            devices.torch_device(name)


def test_the_update_off_the_cpu_is_rsl_rls() -> None:
    task = tasks.make("rocket_navigation")
    problem = Problem(task, Budget(1, 1), {}, {}, seed=0, threads=1, device="warp")
    assert settings(problem, "plan").update == "rsl_rl"
    assert settings(replace(problem, device="cpu"), "plan").update == "auto"
    asked = replace(problem, training={"plan": {"update": "numpy"}})
    with pytest.raises(TsbenchError, match="numpy works in one process on the CPU, not on warp"):
        settings(asked, "plan")


def test_actions_are_held_as_in_numpy() -> None:
    """Rewards, endings and figures of the two faces agree while actions are held."""
    variant: Planning[Any] = Planning(tasks.make("rocket_navigation"))
    host = TorchEnvironment(BatchedEnvironment(variant, variant, ROWS, 0), "symlog", repeat=3)
    device = TensorEnvironment(planning("rocket_navigation", 0.0), "symlog", repeat=3)
    rng = torch.Generator().manual_seed(0)
    drift = torch.rand(ROWS, 3, generator=rng) * 2.0 - 1.0
    for _ in range(130):
        actions = drift + 0.2 * torch.randn(ROWS, 3, generator=rng)
        wanted, found = host.step(actions), device.step(actions)
        for name in ("policy", "value"):
            torch.testing.assert_close(found[0][name], wanted[0][name], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(found[1], wanted[1], atol=1e-4, rtol=1e-4)
        assert torch.equal(found[2], wanted[2])
        for name, values in wanted[3].items():
            torch.testing.assert_close(found[3][name], values, atol=1e-4, rtol=1e-4)
        for face, (_, rewards, dones, extras) in ((host, wanted), (device, found)):
            face.count(rewards, dones, extras)
    # The device's are of all episodes, which are fewer here than the recent ones.
    assert 0 < len(host._returns) < 100
    figures, expected = device.finished(), host.finished()
    assert figures["episode_length"] == pytest.approx(expected["episode_length"])
    assert figures["episode_return"] == pytest.approx(expected["episode_return"], rel=1e-4)
    assert device.finished() == figures


def physics() -> DeviceEnvironment[Any]:
    """On mujoco-warp, with pushes that grow with the steps taken and actions that come late."""
    task = tasks.make("laikago_walk")
    disturb = Disturbances(push=50.0, rise=400, interval=0.2, mass=0.2, latency=2)
    dynamics: WarpPhysics[Any] = WarpPhysics(
        task, ROWS, device=CPU, disturbances=disturb, seed=SEED, pool=32, deterministic=True
    )
    return DeviceEnvironment(task, dynamics, ROWS, SEED, CPU)


@pytest.mark.parametrize("make", [planning, physics])
def test_an_interrupted_learner_goes_on_to_the_same_bits(
    make: Callable[[], DeviceEnvironment[Any]],
) -> None:
    whole = Learner(make(), SETTINGS, SEED)
    whole.learn(6 * SETTINGS.steps)
    part = Learner(make(), SETTINGS, SEED)
    part.learn(2 * SETTINGS.steps)
    snapshot = decode(encode(part.snapshot()))
    rest = Learner(make(), SETTINGS, SEED + 1)
    rest.restore(snapshot)
    rest.learn(6 * SETTINGS.steps)
    for name, weight in whole._actor.state_dict().items():
        assert torch.equal(weight, rest._actor.state_dict()[name]), name
    assert whole._env.finished() == rest._env.finished()


@pytest.mark.parametrize("make", [planning, physics])
def test_collecting_steps_never_waits_for_the_device(
    make: Callable[[], DeviceEnvironment[Any]],
) -> None:
    learner = Learner(make(), SETTINGS, SEED)
    rollout, env = learner._rollout, learner._env
    with torch.inference_mode():
        observation, rewards, dones, extras = env.step(rollout.act(env.get_observations()))
        rollout.add(rewards, dones, extras)
        with Operations() as seen:
            observation, rewards, dones, extras = env.step(rollout.act(observation))
            env.count(rewards, dones, extras)
            rewards += learner._credit(extras)
            rollout.add(rewards, dones, extras)
    assert "mul" in seen.names
    assert not seen.names & WAITING


def test_a_number_that_is_not_finite_ends_the_learning() -> None:
    learner = Learner(planning(), SETTINGS, SEED)
    with torch.no_grad():
        learner._actor.mlp[-1].bias[0] = torch.nan
    with pytest.raises(NotFiniteError, match="action of environment 0 was not finite"):
        learner.learn(SETTINGS.steps)


class Desk:
    """A workspace that keeps what is reported."""

    directory = Path()

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self.saved = None
        self.physics_substeps = 0
        self.warnings: dict[str, int] = {}

    @contextmanager
    def stage(self, name: str, steps: int) -> Any:
        yield self

    def update(self, steps: int, metrics: Any, snapshot: Any = None) -> None:
        self.rows.append({"steps": steps, **metrics})

    def note(self, line: str) -> None: ...


def test_a_planning_stage_learns_on_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "find_spec", lambda name: object())
    task = tasks.make("rocket_navigation")
    training = {"plan": {"environments": 64, "rollout": 16, "hidden": [32], "encoding": "symlog"}}
    problem = Problem(task, Budget(1, 1), training, {}, seed=0, threads=1, device="warp")
    desk = Desk()
    learner = learn_planning(problem, desk, 64 * 16 * 12, explore=0.5)
    assert learner.steps == 64 * 16 * 12
    assert isinstance(learner.environment, DeviceEnvironment)
    returns = [row["episode_return"] for row in desk.rows if "episode_return" in row]
    assert returns
    assert np.isfinite(returns).all()
    seconds = desk.rows[-1]
    assert 0.0 < seconds["physics_seconds"] < seconds["environment_seconds"]
    assert seconds["environment_seconds"] < seconds["collect_seconds"]
    action = learner.policy(task, "twostage")(np.zeros((2, 7)))
    assert action.shape == (2, 3)
