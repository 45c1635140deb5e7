"""What every task and every variant promises, whatever it is about."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, cast

import dm_env
import numpy as np
import pytest

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.motion import ReferenceMotion
from tsbench.sim.single import Adapter

VARIANTS: tuple[tsbench.Variant | None, ...] = (None, *tsbench.VARIANTS)
LEAST_REWARD = -0.4  # two obstacle terms of 0.075 and a collision of 0.25


@dataclass(frozen=True)
class Case:
    """A task and a variant of it."""

    name: str
    variant: tsbench.Variant | None
    reference: ReferenceMotion | None

    def load(self, seed: int = 0, *, perturbed: bool = True) -> dm_env.Environment:
        """With random starts where there are any, unless told otherwise."""
        return tsbench.load(
            self.name,
            self.variant,
            reference=self.reference,
            seed=seed,
            perturbed=perturbed and self.variant is None,
        )

    @property
    def starts_at_random(self) -> bool:
        return self.variant != "planning"


@pytest.fixture(
    scope="module",
    params=[(name, variant) for name in tasks.names() for variant in VARIANTS],
    ids=lambda pair: f"{pair[0]}-{pair[1] or 'task'}",
)
def case(request: pytest.FixtureRequest, naive_reference: Callable[[str], ReferenceMotion]) -> Case:
    name, variant = request.param
    return Case(name, variant, naive_reference(name) if variant == "imitation" else None)


def mdp(environment: dm_env.Environment) -> Any:
    return cast(Adapter, environment.task).mdp


def values(time_step: dm_env.TimeStep) -> np.ndarray:
    (observation,) = time_step.observation.values()
    return cast(np.ndarray, observation)


def episode(
    environment: dm_env.Environment, policy: Callable[[], np.ndarray]
) -> Iterator[dm_env.TimeStep]:
    """The time steps of a new episode. Fails when it goes on beyond the horizon."""
    time_step = environment.reset()
    yield time_step
    for _ in range(mdp(environment).horizon):
        time_step = environment.step(policy())
        yield time_step
        if time_step.last():
            return
    raise AssertionError("the episode goes on beyond the horizon")


def at_random(environment: dm_env.Environment, seed: int) -> Callable[[], np.ndarray]:
    rng = np.random.default_rng(seed)
    size = environment.action_spec().shape
    return lambda: rng.uniform(-1.0, 1.0, size)


@pytest.fixture(scope="module")
def played(case: Case) -> tuple[dm_env.Environment, list[list[dm_env.TimeStep]]]:
    """Some episodes under random actions."""
    environment = case.load()
    policy = at_random(environment, 7)
    return environment, [list(episode(environment, policy)) for _ in range(4)]


def test_identity(case: Case) -> None:
    subject, task = mdp(case.load()), tasks.make(case.name)
    assert (subject.name, subject.version) == (case.name, task.version)
    assert type(subject.version) is int
    assert subject.version >= 1
    assert subject.horizon >= 1
    assert subject.max_reward > 0.0
    if case.variant != "planning":  # same observations, actions and physics
        assert subject.observation_size == task.observation_size
        assert subject.action_size == task.action_size
        assert (subject.timestep, subject.plant) == (task.timestep, task)


def test_time_passes_as_it_says(case: Case) -> None:
    environment = case.load(perturbed=False)
    assert environment.control_timestep() == pytest.approx(mdp(environment).timestep, rel=1e-12)
    task = tasks.make(case.name)
    if case.variant == "planning":  # as long as the task's episodes, in whole planning steps
        duration = mdp(environment).horizon * mdp(environment).timestep
        assert 0.0 <= task.horizon * task.timestep - duration < mdp(environment).timestep


def test_specs(case: Case, played: tuple[dm_env.Environment, Any]) -> None:
    environment, episodes = played
    (spec,) = environment.observation_spec().values()
    assert spec.shape == (mdp(environment).observation_size,)
    assert spec.dtype == np.float64
    actions = environment.action_spec()
    assert actions.shape == (mdp(environment).action_size,)
    np.testing.assert_array_equal(actions.minimum, -1.0)
    np.testing.assert_array_equal(actions.maximum, 1.0)
    for time_steps in episodes:
        for time_step in time_steps:
            assert time_step.observation.keys() == environment.observation_spec().keys()
            spec.validate(values(time_step))
            assert np.all(np.isfinite(values(time_step)))


def test_episodes(played: tuple[dm_env.Environment, list[list[dm_env.TimeStep]]]) -> None:
    """First, then rewards within their bounds, then a last step that says why it is the last."""
    environment, episodes = played
    most = mdp(environment).max_reward
    for time_steps in episodes:
        assert time_steps[0].first()
        assert time_steps[0].reward is None
        assert time_steps[-1].last()
        for time_step in time_steps[1:]:
            assert type(time_step.reward) is float
            assert LEAST_REWARD <= time_step.reward <= most
        assert all(time_step.mid() and time_step.discount == 1.0 for time_step in time_steps[1:-1])
        assert time_steps[-1].discount in (0.0, 1.0)


def test_discount_tells_endings_apart(case: Case) -> None:
    """0 at a terminal state, 1 at the last step, which comes when the horizon says."""
    environment = case.load(seed=3, perturbed=False)
    subject = mdp(environment)
    laikago = case.name.startswith("laikago")

    def is_own_start() -> bool:
        return float(cast(Adapter, environment.task).state.time[0]) == 0.0

    while not (environment.reset() and is_own_start()):
        pass  # an imitation's episode begins anywhere along the reference
    still = np.zeros(subject.action_size)
    steps = 0
    while True:
        steps += 1
        # Half the least throttle hovers: 12.5 N. Laikago stands.
        on = not laikago and case.variant != "planning" and steps % 2 == 0
        time_step = environment.step(np.array([0.5, 0.0]) if on else still)
        if time_step.last():
            break
    assert time_step.discount == 1.0
    assert steps == subject.horizon

    if case.variant == "planning":
        away = -np.ones(subject.action_size)
    elif laikago:
        away = np.where(np.arange(12) % 3 == 1, 1.0, -1.0)  # folds its legs
    else:
        away = still  # falls out of the world
    time_steps = list(episode(environment, lambda: away))
    while len(time_steps) > subject.horizon:
        time_steps = list(episode(environment, lambda: away))
    assert time_steps[-1].discount == 0.0
    assert subject.terminal(cast(Adapter, environment.task).state)[0]


def test_the_same_seed_gives_the_same_episodes(case: Case) -> None:
    runs = []
    for _ in range(2):
        environment = case.load(seed=5)
        policy = at_random(environment, 5)
        runs.append([step for _ in range(2) for step in episode(environment, policy)])
    assert len(runs[0]) == len(runs[1])
    for first, second in zip(*runs, strict=True):
        assert (first.step_type, first.reward, first.discount) == (
            second.step_type, second.reward, second.discount,
        )  # fmt: skip
        np.testing.assert_array_equal(values(first), values(second))


def test_other_seeds_and_episodes_start_elsewhere(case: Case) -> None:
    environment = case.load(seed=1)
    starts = [values(environment.reset()) for _ in range(6)]
    starts += [values(case.load(seed=seed).reset()) for seed in (2, 3)]
    distinct = {start.tobytes() for start in starts}
    if case.starts_at_random:
        assert len(distinct) >= 6  # an imitation's start is now and then the task's own
    else:
        assert len(distinct) == 1
    if case.variant is None:
        fixed = [values(case.load(seed=seed, perturbed=False).reset()) for seed in (1, 2)]
        np.testing.assert_array_equal(fixed[0], fixed[1])


def test_observations_are_not_shared(case: Case) -> None:
    """Each is the caller's own: what he does to it changes nothing."""
    environment, untouched = case.load(seed=2), case.load(seed=2)
    policy, same = at_random(environment, 2), at_random(environment, 2)
    seen: list[np.ndarray] = []
    environment.reset(), untouched.reset()
    for _ in range(10):
        time_step, expected = environment.step(policy()), untouched.step(same())
        np.testing.assert_array_equal(values(time_step), values(expected))
        assert time_step.reward == expected.reward
        assert not any(np.shares_memory(values(time_step), other) for other in seen)
        seen.append(values(time_step))
        values(time_step)[:] = np.nan


