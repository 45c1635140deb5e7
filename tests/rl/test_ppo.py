"""The learner: reproducible bits under a seed, counted steps, and learning progress."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch

from tsbench import TsbenchError, tasks
from tsbench.core.errors import NotFiniteError
from tsbench.core.method import Budget, Problem, Workspace
from tsbench.core.motion import ReferenceMotion
from tsbench.core.policy import ENCODINGS, Policy
from tsbench.rl.ppo import Learner
from tsbench.rl.settings import AFTER_IMITATION, PPOSettings
from tsbench.rl.stages import StageSettings, learn_planning, settings
from tsbench.rl.vec_env import TorchEnvironment
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.disturbed import Disturbances, DisturbedPhysics
from tsbench.sim.episodes import play
from tsbench.sim.kinematic import Planning
from tsbench.sim.physics import Physics
from tsbench.sim.tracking import Imitation

TINY = PPOSettings(environments=8, rollout=16, epochs=2, minibatches=2, hidden=(16,))


def planning(distance: float = 3.0) -> Planning[Any]:
    return Planning(tasks.make("rocket_navigation", distance=distance))


def learner(
    chosen: PPOSettings = TINY, seed: int = 0, subject: Any = None, **options: Any
) -> Learner:
    subject = subject or planning()
    dynamics = subject
    if not isinstance(subject, Planning):
        dynamics = Physics(subject, chosen.environments, threads=1)
    environment = BatchedEnvironment(subject, dynamics, chosen.environments, seed)
    return Learner(environment, chosen, seed, **options)


def bits(policy: Policy) -> bytes:
    arrays = (policy.mean, policy.scale, *policy.weights, *policy.biases)
    return b"".join(array.tobytes() for array in arrays)


def trained(steps: int, seed: int = 0, subject: Any = None) -> Policy:
    subject = subject or planning()
    taught = learner(seed=seed, subject=subject)
    taught.learn(steps)
    return taught.policy(getattr(subject, "task", subject), "test")


@pytest.mark.parametrize("kind", ["planning", "task", "imitation"])
def test_the_same_bits_under_a_seed(
    kind: str, naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    name = "laikago_trot"
    task = tasks.make(name)
    subjects = {
        "planning": planning(),
        "task": task,
        "imitation": Imitation(task, naive_reference(name)),
    }
    first, second, other = (trained(256, seed, subjects[kind]) for seed in (3, 3, 4))
    assert bits(first) == bits(second)
    assert bits(first) != bits(other)
    assert bits(first) != bits(trained(0, 3, subjects[kind]))


def test_steps_are_counted() -> None:
    """Learning runs in whole iterations of 8 environments x 16 steps."""
    taught = learner()
    reports: list[tuple[int, Mapping[str, float]]] = []
    taught.learn(129, lambda steps, metrics: reports.append((steps, dict(metrics))))
    assert [steps for steps, _ in reports] == [128, 256]
    assert taught.steps == 256
    taught.learn(256)
    assert taught.steps == 256
    taught.learn(257, lambda steps, metrics: reports.append((steps, dict(metrics))))
    assert reports[-1][0] == taught.steps == 384
    for _, metrics in reports:
        assert all(math.isfinite(value) for value in metrics.values())
        assert metrics["std"] > 0.0
        assert metrics["learning_rate"] > 0.0
        # 3 m: 0.52 s to fly and half as long again, 0.78 s, are 15 planning steps.
        assert metrics["episode_length"] == 15.0
        assert 0.0 < metrics["episode_return"] < 15 * 0.9
        assert metrics["normalized_return"] == metrics["episode_return"] / (15 * 0.9)


@pytest.mark.parametrize("update", ["numpy", "rsl_rl"])
def test_rate_and_spread_fall_over_a_stage(update: str) -> None:
    """Both fall by equal factors: in four iterations the rate falls from 1e-3 to 1e-5."""
    settings = replace(
        TINY,
        desired_kl=None,
        final_learning_rate=1e-5,
        initial_std=0.8,
        final_std=0.05,
        update=update,
    )
    taught = learner(settings)
    reports: list[Mapping[str, float]] = []
    taught.learn(512, lambda _, metrics: reports.append(metrics))
    rates = [metrics["learning_rate"] for metrics in reports]
    np.testing.assert_allclose(rates, 1e-3 * 10.0 ** (-0.5 * np.arange(1, 5)))
    assert taught._actor.distribution.log_std_param.max().exp().item() <= 0.05 + 1e-6


def test_planning_is_one_course_of_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes begin at sampled states in the first half of the steps; rates fall once."""
    explored: list[tuple[int, float]] = []
    begin, reports = Planning.begin, []  # type: ignore[var-annotated]

    def began(self: Planning[Any], rng: np.random.Generator, rows: np.ndarray) -> Any:
        explored.append((len(reports), self.explore))
        return begin(self, rng, rows)

    monkeypatch.setattr(Planning, "begin", began)

    class Scribe:
        saved = None

        def update(self, steps: int, metrics: Mapping[str, float], _: Any) -> None:
            reports.append((steps, metrics["learning_rate"]))

    class Desk:
        stage = staticmethod(lambda name, steps: nullcontext(Scribe()))

    changes = {
        "environments": 8, "rollout": 16, "minibatches": 2, "hidden": [16], "desired_kl": None,
        "final_learning_rate": 1e-5,
    }  # fmt: skip
    given = replace(
        problem(plan=changes), task=tasks.make("rocket_navigation", distance=3.0), seed=1
    )
    learn_planning(given, cast(Workspace, Desk()), 4 * 128, explore=0.75)
    assert [steps for steps, _ in reports] == [128, 256, 384, 512]
    np.testing.assert_allclose(
        [rate for _, rate in reports], 1e-3 * 10.0 ** (-0.5 * np.arange(1, 5))
    )
    shares = [{share for done, share in explored if done == number} for number in range(4)]
    assert shares == [{0.75}, {0.75}, {0.0}, {0.0}]


