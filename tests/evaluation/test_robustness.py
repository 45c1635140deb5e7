"""The evaluator as an instrument: pushes that arrive, floats that agree, failures that count."""

from __future__ import annotations

import hashlib
import json
import math
import os
import subprocess
import sys
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, cast

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tsbench import tasks
from tsbench.core.state import State
from tsbench.core.task import Task
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.protocol import (
    PHYSICS,
    PROTOCOLS,
    SMOKE,
    V1,
    Condition,
    Protocol,
    perturbed_starts,
)
from tsbench.evaluation.robustness import (
    impulse_50,
    mass_scale,
    pushed,
    robustness,
)
from tsbench.sim.change import Change
from tsbench.sim.episodes import Episodes, PolicyFunction, play
from tsbench.sim.physics import Physics
from tsbench.sim.push import Push
from tsbench.sim.single import environment
from tsbench.testing.episodes import one_of_each_kind

NONE = Condition("as it is")


@dataclass(frozen=True)
class Serial:
    """One episode in the dm_control environment.

    Attributes:
        rewards: of its steps.
        final: its last state.
        survived: by the protocol's words.
        recovered: the same.
    """

    rewards: list[float]
    final: State
    survived: bool
    recovered: bool


def serial(
    task: Task[Any],
    policy: PolicyFunction,
    push: Push | None = None,
    condition: Condition = NONE,
    seed: tuple[int, int] | None = None,
) -> Serial:
    env = environment(
        task,
        cast(Any, seed),
        perturbed=seed is not None,
        push=push,
        change=condition.change,
    )
    adapter = cast(Any, env.task)
    time_step = env.reset()
    pending = [np.zeros(task.action_size)] * condition.delay
    rewards: list[float] = []
    violated = False
    while not time_step.last():
        (observation,) = time_step.observation.values()
        pending.append(policy(observation[None])[0])
        time_step = env.step(pending.pop(0))
        rewards.append(float(time_step.reward))
        violated |= bool(task.violated(adapter.state)[0])
    ended_well = time_step.discount == 1.0 or bool(task.reached(adapter.state)[0])
    survived = ended_well and not violated
    solved = bool(task.success(adapter.state, adapter.course)[0])
    return Serial(rewards, adapter.state, survived, survived and solved)


def batched(
    task: Task[Any], policy: PolicyFunction, push: Push | None = None, condition: Condition = NONE
) -> Episodes[Any]:
    physics: Physics[Any] = Physics(task, 1, threads=1, push=push, change=condition.change)
    return play(task, physics, policy, 1, delay=condition.delay)


def equal(episodes: Episodes[Any], row: int, alone: Serial) -> bool:
    """To the last bit."""
    length = len(alone.rewards)
    assert episodes.lengths[row] == length
    assert episodes.rewards[:length, row].tolist() == alone.rewards
    assert episodes.survived[row] == alone.survived
    final = episodes.final.rows(slice(row, row + 1))
    pairs = [(getattr(final, f.name), getattr(alone.final, f.name)) for f in fields(final)]
    return all(a.tobytes() == b.tobytes() for a, b in pairs)


def swaying(task: Task[Any]) -> PolicyFunction:
    """Answers everything that it sees, so that a difference anywhere would spread."""
    weights = 0.05 * np.random.default_rng(0).normal(size=(task.observation_size, task.action_size))

    def policy(observation: np.ndarray) -> np.ndarray:
        # Summed by hand: a matrix product of several rows rounds differently from one of one.
        action: np.ndarray = np.tanh((observation[:, :, None] * weights).sum(axis=1))
        return action if task.action_size > 2 else np.abs(action) * [1.0, 0.0] + [0.4, 0.0]

    return policy


