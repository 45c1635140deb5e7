"""The rollout and the update, compared with rsl-rl's PPO; the two updates, compared with each
other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from tsbench import tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.policy import ACTIVATIONS
from tsbench.rl.ppo import Learner
from tsbench.rl.rollout import Rollout
from tsbench.rl.settings import OPTIMIZERS, PPOSettings
from tsbench.rl.update import WIDE, Network, NumpyUpdate, RslUpdate, Update, make_update
from tsbench.runs.checkpoint import decode, encode
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.kinematic import Planning

ENVIRONMENTS, STEPS, OBSERVATIONS, ACTIONS = 32, 8, 5, 3
SMALL = PPOSettings(
    environments=ENVIRONMENTS, rollout=STEPS, epochs=3, hidden=(16, 8), desired_kl=None
)


class Subject:
    """Networks and a rollout storage, reproducible from the seed."""

    def __init__(self, settings: PPOSettings = SMALL, seed: int = 0) -> None:
        torch.manual_seed(seed)
        steps = torch.zeros(ENVIRONMENTS, OBSERVATIONS)
        observation = TensorDict({"policy": steps}, batch_size=[ENVIRONMENTS])
        groups = {"actor": ["policy"], "critic": ["policy"]}
        shared: dict[str, Any] = {
            "hidden_dims": settings.hidden, "activation": settings.activation,
            "obs_normalization": True,
        }  # fmt: skip
        normal = {"class_name": "GaussianDistribution", "init_std": 0.7, "std_type": "log"}
        self.actor = MLPModel(
            observation, groups, "actor", ACTIONS, **shared, distribution_cfg=normal
        )
        self.critic = MLPModel(observation, groups, "critic", 1, **shared)
        self.storage = RolloutStorage("rl", ENVIRONMENTS, STEPS, observation, [ACTIONS])
        self.rollout = Rollout(
            self.actor, self.critic, self.storage, discount=0.99, gae_lambda=0.95,
            normalise=not settings.minibatch_advantages,
        )  # fmt: skip

    def collect(self, seed: int) -> None:
        """Collects enough steps for one update."""
        rollout = self.rollout
        fill(
            rollout.act,
            lambda _, rewards, dones, extras: rollout.add(rewards, dones, extras),
            rollout.finish,
            seed,
        )

    def weights(self) -> dict[str, np.ndarray]:
        return {
            f"{name}.{key}": value.detach().numpy().astype(float).copy()
            for name, model in (("actor", self.actor), ("critic", self.critic))
            for key, value in model.state_dict().items()
        }


def fill(
    act: Callable[..., torch.Tensor],
    add: Callable[..., None],
    finish: Callable[..., None],
    seed: int,
    time_outs: bool = False,
) -> None:
    """Fills a storage with random steps, reproducible from the seed."""
    torch.manual_seed(seed)
    with torch.inference_mode():
        for _ in range(STEPS):
            steps = torch.randn(ENVIRONMENTS, OBSERVATIONS)
            observation = TensorDict({"policy": steps}, batch_size=[ENVIRONMENTS])
            actions = act(observation)
            rewards = torch.randn(ENVIRONMENTS) + actions.sum(dim=-1) * steps[:, 0]
            dones = torch.rand(ENVIRONMENTS) < 0.1
            late = dones & (torch.rand(ENVIRONMENTS) < 0.5)
            add(observation, rewards, dones, {"time_outs": late.float()} if time_outs else {})
        finish(observation)


@pytest.mark.parametrize("time_outs", [False, True])
@pytest.mark.parametrize("normalise", [False, True])
def test_steps_are_collected_as_by_rsl_rl(time_outs: bool, normalise: bool) -> None:
    """The stored tensors are equal to the last bit."""
    settings = replace(SMALL, minibatch_advantages=not normalise)
    ours, theirs = Subject(settings), Subject(settings)
    ppo = PPO(
        theirs.actor, theirs.critic, theirs.storage, gamma=0.99, lam=0.95,
        normalize_advantage_per_mini_batch=not normalise,
    )  # fmt: skip
    add = ours.rollout.add
    fill(ours.rollout.act, lambda _, *step: add(*step), ours.rollout.finish, 1, time_outs)
    fill(ppo.act, ppo.process_env_step, ppo.compute_returns, 1, time_outs)
    kept, wanted = vars(ours.storage), vars(theirs.storage)
    tensors = [name for name, value in wanted.items() if isinstance(value, torch.Tensor)]
    assert {"rewards", "values", "returns", "advantages", "actions_log_prob"} <= set(tensors)
    for name in tensors:
        assert torch.equal(kept[name], wanted[name]), name
        assert wanted[name].abs().sum() > 0, name
    assert torch.equal(kept["observations"]["policy"], wanted["observations"]["policy"])
    for own, other in zip(kept["distribution_params"], wanted["distribution_params"], strict=True):
        assert torch.equal(own, other)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        *({"activation": name} for name in ACTIVATIONS),
        {"entropy": 0.3},
        {"value_weight": 0.2, "gradient_norm": 0.05},
        {"gradient_norm": 100.0},
        {"clip_value": True, "clip": 0.05, "learning_rate": 1e-2},
        {"clip": 0.02, "learning_rate": 1e-2},
        {"desired_kl": 0.01},
        {"desired_kl": 1e-3},
        {"desired_kl": 10.0},
        {"minibatches": 7},  # which leaves steps over
    ],
    ids=str,
)
def test_both_updates_are_the_same(changes: dict[str, Any]) -> None:
    """Two updates of twelve gradient steps: weights, losses, rate and normalisers are equal within
    a thousandth of the distance that the weights move."""
    settings = replace(SMALL, **changes)
    subjects = [Subject(settings) for _ in range(2)]
    ours, theirs = updates = tuple(
        make_update(subject.actor, subject.critic, subject.storage, replace(settings, update=name))
        for name, subject in zip(("numpy", "rsl_rl"), subjects, strict=True)
    )
    for seed in (1, 2):
        before = subjects[1].weights()
        for subject in subjects:
            subject.collect(seed + 10)
        losses = []
        for update in updates:
            torch.manual_seed(seed)
            losses.append(update.update())
        assert losses[0]["value"] == pytest.approx(losses[1]["value"], rel=1e-4)
        assert losses[0]["surrogate"] == pytest.approx(losses[1]["surrogate"], rel=1e-3, abs=1e-5)
        assert ours.learning_rate == pytest.approx(theirs.learning_rate)
        after, wanted = (subject.weights() for subject in subjects)
        assert after.keys() == wanted.keys()
        for name, value in wanted.items():
            moved = np.abs(value - before[name]).max()
            assert moved > 0.0
            np.testing.assert_allclose(after[name], value, atol=1e-3 * moved, err_msg=name)


def test_the_value_s_gradient_passes_within_the_clip(monkeypatch: pytest.MonkeyPatch) -> None:
    """There the clipped error is the error but for rounding, which must not decide."""
    settings = replace(SMALL, clip_value=True, update="numpy")
    subject = Subject(settings)
    update = make_update(subject.actor, subject.critic, subject.storage, settings)
    assert isinstance(update, NumpyUpdate)
    rng = np.random.default_rng(0)
    now, share = rng.uniform(-1.0, 1.0, (2, 1000, 1)).astype(np.float32)
    error = (rng.choice([-1.0, 1.0], now.shape) * rng.uniform(0.5, 1.0, now.shape)).astype(
        now.dtype
    )
    change, far = np.float32(0.9 * settings.clip) * share, np.float32(0.4) * np.sign(error)
    passed: list[np.ndarray] = []
    value = SimpleNamespace(forward=lambda _: now, backward=passed.append, step=lambda _: None)
    monkeypatch.setattr(update, "_value", value)
    update._update_value(now, now - error, now - change)
    np.testing.assert_allclose(passed[0], 2.0 * error / len(error), rtol=1e-3, atol=1e-8)
    # Beyond the range it passes only where the clipped error is the smaller one.
    update._update_value(now, now - error, now - far)
    np.testing.assert_allclose(passed[1], passed[0])
    update._update_value(now, now - error, now + far)
    np.testing.assert_array_equal(passed[2], 0.0)


def test_rsl_rls_update_is_its_ppo() -> None:
    """The results are equal to the last bit, with every setting passed on."""
    settings = replace(
        SMALL, epochs=2, minibatches=3, clip=0.1, clip_value=True, entropy=0.2, learning_rate=2e-3,
        desired_kl=0.003, value_weight=0.7, gradient_norm=0.3, optimizer="adamw",
        minibatch_advantages=True,
    )  # fmt: skip
    ours, theirs = Subject(settings), Subject(settings)
    update = RslUpdate(ours.actor, ours.critic, ours.storage, settings)
    ppo = PPO(
        theirs.actor, theirs.critic, theirs.storage, num_learning_epochs=2, num_mini_batches=3,
        clip_param=0.1, use_clipped_value_loss=True, entropy_coef=0.2, learning_rate=2e-3,
        schedule="adaptive", desired_kl=0.003, value_loss_coef=0.7, max_grad_norm=0.3,
        optimizer="adamw", normalize_advantage_per_mini_batch=True,
    )  # fmt: skip
    for subject in (ours, theirs):
        subject.collect(1)
    torch.manual_seed(2)
    losses = update.update()
    torch.manual_seed(2)
    assert losses == ppo.update()
    np.testing.assert_equal(ours.weights(), theirs.weights())
    assert update.learning_rate == ppo.learning_rate != 2e-3


@pytest.mark.parametrize("seed", [0, 1])
def test_whole_trainings_are_the_same(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Five iterations in which rate and standard deviation fall: weights are equal within a
    thousandth of the distance that they move. rsl-rl's update draws actions without using them, so
    the generator is seeded again after each update."""
    settings = replace(
        SMALL, learning_rate=3e-4, final_learning_rate=1e-4, initial_std=0.8, final_std=0.6,
        clip_value=True, entropy=0.01,
    )  # fmt: skip
    planning: Planning[Any] = Planning(tasks.make("rocket_navigation", distance=3.0), explore=0.5)

    def trained(update: str, iterations: int) -> tuple[list[np.ndarray], list[dict[str, float]]]:
        environment = BatchedEnvironment(planning, planning, ENVIRONMENTS, seed)
        learner = Learner(environment, replace(settings, update=update), seed)
        once = learner._update.update

        def seeded() -> dict[str, float]:
            losses = once()
            torch.manual_seed(learner.steps + seed)
            return losses

        monkeypatch.setattr(learner._update, "update", seeded)
        reports: list[dict[str, float]] = []
        learner.learn(iterations * settings.steps, lambda _, row: reports.append(dict(row)))
        policy = learner.policy(planning.task, "test")
        return [policy.mean, policy.scale, *policy.weights, *policy.biases], reports

    begun, _ = trained("numpy", 0)
    (ours, reports), (theirs, wanted) = trained("numpy", 5), trained("rsl_rl", 5)
    for own, other, first in zip(ours, theirs, begun, strict=True):
        moved = np.abs(other - first).max()
        assert moved > 0.0
        np.testing.assert_allclose(own, other, atol=1e-3 * moved)
    for mine, its in zip(reports, wanted, strict=True):
        for name in ("value_loss", "learning_rate", "std"):
            assert mine[name] == pytest.approx(its[name], rel=1e-3), name


