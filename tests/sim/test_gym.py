"""The Gymnasium environments give the floats of the dm_control and batched environments."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.motion import ReferenceMotion
from tsbench.sim.gym import GymEnvironment, GymVectorEnvironment
from tsbench.testing.episodes import one_of_each_kind, values

COUNT = 3


def actions_of(steps: int, size: int) -> np.ndarray:
    """Actions (steps, COUNT, size) that are not positive: Laikago trips, and the rocket falls."""
    return np.random.default_rng(7).uniform(-1.0, 0.0, (steps, COUNT, size))


@pytest.mark.parametrize("perturbed", [False, True])
@pytest.mark.parametrize("name", tasks.names())
def test_gymnasium_finds_no_fault(name: str, perturbed: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Positions and velocities are unbounded.
        warnings.filterwarnings("ignore", message=".*A Box observation space .* value is -?inf")
        check_env(GymEnvironment(tsbench.load(name, perturbed=perturbed)), skip_render_check=True)


@pytest.mark.parametrize("variant", [None, "planning", "imitation"])
@pytest.mark.parametrize("name", one_of_each_kind())
def test_equal_to_the_dm_control_environment(
    name: str, variant: tsbench.Variant | None, naive_reference: Callable[[str], ReferenceMotion]
) -> None:
    """Equal to the last bit from the same seed, also after the end of an episode."""
    reference = naive_reference(name) if variant == "imitation" else None
    single = tsbench.load(name, variant, reference=reference, seed=5)
    coated = GymEnvironment(tsbench.load(name, variant, reference=reference))
    time_step = single.reset()
    observation, info = coated.reset(seed=5)
    steps = 40 if variant == "planning" else 250  # inverse kinematics is slow
    size = coated.single.task.mdp.action_size
    ends = 0
    for action in actions_of(steps, size)[:, 0]:
        assert observation.tobytes() == next(iter(time_step.observation.values())).tobytes()
        assert coated.observation_space.contains(observation)
        assert info == {}
        time_step = single.step(action)
        observation, reward, terminated, truncated, info = coated.step(action)
        assert reward == time_step.reward
        assert (terminated or truncated) == time_step.last()
        if time_step.last():
            assert terminated == (time_step.discount == 0.0)
            ends += 1
            time_step = single.reset()
            observation, info = coated.reset()
    assert ends >= (variant is None)


def test_an_arrival_spares_steps() -> None:
    """The hand-made planner goes to the goal, and then, in the next episode, nobody moves."""
    coated = GymEnvironment(tsbench.load("laikago_walk", "planning", distance=0.12))
    batched = GymVectorEnvironment(
        tsbench.load_batched("laikago_walk", "planning", count=COUNT, distance=0.12),
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    planning = coated.single.task.mdp
    coated.reset(seed=0)
    batched.reset(seed=0)
    arrivals: list[int] = []
    length = 0
    while len(arrivals) < 2:
        action = np.zeros(planning.action_size)
        if not arrivals:
            action = planning.abstraction.naive(coated.single.task.state)[0]
        _, _, terminated, truncated, info = coated.step(action)
        *_, infos = batched.step(np.tile(action, (COUNT, 1)))
        length += 1
        assert bool(info) == (terminated or truncated)
        if not info:
            continue
        assert info["spared"] == (planning.horizon - length if terminated else 0)
        assert info["quality"] == (1.0 if terminated else 0.0)  # nobody who stands gains ground
        for name in ("spared", "quality"):
            assert infos["final_info"][name][0] == info[name]
            assert infos["final_info"][f"_{name}"][0]
        arrivals.append(info["spared"])
        coated.reset()
        length = 0
    assert arrivals[0] > 0
    assert arrivals[1] == 0


def test_the_last_step_truncates() -> None:
    """The horizon is 1.5 times the planner's flight time: 39 steps of 0.02 s to a goal 3 m away."""
    coated = GymEnvironment(tsbench.load("rocket_navigation", distance=3.0))
    coated.reset(seed=0)
    hover = np.array([[0.5, 0.0], [0.0, 0.0]])  # least thrust every other step
    for step in range(1, 40):
        _, _, terminated, truncated, _ = coated.step(hover[step % 2])
        assert not terminated
        assert truncated == (step == 39)


def test_a_seed_decides() -> None:
    coated = GymEnvironment(tsbench.load("laikago_walk", perturbed=True))
    first, _ = coated.reset(seed=1)
    later, _ = coated.reset()
    again, _ = coated.reset(seed=1)
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != later.tobytes()
    assert coated.reset()[0].tobytes() == later.tobytes()