def test_weights_that_blow_up_are_noticed_at_once() -> None:
    """The error comes before the next action is drawn, and it holds the arrays."""
    taught = learner(replace(TINY, desired_kl=None, learning_rate=1e20))
    with pytest.raises(NotFiniteError, match="in the iteration after 0 steps") as caught:
        taught.learn(512)
    assert caught.value.arrays


def test_physics_steps_are_counted() -> None:
    task = tasks.make("laikago_walk")
    physics = Physics(task, 8, threads=1)
    Learner(BatchedEnvironment(task, physics, 8, 0), TINY, 0).learn(128)
    assert physics.substeps == 128 * 20


def mean_return(subject: Planning[Any], policy: Policy) -> float:
    return float(play(subject, subject, policy, 1, seed=0).returns[0])


def test_it_learns_to_fly_to_a_goal() -> None:
    """The goal is 3 m away. The return rises from about that of standing still by at least half of
    what it can rise.

    Of 18 trainings, seeds 0 to 5 each with weights perturbed by 0, 1e-6 and 2e-6, the worst rose by
    95.6 % of that.
    """
    subject = planning()
    chosen = PPOSettings(
        environments=64, rollout=15, hidden=(32,), discount=0.95, learning_rate=3e-3,
        desired_kl=0.05,
    )  # fmt: skip
    taught = learner(chosen, subject=subject)
    before = mean_return(subject, taught.policy(subject.task, "test"))
    taught.learn(30_000)
    after = mean_return(subject, taught.policy(subject.task, "test"))
    still = 15 * 0.9 * math.exp(-0.75)  # 3 m away
    # 0.25 m per step and axis: 11 steps along, 6 up.
    best = sum(
        0.9 * math.exp(-0.25 * math.hypot(max(2.598 - 0.25 * k, 0), max(1.5 - 0.25 * k, 0)))
        for k in range(1, 16)
    )
    assert before < still + 1.0
    assert after > still + 0.5 * (best - still)
    assert after <= best + 1e-3


def test_the_first_actions_are_the_nominal_pose() -> None:
    subject = tasks.make("laikago_walk")
    policy = trained(0, subject=subject)
    observation = np.random.default_rng(0).normal(size=(50, 43))
    assert np.abs(policy(observation)).max() < 0.05


def test_going_on_with_another_reward() -> None:
    """The actor and both normalisers are copied; critic weights and noise are new."""
    first = learner(subject=tasks.make("rocket_navigation", distance=3.0))
    first.learn(512)
    second = learner(
        PPOSettings(environments=8, rollout=16, epochs=2, minibatches=2, hidden=(16,),
                    initial_std=0.25),
        seed=9, subject=tasks.make("rocket_navigation", distance=3.0), actor_from=first,
    )  # fmt: skip
    task = tasks.make("rocket_navigation", distance=3.0)
    assert bits(second.policy(task, "test")) == bits(first.policy(task, "test"))
    reports: list[float] = []
    second.learn(128, lambda _, metrics: reports.append(metrics["std"]))
    assert reports[0] == pytest.approx(0.25, abs=0.05)
    assert second.steps == 128
    assert bits(second.policy(task, "test")) != bits(first.policy(task, "test"))