@pytest.mark.parametrize(
    "changes",
    [{"update": "numpy"}, *({"update": "rsl_rl", "optimizer": name} for name in OPTIMIZERS)],
    ids=str,
)
def test_an_update_goes_on_from_a_snapshot(changes: dict[str, Any]) -> None:
    """A snapshot is encoded, decoded and restored into an update that has other moments and
    rate."""
    settings = replace(SMALL, desired_kl=1e-5, **changes)
    subjects = [Subject(settings, seed) for seed in (0, 5)]
    updates = [make_update(s.actor, s.critic, s.storage, settings) for s in subjects]
    for subject, update in zip(subjects, updates, strict=True):
        subject.collect(1)
        update.update()
    updates[1].learning_rate = 0.5
    updates[1].restore(decode(encode(updates[0].snapshot())))
    assert updates[1].learning_rate == updates[0].learning_rate < settings.learning_rate
    subjects[1].actor.load_state_dict(subjects[0].actor.state_dict())
    subjects[1].critic.load_state_dict(subjects[0].critic.state_dict())
    for subject, update in zip(subjects, updates, strict=True):
        subject.collect(2)
        update.update()
    np.testing.assert_equal(subjects[0].weights(), subjects[1].weights())
    assert updates[0].learning_rate == updates[1].learning_rate