@pytest.mark.parametrize("name", tasks.names())
def test_the_vector_environment_is_the_batched_one(name: str) -> None:
    batched = tsbench.load_batched(name, count=COUNT, seed=9, threads=1, perturbed=True)
    coated = GymVectorEnvironment(
        tsbench.load_batched(name, count=COUNT, threads=1, perturbed=True),
        autoreset_mode="SameStep",
    )
    observation, infos = coated.reset(seed=9)
    assert observation.tobytes() == batched.reset().tobytes()
    assert infos == {}
    ends = np.zeros(COUNT, int)
    for action in actions_of(250, batched.mdp.action_size):
        transition = batched.step(action)
        observation, reward, terminated, truncated, infos = coated.step(action)
        assert observation.tobytes() == transition.observation.tobytes()
        assert coated.observation_space.contains(observation)
        assert reward.tobytes() == transition.reward.tobytes()
        np.testing.assert_array_equal(terminated, transition.terminal)
        np.testing.assert_array_equal(truncated, transition.truncated)
        assert bool(infos) == np.any(terminated | truncated)
        ends += terminated | truncated
    assert np.all(ends >= 1)


def own_and_coated(
    name: str, mode: AutoresetMode, limit: int | None = None
) -> tuple[Any, GymVectorEnvironment]:
    """Gymnasium's SyncVectorEnv over single environments, and the batched one."""

    def single() -> Any:
        made = GymEnvironment(tsbench.load(name, perturbed=True))
        return made if limit is None else TimeLimit(made, limit)

    batched = tsbench.load_batched(name, count=COUNT, threads=1, perturbed=True)
    coated = GymVectorEnvironment(batched, autoreset_mode=mode, max_episode_steps=limit)
    return SyncVectorEnv([single] * COUNT, autoreset_mode=mode), coated


def expect_same_infos(found: dict[str, Any], expected: dict[str, Any]) -> None:
    assert set(found) == set(expected)
    for key, value in found.items():
        if key in ("final_info", "final_obs"):
            continue
        np.testing.assert_array_equal(value, expected[key])
        assert value.dtype == expected[key].dtype
    expect_same_infos(
        found.get("final_info", {}), expected.get("final_info", {})
    ) if found else None
    for final, other in zip(found.get("final_obs", ()), expected.get("final_obs", ()), strict=True):
        assert (final is None) == (other is None)
        assert final is None or final.tobytes() == other.tobytes()


@pytest.mark.parametrize("limit", [None, 20])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("name", one_of_each_kind())
def test_the_vector_environment_is_gymnasiums_own(
    name: str, mode: AutoresetMode, limit: int | None
) -> None:
    """Equal to SyncVectorEnv over single environments from the same seeds: to the last bit, through
    several episodes of each, the infos included."""
    own, coated = own_and_coated(name, mode, limit)
    assert coated.metadata == own.metadata
    for space in ("observation_space", "action_space"):
        assert getattr(coated, space) == getattr(own, space)
        assert getattr(coated, f"single_{space}") == getattr(own, f"single_{space}")
    seeds = [3, 1, 2]
    assert coated.reset(seed=seeds)[0].tobytes() == own.reset(seed=seeds)[0].tobytes()
    endings = 0
    for action in actions_of(250 if limit is None else 70, coated.batched.mdp.action_size):
        *found, infos = coated.step(action)
        *expected, expected_infos = own.step(action)
        for array, other in zip(found, expected, strict=True):
            assert array.dtype == other.dtype
            assert array.tobytes() == other.tobytes()
        expect_same_infos(infos, expected_infos)
        endings += int(np.sum(found[2] | found[3]))
    assert endings >= COUNT


def test_the_next_step_ignores_what_it_is_given_where_an_episode_begins() -> None:
    """Also an action that would be refused; elsewhere it is refused, and no episode begins."""
    _, coated = own_and_coated("rocket_navigation", AutoresetMode.NEXT_STEP, 1)
    coated.max_episode_steps = np.array([1, 2, 2])  # type: ignore[assignment]
    coated.reset(seed=0)
    action = np.zeros((COUNT, 2))
    assert coated.step(action)[3].tolist() == [True, False, False]
    lost = coated.batched.state
    action[1] = np.nan
    with pytest.raises(TsbenchError, match="action of environment 1 is not finite at step 2"):
        coated.step(action)
    assert coated.batched.state is lost
    action[:2] = action[1::-1]
    observation, reward, terminated, truncated, infos = coated.step(action)
    assert reward[0] == 0.0
    assert reward[1] > 0.0
    assert truncated.tolist() == [False, True, True]
    assert not terminated.any()
    np.testing.assert_array_equal(coated.batched.steps, [0, 2, 2])
    assert not np.any(observation[0, :2] == lost.position[0])
    assert infos == {}