def test_going_on_under_other_disturbances() -> None:
    """A critic that is told of more or less than the one before learns its normaliser anew."""
    task = tasks.make("rocket_navigation", distance=3.0)
    first = learner(subject=task)
    first.learn(128)
    physics = DisturbedPhysics(task, 8, Disturbances(latency=1), 0, threads=1)
    second = Learner(BatchedEnvironment(task, physics, 8, 0), TINY, 0, first)
    assert bits(second.policy(task, "test")) == bits(first.policy(task, "test"))
    second.learn(128)
    assert second.steps == 128


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_artefact_is_the_actor(encoding: str) -> None:
    taught = learner(replace(TINY, encoding=encoding))
    taught.learn(256)
    policy = taught.policy(tasks.make("rocket_navigation", distance=3.0), "test")
    assert policy.info.layers == (7, 16, 3)
    assert (policy.info.task, policy.info.method) == ("rocket_navigation", "test")
    environment = TorchEnvironment(cast(Any, taught.environment), encoding)
    actor = taught._actor
    actor.eval()
    with torch.inference_mode():
        expected = actor(environment.get_observations()).clamp(-1.0, 1.0).numpy()
    observation = taught.environment.mdp.observation(taught.environment.state)
    np.testing.assert_allclose(policy(observation), expected, atol=1e-6)