def test_no_observation_is_constant(
    played: tuple[dm_env.Environment, list[list[dm_env.TimeStep]]],
) -> None:
    observations = np.array([values(step) for time_steps in played[1] for step in time_steps])
    assert np.flatnonzero(np.ptp(observations, axis=0) == 0.0).tolist() == []


def test_actions_are_clipped(case: Case) -> None:
    wild, tame = case.load(seed=4), case.load(seed=4)
    wild.reset(), tame.reset()
    rng = np.random.default_rng(0)
    beyond = 0
    for _ in range(15):
        action = rng.uniform(-4.0, 4.0, wild.action_spec().shape)
        beyond += int(np.sum(np.abs(action) > 1.0))
        one, other = wild.step(action), tame.step(np.clip(action, -1.0, 1.0))
        np.testing.assert_array_equal(values(one), values(other))
        assert (one.reward, one.discount) == (other.reward, other.discount)
    assert beyond > 15


def test_the_next_episode_begins_by_itself(case: Case) -> None:
    environment = case.load()
    policy = at_random(environment, 1)
    list(episode(environment, policy))
    time_step = environment.step(policy())
    assert time_step.first()
    assert environment.step(policy()).mid()


def test_batched(case: Case) -> None:
    """The batched environment of the same case: shapes, types, and several episodes on end."""
    environment = tsbench.load_batched(
        case.name, case.variant, count=3, reference=case.reference, threads=1, seed=0
    )
    size = environment.mdp.observation_size
    assert environment.reset().shape == (3, size)
    rng = np.random.default_rng(0)
    for _ in range(5):
        transition = environment.step(rng.uniform(-1.0, 1.0, (3, environment.mdp.action_size)))
        assert transition.observation.shape == (3, size)
        assert transition.observation.dtype == np.float64
        assert transition.reward.shape == (3,)
        assert transition.terminal.dtype == transition.truncated.dtype == bool


def test_what_cannot_be_loaded(naive_reference: Callable[[str], ReferenceMotion]) -> None:
    with pytest.raises(TsbenchError, match=r"unknown variant 'planing'.*did you mean 'planning'"):
        tsbench.load("laikago_walk", cast(Any, "planing"))
    with pytest.raises(TsbenchError, match="needs a reference motion"):
        tsbench.load("laikago_walk", "imitation")
    foreign = naive_reference("laikago_trot")
    with pytest.raises(TsbenchError, match="for laikago_trot version 1, not for laikago_walk"):
        tsbench.load("laikago_walk", "imitation", reference=foreign)
    with pytest.raises(TsbenchError, match="no perturbed starts"):
        tsbench.load("laikago_walk", "planning", perturbed=True)
    with pytest.raises(TsbenchError, match="unknown task 'laikago'"):
        tsbench.load_batched("laikago", count=1)