def test_a_reset_mask_starts_some_episodes() -> None:
    """As in SyncVectorEnv: also where the mode does not begin them."""
    own, coated = own_and_coated("rocket_navigation", AutoresetMode.DISABLED, 2)
    for environment in (own, coated):
        environment.reset(seed=[4, 5, 6])
    action = np.full((COUNT, 2), 0.7)
    for _ in range(2):
        *_, truncated, _ = coated.step(action)
        own.step(action)
    assert truncated.all()
    with pytest.raises(TsbenchError, match=r"call reset\(\) first: no episode goes on in .* 0"):
        coated.step(action)
    for mask, seeds in (([True, False, True], [7, 8, None]), ([False, True, False], None)):
        found, expected = (
            environment.reset(seed=seeds, options={"reset_mask": np.array(mask)})[0]
            for environment in (coated, own)
        )
        assert found.tobytes() == expected.tobytes()
    for found, expected in zip(coated.step(action)[:4], own.step(action)[:4], strict=True):
        assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": [1, 2]}, "a list of seeds must have one for each of the 3 environments, not 2"),
        ({"options": {"reset_mask": [True, False]}}, "reset_mask must be an array of 3 truth"),
        ({"options": {"reset_mask": [0, 1, 0]}}, "reset_mask must be an array of 3 truth"),
        ({"options": {"reset_mask": [False] * 3}}, "at least one of them true"),
        ({"options": {"goal": 3.0}}, "unknown option of reset 'goal'; allowed: reset_mask"),
    ],
)
def test_a_refused_reset_changes_nothing(arguments: dict[str, Any], message: str) -> None:
    _, coated = own_and_coated("rocket_navigation", AutoresetMode.NEXT_STEP)
    coated.reset(seed=1)
    before, state = coated.np_random.bit_generator.state, coated.batched.state
    with pytest.raises(TsbenchError, match=message):
        coated.reset(**{"seed": 5, **arguments})
    assert coated.np_random.bit_generator.state == before
    assert coated.batched.state is state


def test_a_single_reset_takes_no_options() -> None:
    coated = GymEnvironment(tsbench.load("rocket_navigation"))
    coated.reset(seed=1, options={})
    before = coated.np_random.bit_generator.state
    with pytest.raises(TsbenchError, match="unknown option of reset 'goal'; allowed: none"):
        coated.reset(seed=5, options={"goal": 3.0})
    assert coated.np_random.bit_generator.state == before


@pytest.mark.parametrize("mode", ["Next step", "next_step", 3])
def test_an_unknown_autoreset_mode_is_refused(mode: Any) -> None:
    batched = tsbench.load_batched("rocket_navigation", count=2)
    with pytest.raises(TsbenchError, match=r"unknown autoreset mode .* Disabled, NextStep, S"):
        GymVectorEnvironment(batched, autoreset_mode=mode)


# One generator for each environment, whoever seeds it.


def test_a_seed_given_first_decides() -> None:
    """`reset()` without a seed goes on with the generator that `load` seeded."""
    single = tsbench.load("laikago_walk", perturbed=True, seed=5)
    expected = [values(single.reset()).tobytes() for _ in range(2)]
    coated = GymEnvironment(tsbench.load("laikago_walk", perturbed=True, seed=5))
    assert [coated.reset()[0].tobytes() for _ in range(2)] == expected
    assert coated.np_random_seed == -1
    assert coated.reset(seed=5)[0].tobytes() == expected[0]
    assert coated.np_random_seed == 5


def test_a_generator_may_be_replaced() -> None:
    coated = GymEnvironment(tsbench.load("laikago_walk", perturbed=True))
    coated.np_random = np.random.default_rng(6)
    expected = tsbench.load("laikago_walk", perturbed=True, seed=6)
    assert coated.reset()[0].tobytes() == values(expected.reset()).tobytes()
    assert coated.single.task.random.normal() == expected.task.random.normal()
    many = GymVectorEnvironment(tsbench.load_batched("laikago_walk", count=2, perturbed=True))
    many.np_random = np.random.default_rng(6)
    again = tsbench.load_batched("laikago_walk", count=2, perturbed=True, seed=6)
    assert many.reset()[0].tobytes() == again.reset().tobytes()


def test_many_draw_fresh_starts_without_a_seed() -> None:
    load: Any = tsbench.load_batched
    first, second = (
        GymVectorEnvironment(load("laikago_walk", count=2, perturbed=True, seed=None)).reset()[0]
        for _ in range(2)
    )
    assert not np.any(first[:, :12] == second[:, :12])


# Steps that nothing allows.


@pytest.mark.parametrize("variant", [None, "planning"])
def test_a_step_before_the_first_reset(variant: tsbench.Variant | None) -> None:
    coated = GymEnvironment(tsbench.load("rocket_navigation", variant, seed=0))
    size = coated.single.task.mdp.action_size
    with pytest.raises(TsbenchError, match=r"call reset\(\) first: no episode has begun"):
        coated.step(np.zeros(size))
    many = GymVectorEnvironment(tsbench.load_batched("rocket_navigation", variant, count=2))
    with pytest.raises(TsbenchError, match=r"call reset\(\) first"):
        many.step(np.zeros((2, size)))
    with pytest.raises(TsbenchError, match=r"call reset\(\) first"):
        GymVectorEnvironment(many.batched, "rgb_array").render()


