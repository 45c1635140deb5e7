"""The Gymnasium environments give the floats of the dm_control and batched environments."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.motion import ReferenceMotion
from tsbench.sim.gym import GymEnvironment, GymVectorEnvironment
from tsbench.testing.episodes import one_of_each_kind

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
        tsbench.load_batched("laikago_walk", "planning", count=COUNT, distance=0.12)
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
        tsbench.load_batched(name, count=COUNT, threads=1, perturbed=True)
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


@pytest.mark.parametrize("name", one_of_each_kind())
def test_the_vector_environment_is_gymnasiums_own(name: str) -> None:
    """Equal to SyncVectorEnv over single environments, final observations included."""
    own: Any = SyncVectorEnv(
        [lambda: GymEnvironment(tsbench.load(name))] * COUNT,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    coated = GymVectorEnvironment(tsbench.load_batched(name, count=COUNT, threads=1))
    assert coated.metadata["autoreset_mode"] == own.metadata["autoreset_mode"]
    for space in ("observation_space", "action_space"):
        assert getattr(coated, space) == getattr(own, space)
        assert getattr(coated, f"single_{space}") == getattr(own, f"single_{space}")
    assert coated.reset(seed=2)[0].tobytes() == own.reset(seed=2)[0].tobytes()
    seen = 0
    for action in actions_of(250, coated.batched.mdp.action_size):
        *found, infos = coated.step(action)
        *expected, expected_infos = own.step(action)
        for array, other in zip(found, expected, strict=True):
            assert array.dtype == other.dtype
            assert array.tobytes() == other.tobytes()
        assert set(infos) == set(expected_infos)
        if infos:
            seen += 1
            np.testing.assert_array_equal(infos["_final_obs"], expected_infos["_final_obs"])
            assert set(infos["final_info"]) == set(expected_infos["final_info"])
            for key, values in infos["final_info"].items():
                np.testing.assert_array_equal(values, expected_infos["final_info"][key])
            for final, other in zip(infos["final_obs"], expected_infos["final_obs"], strict=True):
                assert (final is None) == (other is None)
                assert final is None or final.tobytes() == other.tobytes()
    assert seen >= 2


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


def test_the_vector_environment_takes_no_options() -> None:
    coated = GymVectorEnvironment(tsbench.load_batched("rocket_navigation", count=2))
    with pytest.raises(TsbenchError, match="takes no options, not reset_mask"):
        coated.reset(options={"reset_mask": np.array([True, False])})