@pytest.mark.parametrize("name", tasks.names())
def test_serial_equals_batched(name: str) -> None:
    """A whole nominal, a perturbed, a pushed and a changed episode of every task."""
    task = tasks.make(name)
    policy = swaying(task)
    assert equal(batched(task, policy), 0, serial(task, policy))

    protocol = replace(SMOKE, perturbed=3)
    starts = perturbed_starts(task, protocol)
    physics: Physics[Any] = Physics(task, 3, threads=2)
    episodes = play(task, physics, policy, 3, begin=physics.place(np.arange(3), starts))
    for episode in range(3):
        assert equal(episodes, episode, serial(task, policy, seed=(protocol.seed, episode)))

    across, along = np.array(task.push_plane)
    push = Push(0.3, 0.1, 150.0 * mass_scale(task) * (across + along) / math.sqrt(2))
    pushed = batched(task, policy, push)
    assert equal(pushed, 0, serial(task, policy, push))
    assert pushed.final.time != batched(task, policy).final.time or not np.array_equal(
        task.observation(pushed.final), task.observation(batched(task, policy).final)
    )

    for condition in (
        Condition("all at once", Change(mass=1.2, friction=0.5, strength=0.8)),
        Condition("late", delay=2),
        Condition("half the time step", Change(refine=2)),
        Condition("other contacts", Change(cone="elliptic", impratio=10.0)),
    ):
        if name.startswith("rocket") and condition.change.cone:
            continue  # it touches nothing
        changed = batched(task, policy, condition=condition)
        assert equal(changed, 0, serial(task, policy, condition=condition))
        assert changed.rewards.tolist() != batched(task, policy).rewards.tolist()


SMALL = Protocol(
    name="small", ranked=False, seed=0, perturbed=1, changed=1, conditions=(),
    headings=3, phases=6, forces=(100.0, 500.0),
)  # fmt: skip