def test_what_rsl_rl_sees() -> None:
    """Tensors are float32, time-outs differ from terminal states, and steps share no memory."""
    subject = planning()
    environment = TorchEnvironment(BatchedEnvironment(subject, subject, 2, 0))
    first = environment.get_observations()
    assert (environment.num_envs, environment.num_actions) == (2, 3)
    assert environment.max_episode_length == subject.horizon == 15
    assert first["policy"].shape == (2, 7)
    assert first["policy"].dtype == torch.float32
    kept = first["policy"].clone()
    # The first rocket stands. The second starts 1.4 m from the border and leaves in the sixth step.
    actions = torch.tensor([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    environment.environment.state = environment.environment.state.replace(
        position=np.array([[0.0, 0.0], [-8.6, 0.0]])
    )
    for step in range(1, 16):
        observation, reward, done, extras = environment.step(actions)
        assert reward.dtype == torch.float32
        assert observation["value"].shape[0] == 2
        assert done.tolist() == [int(step == 15), int(step == 6)]
        assert extras["time_outs"].tolist() == [float(step == 15), 0.0]
        # The next episode of the second one has nine steps, of 0.25 m each.
    assert torch.equal(first["policy"], kept)
    assert environment.episode_length_buf.tolist() == [0, 9]


def test_held_actions() -> None:
    """Three steps an action. One episode leaves the world in the second step of an action. The next
    one stands still in the third step, without reward. Another ends with the first step."""
    subject = planning()
    plain, held = (BatchedEnvironment(subject, subject, 2, 0) for _ in range(2))
    stepped, environment = TorchEnvironment(plain), TorchEnvironment(held, repeat=3)
    for batch in (plain, held):  # at -10 m, the border, in the fifth step
        position = np.array([[0.0, 0.0], [-8.85, 0.0]])
        batch.state = batch.state.replace(position=position)
    actions = torch.tensor([[0.5, 0.5, 0.0], [-1.0, 0.0, 0.0]])
    rewards = torch.stack([stepped.step(actions)[1] for _ in range(3)]).sum(dim=0)
    _, reward, done, _ = environment.step(actions)
    torch.testing.assert_close(reward, rewards / 3)
    assert done.tolist() == [0, 0]
    _, reward, done, extras = environment.step(actions)
    alive = torch.stack([stepped.step(actions)[1] for _ in range(2)])[:, 1].sum()
    torch.testing.assert_close(reward[1], alive / 3)
    assert (done.tolist(), extras["time_outs"].tolist()) == ([0, 1], [0.0, 0.0])
    np.testing.assert_array_equal(held.state.position[1], [0.0, 0.0])
    assert environment.episode_length_buf.tolist() == [6, 1]
    held.steps[0] = 14  # its last step is the first of the hold
    *_, done, extras = environment.step(actions)
    assert (done.tolist(), extras["time_outs"].tolist()) == ([1, 0], [1.0, 0.0])


def test_held_actions_are_counted_as_steps() -> None:
    """An iteration has 8 environments x 16 actions x 3 steps; the discount is per step."""
    taught = learner(replace(TINY, repeat=3, discount=0.9))
    reports: list[tuple[int, Mapping[str, float]]] = []
    taught.learn(385, lambda steps, metrics: reports.append((steps, dict(metrics))))
    assert [steps for steps, _ in reports] == [384, 768]
    assert reports[-1][1]["episode_length"] == 15.0
    assert taught._rollout._discount == pytest.approx(0.729)


@pytest.mark.parametrize(
    ("discount", "repeat", "spared", "credit"),
    [
        (0.9, 1, 0.0, 0.0),
        (0.9, 1, 2.0, 0.9 + 0.81),
        (0.9, 2, 4.0, 0.81 + 0.6561),  # two decisions, of two steps each
        (1.0, 1, 7.0, 7.0),
    ],
)
@pytest.mark.parametrize("quality", [1.0, 0.25])
def test_an_arrival_is_worth_what_its_footfall_says(
    discount: float, repeat: int, spared: float, credit: float, quality: float
) -> None:
    """What perfect steps would be, times the quality."""
    near = Planning(tasks.make("laikago_walk", distance=0.3))
    taught = learner(replace(TINY, discount=discount, repeat=repeat), subject=near)
    arrived = {"spared": torch.tensor([spared]), "quality": torch.tensor([quality])}
    expected = [near.max_reward * quality * credit]
    np.testing.assert_allclose(taught._credit(arrived), expected, rtol=1e-6)


def test_a_learner_is_told_of_arrivals(monkeypatch: pytest.MonkeyPatch) -> None:
    """And its reports have the same return as a score: steps after the goal, at their worth."""
    near = Planning(tasks.make("laikago_walk", distance=0.12))  # 2 cm to where the goal begins
    monkeypatch.setattr(near, "quality", lambda course: np.full(len(course.violated), 0.25))
    taught = learner(replace(TINY, discount=0.9, bootstrap=False), subject=near)
    told: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]] = []
    earned: list[torch.Tensor] = []
    step, add = taught._env.step, taught._rollout.add

    def stepped(actions: torch.Tensor) -> Any:
        given = step(actions)
        earned.append(given[1].clone())
        return given

    def added(rewards: torch.Tensor, dones: torch.Tensor, extras: Any) -> None:
        assert "time_outs" not in extras
        told.append((rewards.clone(), dones, extras["spared"], extras["quality"]))
        add(rewards, dones, extras)

    monkeypatch.setattr(taught._env, "step", stepped)
    monkeypatch.setattr(taught._rollout, "add", added)
    taught.learn(1024)
    arrivals, returns, running = 0, [], np.zeros(8)
    for own, (rewards, dones, spared, quality) in zip(earned, told, strict=True):
        assert (quality[spared > 0] == 0.25).all()
        credit = quality * 0.9 * (1.0 - 0.9**spared) / 0.1
        torch.testing.assert_close(rewards, own + credit)
        assert not (spared > 0)[dones == 0].any()
        arrivals += int((spared > 0).sum())
        running += (own + near.max_reward * quality * spared).numpy()
        returns += running[dones == 1].tolist()
        running[dones == 1] = 0.0
    assert arrivals > 8
    np.testing.assert_allclose(list(cast(Any, taught._env)._returns), returns[-100:], rtol=1e-5)


# Settings


def problem(environments: int | None = None, **training: Any) -> Problem:
    task = tasks.make("rocket_navigation")
    return Problem(task, Budget(1, 1, environments), training, {}, seed=0, threads=1)


def test_settings() -> None:
    assert settings(problem(), "plan") == StageSettings()
    chosen = settings(problem(plan={"hidden": [32, 16], "discount": 1, "desired_kl": None}), "plan")
    assert chosen.hidden == (32, 16)
    assert (chosen.discount, chosen.desired_kl) == (1.0, None)
    assert settings(problem(plan={"entropy": 0.5}), "task") == StageSettings()
    for asked, given in ((999, 16), (8, 8), (None, 16)):
        plan = {} if asked is None else {"environments": asked}
        assert settings(problem(16, plan=plan), "plan").environments == given
    assert settings(problem(4096), "plan").environments == StageSettings.environments
    # Fine-tuning continues with the network of the imitation stage.
    both = problem(imitate={"hidden": [8], "entropy": 0.1}, finetune={"entropy": 0.2})
    assert settings(both, "finetune") == StageSettings(hidden=(8,), entropy=0.2)