def chosen(**changes: Any) -> type[Update]:
    settings = replace(SMALL, **changes)
    subject = Subject(settings)
    return type(make_update(subject.actor, subject.critic, subject.storage, settings))


def test_which_update_is_taken() -> None:
    assert chosen() is NumpyUpdate
    assert chosen(hidden=(8, WIDE - 1)) is NumpyUpdate
    assert chosen(hidden=(8, WIDE)) is RslUpdate
    assert chosen(hidden=(8, WIDE), update="numpy") is NumpyUpdate
    assert chosen(optimizer="sgd") is RslUpdate
    assert chosen(minibatch_advantages=True) is RslUpdate
    assert chosen(update="rsl_rl") is RslUpdate


def test_numpy_works_on_the_cpu_only() -> None:
    subject = Subject()
    subject.storage.device = "cuda:0"
    with pytest.raises(TsbenchError, match="update: numpy works on the CPU, not on cuda:0"):
        make_update(subject.actor, subject.critic, subject.storage, replace(SMALL, update="numpy"))


def test_nothing_is_built_that_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []
    optimizer, network = torch.optim.Adam.__init__, Network.__init__

    def adam(self: Any, *arguments: Any, **options: Any) -> None:
        built.append("optimizer")
        optimizer(self, *arguments, **options)

    def numpy(self: Any, *arguments: Any) -> None:
        built.append("network")
        network(self, *arguments)

    monkeypatch.setattr(torch.optim.Adam, "__init__", adam)
    monkeypatch.setattr(Network, "__init__", numpy)
    planning: Planning[Any] = Planning(tasks.make("rocket_navigation"))
    for update, parts in (("numpy", ["network", "network"]), ("rsl_rl", ["optimizer"])):
        built.clear()
        settings = replace(SMALL, update=update)
        Learner(BatchedEnvironment(planning, planning, ENVIRONMENTS, 0), settings, 0).learn(1)
        assert built == parts