def test_a_step_after_the_end() -> None:
    """It is refused, and the last state can still be looked at."""
    coated = GymEnvironment(tsbench.load("rocket_navigation", distance=3.0))
    coated.reset(seed=0)
    last, *_ = [coated.step(np.array([0.5 * (step % 2), 0.0])) for step in range(39)][-1]
    assert last[1] > -0.5
    for _ in range(2):
        with pytest.raises(TsbenchError, match=r"call reset\(\) first: .* the last one has ended"):
            coated.step(np.zeros(2))
    assert coated.single.task.get_observation(coated.single.physics)["observations"] is not last
    np.testing.assert_array_equal(
        coated.single.task.get_observation(coated.single.physics)["observations"], last
    )
    assert coated.reset()[0][1] == 0.0


REFUSED: list[tuple[Any, str]] = [
    (np.full(2, np.nan), "action of environment 0 is not finite at step 3"),
    (np.array([np.inf, 0.0]), "action of environment 0 is not finite"),
    (np.zeros(3), r"the action has shape \(3,\), not \(2,\)"),
    (0.5, r"the action has shape \(\), not \(2,\)"),
    (["left", "right"], "the action must be an array of numbers, not \\['left', 'right'\\]"),
    ([[1.0], [1.0, 2.0]], "the action must be an array of numbers"),
    (np.zeros(2, complex), "the action must be an array of numbers"),
    (None, "the action must be an array of numbers, not None"),
]


@pytest.mark.parametrize(("action", "message"), REFUSED)
def test_a_refused_action_changes_nothing(action: Any, message: str) -> None:
    """The episode goes on as if it had not been given; in particular it is not shorter."""
    coated = GymEnvironment(tsbench.load("rocket_navigation", distance=3.0))
    coated.reset(seed=0)
    for step in range(39):
        if step == 2:
            for _ in range(3):
                with pytest.raises(TsbenchError, match=message):
                    coated.step(action)
        *_, truncated, _ = coated.step(np.array([0.5 * (step % 2), 0.0]))
        assert truncated == (step == 38)


@pytest.mark.parametrize("action", [action for action, _ in REFUSED])
def test_refused_actions_of_many_change_nothing(action: Any) -> None:
    coated = GymVectorEnvironment(tsbench.load_batched("rocket_navigation", count=1, distance=3.0))
    coated.reset(seed=0)
    for step in range(39):
        if step == 2:
            for _ in range(3):
                with pytest.raises(TsbenchError, match=r"^(the action|action of environment 0) "):
                    coated.step([action])  # type: ignore[arg-type]
        *_, truncated, _ = coated.step(np.array([[0.5 * (step % 2), 0.0]]))
        assert truncated[0] == (step == 38)


def test_pictures() -> None:
    coated = GymEnvironment(tsbench.load("rocket_navigation"), "rgb_array")
    coated.reset(seed=0)
    picture = coated.render()
    assert picture is not None
    assert picture.shape == (480, 640, 3)
    assert picture.std() > 0.0
    coated.close()
    assert GymEnvironment(tsbench.load("rocket_navigation")).render() is None
    with pytest.raises(TsbenchError, match="unknown render mode 'human'"):
        GymEnvironment(tsbench.load("rocket_navigation"), "human")


@pytest.mark.parametrize("variant", [None, "planning"])
def test_pictures_of_many(variant: tsbench.Variant | None) -> None:
    """Each is that of a single environment in the same state."""
    batched = tsbench.load_batched("rocket_navigation", variant, count=2, threads=1)
    many = GymVectorEnvironment(batched, "rgb_array")
    one = GymEnvironment(tsbench.load("rocket_navigation", variant), "rgb_array")
    many.reset(seed=0)
    one.reset(seed=0)
    size = batched.mdp.action_size
    actions = np.stack([np.full(size, 0.6), np.full(size, -0.6)])
    for _ in range(8):
        many.step(actions)
        one.step(actions[0])
    pictures, expected = many.render(), one.render()
    assert pictures is not None
    assert expected is not None
    np.testing.assert_array_equal(pictures[0], expected)
    assert np.any(pictures[1] != expected)
    assert GymVectorEnvironment(batched).render() is None
    assert many.metadata["render_fps"] == one.metadata["render_fps"]
    with pytest.raises(TsbenchError, match="unknown render mode 'human'; allowed: rgb_array"):
        GymVectorEnvironment(batched, "human")