@pytest.mark.parametrize(
    "other", [{"hidden": [9]}, {"activation": "tanh"}, {"encoding": "symlog"}], ids=str
)
@pytest.mark.parametrize("kind", AFTER_IMITATION)
def test_a_stage_goes_on_with_the_network_that_there_is(kind: str, other: dict[str, Any]) -> None:
    (name,) = other
    with pytest.raises(TsbenchError, match=rf"^task\.training\.{kind}\.{name} must be that of imi"):
        settings(problem(None, **{"imitate": {"hidden": [8]}, kind: other}), kind)
    assert settings(problem(None, **{"imitate": other, kind: other}), kind)


def test_finetuning_is_pushed_as_hard_as_the_imitation_was_in_the_end() -> None:
    pushed = {"disturb": {"push": 300.0, "rise": 10_000, "calm": 0.2}}
    assert settings(problem(imitate=pushed), "imitate").disturb == Disturbances(300.0, 10_000, 0.2)
    assert settings(problem(imitate=pushed), "finetune").disturb == Disturbances(300.0, 0, 0.2)
    changed = problem(imitate=pushed, finetune={"disturb": {"calm": 0.5, "mass": 0.1}})
    assert settings(changed, "finetune").disturb == Disturbances(300.0, 0, 0.5, mass=0.1)
    again = problem(imitate=pushed, finetune={"disturb": {"rise": 5_000}})
    assert settings(again, "finetune").disturb.rise == 5_000
    longer = problem(imitate=pushed, finetune={"disturb": {"duration": 1.5}})
    with pytest.raises(TsbenchError, match=r"training\.finetune\.disturb\.duration .* interval"):
        settings(longer, "finetune")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"entropi": 0.1}, r"task.training.plan.*'entropi'.*did you mean 'entropy'"),
        ({"entropy": "much"}, r"task.training.plan.entropy must be a number, not 'much'"),
        ({"rollout": 1.5}, r"task.training.plan.rollout must be a whole number, not 1.5"),
        ({"hidden": 64}, r"task.training.plan.hidden must be a list"),
        ({"hidden": [64, "a"]}, r"task.training.plan.hidden\[1\] must be a whole number"),
        ({"hidden": []}, "hidden"),
        ({"hidden": [0]}, "hidden"),
        ({"bootstrap": 1}, r"task.training.plan.bootstrap must be true or false"),
        ({"environments": 0}, r"environments must be at least 1, not 0"),
        ({"rollout": 0}, r"rollout must be at least 1"),
        ({"epochs": -1}, r"epochs must be at least 1"),
        ({"minibatches": 0}, r"minibatches must be at least 1"),
        ({"environments": 2, "rollout": 2, "minibatches": 5}, "minibatches"),
        ({"learning_rate": 0.0}, r"learning_rate must be positive"),
        ({"learning_rate": float("nan")}, r"learning_rate must be positive"),
        ({"initial_std": -1.0}, r"initial_std must be positive"),
        ({"discount": 1.01}, r"discount must lie in \[0, 1\]"),
        ({"gae_lambda": -0.1}, r"gae_lambda must lie in \[0, 1\]"),
        ({"activation": "selu"}, r"activation must be one of elu, relu, tanh"),
        ({"final_learning_rate": 1e-4}, "final_learning_rate needs desired_kl: null"),
        ({"final_learning_rate": 1.0, "desired_kl": None}, "final_learning_rate must be positive"),
        ({"encoding": "log"}, r"encoding must be one of plain, symlog"),
        ({"clip": -0.2}, r"clip"),
        ({"desired_kl": 0.0}, r"desired_kl"),
        ({"entropy": float("inf")}, r"entropy"),
        ({"value_weight": -1.0}, r"value_weight"),
        ({"update": "torch"}, r"plan\.update must be one of auto, numpy, rsl_rl"),
        ({"optimizer": "lion"}, r"plan\.optimizer must be one of adam, adamw, rmsprop, sgd"),
        (
            {"update": "numpy", "optimizer": "sgd", "minibatch_advantages": True},
            r"update must be rsl_rl or auto for optimizer: sgd, minibatch_advantages: True$",
        ),
        ({"disturb": {"push": 9.0}}, r"plan\.disturb: planning has no physics to disturb"),
    ],
)
def test_settings_that_make_no_sense(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(TsbenchError, match=message) as caught:
        settings(problem(plan=changes), "plan")
    assert "\n" not in str(caught.value)