@pytest.mark.parametrize("name", one_of_each_kind())
def test_a_push_played_from_its_moment_is_the_whole_episode(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is gone on from shortly before the push is what the dm_control environment plays from
    the start, with no reset on the way; in blocks of pushes as with all side by side."""
    task = tasks.make(name)
    # A rocket climbs out of the world, unless a push helps it to stay. Laikago stands astride.
    still = np.eye(task.action_size)[0] / 2

    def policy(observation: np.ndarray) -> np.ndarray:
        return np.tile(still, (len(observation), 1))

    forces = np.array(SMALL.forces) * mass_scale(task)
    phases = task.push_steps[:: SMALL.phases]
    assert len(phases) >= 3
    outcome = pushed(policy, task, forces, phases, SMALL, threads=1)
    survived = outcome.survived
    assert survived.shape == outcome.recovered.shape == (2, 3, len(phases))
    monkeypatch.setattr(Physics, "side_by_side", 5)
    in_blocks = pushed(policy, task, forces, phases, SMALL, threads=1)
    np.testing.assert_array_equal(in_blocks.survived, survived)
    np.testing.assert_array_equal(in_blocks.recovered, outcome.recovered)
    assert outcome.calm == (serial(task, policy).survived, serial(task, policy).recovered)
    across, along = np.array(task.push_plane)
    for f, force in enumerate(forces):
        for p, phase in list(enumerate(phases))[:2]:
            for h, heading in enumerate(SMALL.directions()):
                direction = math.cos(heading) * across + math.sin(heading) * along
                push = Push(phase * task.timestep, 0.1, force * direction)
                alone = serial(task, policy, push)
                assert alone.survived == survived[f, h, p], (f, h, p)
                assert alone.recovered == outcome.recovered[f, h, p], (f, h, p)


def test_a_standing_robot_survives_small_pushes_and_no_large_ones() -> None:
    """A policy of known worth: 10 N s move it by at most 0.39 m/s, 100 N s throw it."""
    task = tasks.make("laikago_walk")
    protocol = replace(SMALL, forces=(50.0, 1000.0), claim=50.0)
    found = robustness(lambda o: np.zeros((len(o), 12)), task, protocol, threads=1)
    assert found.survival_100N == 1.0  # the share at the claim
    assert found.surface.forces_N == (50.0, 1000.0)
    assert found.surface.phases == (90, 96, 102, 108)
    assert np.array(found.surface.survived)[1].sum() == 0
    half = 5.0 + (100.0 - 5.0) / 2  # half way from all to none
    assert found.survival_impulse_50 == pytest.approx(half)
    assert not found.survival_impulse_50_is_lower_bound
    # It goes nowhere, pushed or not.
    assert (found.recovery_100N, found.recovery_impulse_50) == (0.0, 0.0)
    assert not np.any(found.surface.recovered)


def test_an_episode_that_is_over_before_its_push_does_not_survive() -> None:
    """A rocket that falls leaves the world after 2.9 s; its pushes are spread over 10.4 s."""
    task = tasks.make("rocket_navigation")
    found = robustness(lambda o: np.zeros((len(o), 2)), task, SMALL, threads=1)
    assert not np.any(found.surface.survived)
    assert (found.survival_100N, found.survival_impulse_50) == (0.0, 0.0)
    assert len(found.surface.phases) == 3  # all of them are in the denominator


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nothing bounds address space")
def test_all_pushes_of_a_rocket_take_less_than_4_gb() -> None:
    """Of address space, where all 3072 side by side take 46 GB. It falls, but for too short a time
    to leave the world, so that every push is played."""
    program = (
        "import resource\n"
        "import numpy as np\n"
        "from tsbench import tasks\n"
        "from tsbench.evaluation.evaluate import evaluate\n"
        "resource.setrlimit(resource.RLIMIT_AS, (4_000_000_000, 4_000_000_000))\n"
        "task = tasks.make('rocket_navigation', distance=5.0)\n"
        "score = evaluate(lambda o: np.zeros((len(o), 2)), task, threads=1)\n"
        "print(np.size(score.robustness.surface.survived), score.robustness.survival_100N)"
    )
    # A thread of BLAS takes address space too, and there is one for every core.
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment
    )
    assert done.stdout.split() == ["3072", "1.0"], done.stderr


def test_the_rocket_is_pushed_as_fast() -> None:
    """5 kg of 25.433: 19.66 N, which change its velocity as 100 N change Laikago's."""
    assert mass_scale(tasks.make("laikago_walk")) == mass_scale(tasks.make("laikago_trot")) == 1.0
    scale = mass_scale(tasks.make("rocket_obstacles"))
    assert scale == pytest.approx(5.0 / 25.433, rel=1e-5)
    assert 100.0 * scale * 0.1 / 5.0 == pytest.approx(10.0 / 25.433, rel=1e-5)


# Summaries


@pytest.mark.parametrize(
    ("survived", "expected", "is_bound"),
    [
        ([1.0, 0.75, 0.25, 0.0], 25.0, False),  # half way from 20 to 30
        ([1.0, 1.0, 0.0, 0.0], 25.0, False),
        ([1.0, 0.5, 0.4, 0.0], 20.0, False),  # exactly half at 20
        ([1.0, 1.0, 1.0, 0.6], 40.0, True),  # never below half: no more than a bound
        ([1.0, 1.0, 1.0, 0.5], 40.0, False),
        ([0.25, 0.0, 0.0, 0.0], 20.0 / 3.0, False),  # from all at zero: 1 - 0.075 J = 0.5
        ([0.9, 0.3, 0.6, 0.0], 10.0 + 10.0 * 0.4 / 0.45, False),  # 0.3 and 0.6 pooled to 0.45
    ],
)
def test_impulse_50_by_hand(survived: list[float], expected: float, is_bound: bool) -> None:
    impulses = np.array([10.0, 20.0, 30.0, 40.0])
    found, bound = impulse_50(impulses, np.array(survived))
    assert found == pytest.approx(expected)
    assert bound == is_bound


def test_impulse_50_of_what_falls_by_itself() -> None:
    assert impulse_50(np.array([10.0]), np.array([0.0]), unpushed=False) == (0.0, False)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_impulse_50_rises_with_survival(survived: list[float]) -> None:
    impulses = np.arange(1.0, len(survived) + 1)
    lower = impulse_50(impulses, np.array(survived))[0]
    better = impulse_50(impulses, np.minimum(np.array(survived) + 0.1, 1.0))[0]
    assert 0.0 <= lower <= better + 1e-9 <= impulses[-1] + 1e-9


# The protocol


def test_v1_is_frozen() -> None:
    """It is frozen from here on: whoever needs other numbers makes a new protocol with a new name,
    and this hash stays."""
    content = json.dumps(asdict(V1), sort_keys=True)
    assert hashlib.sha256(content.encode()).hexdigest() == (
        "051a75485c6739b3058fe7715287418d95bffaf9dc3a96d9f48b4c176cdf0678"
    )


def test_what_v1_asks() -> None:
    """The same in numbers that people can read."""
    assert (V1.name, V1.ranked, V1.seed, V1.perturbed, V1.changed) == ("v1", True, 0, 100, 20)
    assert (V1.headings, V1.phases, V1.claim, V1.duration) == (16, 1, 100.0, 0.1)
    assert V1.forces == tuple(range(50, 601, 50))
    assert V1.physics == Change()
    *others, elliptic, half = V1.conditions
    assert (elliptic.name, elliptic.change) == (
        "elliptic cone", Change(cone="elliptic", impratio=10.0),
    )  # fmt: skip
    assert (half.name, half.change) == ("half the time step", Change(refine=2))
    assert elliptic.delay == half.delay == 0
    levels = {c.name: (c.change.mass, c.change.friction, c.change.strength, c.delay)
              for c in others}  # fmt: skip
    assert levels == {
        "mass x 0.8": (0.8, 1.0, 1.0, 0),
        "mass x 1.2": (1.2, 1.0, 1.0, 0),
        "friction x 0.5": (1.0, 0.5, 1.0, 0),
        "friction x 1.25": (1.0, 1.25, 1.0, 0),
        "motor strength x 0.8": (1.0, 1.0, 0.8, 0),
        "motor strength x 1.2": (1.0, 1.0, 1.2, 0),
        "latency 1 control step": (1.0, 1.0, 1.0, 1),
        "latency 2 control steps": (1.0, 1.0, 1.0, 2),
    }


def test_phases_are_one_gait_cycle() -> None:
    assert tasks.make("laikago_trot").push_steps == tuple(range(90, 106))
    assert tasks.make("laikago_walk").push_steps == tuple(range(90, 114))
    rocket = tasks.make("rocket_obstacles").push_steps
    assert len(rocket) == 16
    assert rocket[0] == 16
    assert rocket[-1] == 503  # the planner's flight takes 519 steps
    assert tasks.make("laikago_trot", distance=0.11).push_steps == (3, 4, 5, 6)


def test_common_random_numbers() -> None:
    """Every policy meets the same starts, and a start does not depend on how many there are."""
    task = tasks.make("laikago_walk")
    many, few = (perturbed_starts(task, replace(SMOKE, perturbed=count)) for count in (5, 3))
    np.testing.assert_array_equal(many.qpos[:3], few.qpos)
    np.testing.assert_array_equal(many.qvel[:3], few.qvel)
    assert len(np.unique(many.qpos, axis=0)) == 5


def test_changes_do_what_they_say() -> None:
    """The same thrust on other masses; half of the strength is half of the thrust."""
    task = tasks.make("rocket_navigation")

    def climb(change: Change) -> float:
        physics: Physics[Any] = Physics(task, 1, threads=1, change=change)
        state = physics.begin(np.random.default_rng(0), np.arange(1))
        state = physics.advance(state, np.array([[1.0, 0.0]]))
        return float(state.velocity[0, 1])

    def expected(mass: float, thrust: float) -> float:
        return 0.02 * (thrust - 2.5 * mass) / (mass + 0.02 * 2.5)

    assert climb(Change()) == pytest.approx(expected(5.0, 50.0))
    assert climb(Change(mass=1.2)) == pytest.approx(expected(6.0, 50.0))
    assert climb(Change(strength=0.5)) == pytest.approx(expected(5.0, 25.0))
    model = tasks.make("laikago_walk").spec().compile()
    before = model.geom_friction.copy(), model.actuator_forcerange.copy()
    Change(friction=0.5, strength=0.8).apply(model)
    np.testing.assert_array_equal(model.geom_friction, 0.5 * before[0])
    np.testing.assert_array_equal(model.actuator_forcerange, 0.8 * before[1])
    assert model.body_subtreemass[0] == pytest.approx(25.433)
    pair = (
        '<worldbody><geom name="a" size="1"/><body><freejoint/><geom name="b" size="1"/></body>'
        '</worldbody><contact><pair geom1="a" geom2="b" friction="1 1 1 1 1"/></contact>'
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{pair}</mujoco>")
    Change(friction=0.5).apply(model)
    np.testing.assert_array_equal(model.pair_friction, 0.5)


def test_another_contact_model() -> None:
    model = tasks.make("laikago_walk").spec().compile()
    before = model.opt.timestep
    Change(cone="elliptic", impratio=10.0, refine=4).apply(model)
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.impratio == 10.0
    assert model.opt.timestep == before / 4
    Change(cone="pyramidal").apply(model)
    assert (model.opt.cone, model.opt.impratio) == (mujoco.mjtCone.mjCONE_PYRAMIDAL, 10.0)


def test_a_finer_time_step_takes_as_many_more() -> None:
    """The control step stays, and the fall is nearer to the true one:
    v(t) = -g m / d (1 - exp(-d t / m)), with 2.5 m/s^2, 5 kg and 2.5 N s/m."""
    task = tasks.make("rocket_navigation")
    errors = []
    for refine in (1, 2, 4):
        change = Change(refine=refine)
        physics: Physics[Any] = Physics(task, 1, threads=1, change=change)
        state = physics.begin(np.random.default_rng(0), np.arange(1))
        for _ in range(50):
            state = physics.advance(state, np.zeros((1, 2)))
        assert state.time[0] == pytest.approx(1.0)
        assert physics.substeps == 50 * refine
        errors.append(abs(float(state.velocity[0, 1]) + 5.0 * (1.0 - math.exp(-0.5))))
    assert errors[0] == pytest.approx(2.0 * errors[1], rel=0.05)  # first order
    assert errors[1] == pytest.approx(2.0 * errors[2], rel=0.05)


def test_changes_add_up() -> None:
    first, second = Change(mass=0.8, refine=2, cone="elliptic"), Change(1.5, 0.5, 0.9, refine=3)
    assert second.after(first) == Change(0.8 * 1.5, 0.5, 0.9, cone="elliptic", refine=6)
    assert first.after(Change(cone="pyramidal", impratio=2.0)) == replace(first, impratio=2.0)
    assert Change().after(first) == first == first.after(Change())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"cone": "round"}, "cone must be one of pyramidal, elliptic, not round"),
        ({"impratio": 0.0}, "impratio must be positive"),
        ({"refine": 0}, "refine must lie between 1 and 1000"),
    ],
)
def test_changes_that_cannot_be(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Change(**wrong)


def test_another_physics_is_never_ranked() -> None:
    for name, change in PHYSICS.items():
        other = V1.elsewhere(name)
        assert other == replace(V1, name=f"v1 in {name}", ranked=False, physics=change)
        assert other.name not in PROTOCOLS


def test_an_early_end_counts_its_missing_steps() -> None:
    """A fall after n of 180 steps leaves 180 - n zeros in the mean."""
    task = tasks.make("laikago_trot")

    def crouch(observation: np.ndarray) -> np.ndarray:
        return np.tile([0.0, 1.0, -1.0], (len(observation), 4))

    score = evaluate(crouch, task, protocol=replace(SMOKE, perturbed=2, conditions=()), threads=1)
    alone = serial(task, crouch)
    assert len(alone.rewards) < 180
    assert score.nominal.steps == len(alone.rewards)
    assert score.nominal.violations == 1.0
    reward = pytest.approx(sum(alone.rewards) / 180, rel=1e-12)
    assert score.nominal.normalized_reward == reward
    assert score.robustness.survival_100N == 0.0
