"""The dm_control environments among the wrappers and tools that others write for dm_control."""

from __future__ import annotations

import copy
import pickle
import unittest
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from dm_control.mujoco.wrapper import enable_timer
from dm_control.suite.wrappers import action_noise, action_scale, mujoco_profiling, pixels
from dm_control.viewer import runtime
from dm_env import test_utils
from shimmy.dm_control_compatibility import DmControlCompatibilityV0

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.motion import ReferenceMotion
from tsbench.sim.single import environment
from tsbench.testing.episodes import one_of_each_kind, same, state_of, values

VARIANTS: tuple[tsbench.Variant | None, ...] = (None, "planning", "imitation")


@pytest.fixture
def load(naive_reference: Callable[[str], ReferenceMotion]) -> Callable[..., Any]:
    def load(name: str, variant: tsbench.Variant | None = None, **arguments: Any) -> Any:
        reference = naive_reference(name) if variant == "imitation" else None
        return tsbench.load(name, variant, reference=reference, **arguments)

    return load


def actions(env: Any, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.3, 0.3, (count, *env.action_spec().shape))


def trace(env: Any, given: np.ndarray) -> list[bytes]:
    """Everything that the steps return, to the last bit."""
    steps = [env.step(action) for action in given]
    return [
        repr((step.step_type, step.reward, step.discount)).encode() + values(step).tobytes()
        for step in steps
    ]


# The contract of dm_env, by its own tests. A step after the end begins an episode.


def contract(name: str, variant: tsbench.Variant | None) -> type[unittest.TestCase]:
    class Contract(test_utils.EnvironmentTestMixin, unittest.TestCase):
        def make_object_under_test(self) -> Any:
            return tsbench.load(name, variant, seed=0)

        def make_action_sequence(self) -> Any:
            falling = -np.ones(self.environment.action_spec().shape)
            yield from [falling] * 80  # ends an episode

    return Contract


@pytest.mark.parametrize("variant", [None, "planning"])
@pytest.mark.parametrize("name", one_of_each_kind())
def test_dm_envs_own_tests(name: str, variant: tsbench.Variant | None) -> None:
    result = unittest.TestResult()
    unittest.defaultTestLoader.loadTestsFromTestCase(contract(name, variant)).run(result)
    assert result.testsRun == 4
    assert not result.failures + result.errors


# Randomness has one home.


def test_the_generator_under_dm_controls_name() -> None:
    """`task.random` draws from the bits of the seed, and its draws move the starts."""
    expected = np.random.RandomState(np.random.default_rng(5).bit_generator)
    env = tsbench.load("laikago_walk", perturbed=True, seed=5)
    assert isinstance(env.task.random, np.random.RandomState)
    assert env.task.random.uniform(size=3).tolist() == expected.uniform(size=3).tolist()
    assert env.task.random.randint(1000) == expected.randint(1000)
    start = tasks.make("laikago_walk").start(
        np.random.Generator(expected._bit_generator), 1, perturbed=True
    )
    env.reset()
    np.testing.assert_array_equal(env.physics.data.qpos, start.qpos[0])


@pytest.mark.parametrize("variant", [None, "planning"])
def test_the_action_noise_wrapper(variant: tsbench.Variant | None) -> None:
    """Its noise is drawn from the environment's seed."""

    def noisy(seed: int) -> list[bytes]:
        env = action_noise.Wrapper(tsbench.load("laikago_walk", variant, seed=seed), scale=0.1)
        env.reset()
        return trace(env, actions(env, 4))

    assert noisy(1) == noisy(1)
    assert all(one != other for one, other in zip(noisy(1), noisy(2), strict=True))
    plain = tsbench.load("laikago_walk", variant, seed=1)
    plain.reset()
    draws = np.random.RandomState(np.random.default_rng(1).bit_generator)
    given = actions(plain, 4)
    expected = [a + draws.normal(scale=np.full(a.shape, 0.1 * 2.0)) for a in given]
    assert noisy(1) == trace(plain, np.clip(expected, -1.0, 1.0))


def test_shimmys_seeds_decide() -> None:
    """`reset(seed=...)` of Shimmy's environment replaces the task's generator."""

    def starts(seed: int) -> list[np.ndarray]:
        made = tsbench.load("laikago_walk", perturbed=True, seed=99)
        env = DmControlCompatibilityV0(action_noise.Wrapper(made, scale=0.1))
        observations = [env.reset(seed=seed)[0]["observations"]]
        observations += [env.step(env.action_space.low)[0]["observations"] for _ in range(3)]
        return [*observations, env.reset()[0]["observations"]]

    first, again, other = starts(1), starts(1), starts(2)
    np.testing.assert_array_equal(first, again)
    assert not np.any(first[0][:12] == other[0][:12])
    assert not np.any(first[0][:12] == first[-1][:12])
    rng = np.random.Generator(np.random.RandomState(1)._bit_generator)
    expected = tasks.make("laikago_walk").start(rng, 1, perturbed=True)
    np.testing.assert_array_equal(first[0][:12], expected.qpos[0, 7:])


# Other wrappers


def test_the_pixels_wrapper() -> None:
    """It renders before the first reset, and its pictures follow the state."""
    size = {"height": 48, "width": 64, "camera_id": 0}
    env = pixels.Wrapper(tsbench.load("rocket_navigation", seed=0), False, render_kwargs=size)
    first = env.reset().observation
    assert env.observation_spec()["pixels"].shape == first["pixels"].shape == (48, 64, 3)
    for _ in range(30):
        last = env.step(np.array([1.0, 0.6])).observation
    plain = tsbench.load("rocket_navigation", seed=0)
    plain.reset()
    for _ in range(30):
        expected = values(plain.step(np.array([1.0, 0.6])))
    np.testing.assert_array_equal(last["observations"], expected)
    np.testing.assert_array_equal(last["pixels"], plain.physics.render(**size))
    assert np.any(first["pixels"] != last["pixels"])


def test_the_action_scale_wrapper() -> None:
    scaled = action_scale.Wrapper(tsbench.load("laikago_walk"), minimum=-2.0, maximum=2.0)
    plain = tsbench.load("laikago_walk")
    scaled.reset()
    plain.reset()
    given = np.round(64.0 * actions(plain, 3)) / 64.0  # scaled without a rounding error
    assert trace(scaled, 2.0 * given) == trace(plain, given)


def test_the_profiling_wrapper() -> None:
    """It gives MuJoCo a clock in Python, which many simulations on threads cannot call: they say so
    in one line."""
    timed = mujoco_profiling.Wrapper(tsbench.load("laikago_walk"))
    try:
        timed.reset()
        seconds, steps = timed.step(np.zeros(12)).observation["step_timing"]
        assert seconds > 0.0
        assert steps == 20
        with pytest.raises(TsbenchError, match=r"cannot go on: mjcb_time .*set_mjcb_time\(None\)"):
            tsbench.load_batched("rocket_navigation", count=2).reset()
    finally:
        enable_timer(False)
    tsbench.load_batched("rocket_navigation", count=2).reset()


@pytest.mark.parametrize("variant", [None, "planning"])
def test_the_viewers_runtime(variant: tsbench.Variant | None) -> None:
    """What `dm_control.viewer` drives behind its window: time runs, an episode ends, and the next
    one begins."""
    env = tsbench.load("rocket_navigation", variant, distance=3.0)
    run = runtime.Runtime(env, lambda time_step: -np.ones(env.action_spec().shape))
    errors: list[Any] = []
    run.on_error += errors.append
    for _ in range(2):
        before = -1.0
        for _ in range(1000):
            run.tick(0.05, paused=False)
            if run.state == runtime.State.STOPPED:
                break
            assert run.get_time() >= before
            before = run.get_time()
        assert run.state == runtime.State.STOPPED
        assert run.get_time() == pytest.approx(env.task.state.time[0])
        assert run.get_time() > 0.5
        run.restart()
    assert not errors


# The state has one home.


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", one_of_each_kind())
def test_a_state_is_the_whole_state(
    load: Callable[..., Any], name: str, variant: tsbench.Variant | None
) -> None:
    """Another environment that is put into it goes on alike to the last bit: observations, rewards,
    the end of the episode, and what its course was worth."""
    env, other = (load(name, variant, seed=seed) for seed in (1, 2))
    env.reset()
    other.reset()
    given = actions(env, 24)
    trace(env, given[:9])
    trace(other, -given[:4])
    state = env.physics.get_state()
    other.physics.set_state(state)
    assert other.physics.get_state().tobytes() == state.tobytes()
    assert same(state_of(other), state_of(env))
    assert values_now(other).tobytes() == values_now(env).tobytes()
    assert other.task.quality() == env.task.quality()
    assert trace(other, given[9:]) == trace(env, given[9:])
    assert other.task.spared() == env.task.spared()
    assert other.task.quality() == env.task.quality()


def values_now(env: Any) -> np.ndarray:
    (observation,) = env.task.get_observation(env.physics).values()
    return np.asarray(observation)


def test_back_from_the_end_of_an_episode() -> None:
    """As a search over actions needs it: the next step goes on from the state, and does not begin a
    new episode."""
    env: Any = tsbench.load("rocket_navigation", distance=3.0)
    env.reset()
    trace(env, actions(env, 30))
    state = env.physics.get_state()
    given = actions(env, 9, seed=1)
    expected = trace(env, given)
    assert env.over
    with env.physics.reset_context():
        env.physics.set_state(state)
    assert not env.over
    assert trace(env, given) == expected
    assert env.over
    assert env.step(given[0]).first()


def test_a_state_before_the_first_reset() -> None:
    made = tsbench.load("laikago_trot")
    assert np.isfinite(values_now(made)).all()
    reached = tsbench.load("laikago_trot")
    reached.reset()
    trace(reached, actions(reached, 3))
    assert made.physics.get_state().shape == reached.physics.get_state().shape
    made.physics.set_state(reached.physics.get_state())
    given = actions(made, 3, seed=1)
    assert trace(made, given) == trace(reached, given)


def test_mujocos_own_signatures() -> None:
    """They set that part of mujoco's state; the task's clock and memory stay."""
    env, other = (tsbench.load("laikago_walk") for _ in range(2))
    given = actions(env, 6)
    for one in (env, other):
        one.reset()
        trace(one, given[:3])
    clock, position = env.task.state.time.copy(), env.physics.data.qpos.copy()
    part = int(mujoco.mjtState.mjSTATE_QVEL)
    still = np.zeros_like(env.physics.get_state(part))
    env.physics.set_state(still, part)
    other.physics.data.qvel[:] = 0.0
    other.physics.forward()
    np.testing.assert_array_equal(values_now(env), values_now(other))
    np.testing.assert_array_equal(env.task.state.time, clock)
    np.testing.assert_array_equal(env.physics.data.qpos, position)
    assert not env.task.state.joint_velocity.any()
    assert trace(env, given[3:]) == trace(other, given[3:])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda state, env: state[:-1], r"a state of laikago_walk has the shape \(\d+,\), not"),
        (lambda state, env: np.append(env.physics.data.qpos, env.physics.data.qvel), "has the sha"),
        (lambda state, env: np.where(np.arange(state.size) == 3, np.nan, state), "is not finite"),
        (lambda state, env: np.where(np.arange(state.size) == 60, np.inf, state), "is not finite"),
    ],
)
def test_a_refused_state_changes_nothing(
    spoil: Callable[[np.ndarray, Any], np.ndarray], message: str
) -> None:
    env, undisturbed = (tsbench.load("laikago_walk") for _ in range(2))
    given = actions(env, 8)
    for one in (env, undisturbed):
        one.reset()
        trace(one, given[:4])
    with pytest.raises(TsbenchError, match=message):
        env.physics.set_state(spoil(env.physics.get_state(), env))
    assert trace(env, given[4:]) == trace(undisturbed, given[4:])


def test_positions_set_as_dm_control_has_it() -> None:
    """The robot is lifted by a metre between two steps: it sees that at once, and then falls. Its
    clock and its filter stay."""
    env, other = (tsbench.load("laikago_walk") for _ in range(2))
    given = actions(env, 5)
    for one in (env, other):
        one.reset()
        trace(one, given)
    before = env.task.state
    with env.physics.reset_context():
        env.physics.data.qpos[:] = other.physics.data.qpos + np.eye(19)[2]
        env.physics.data.qvel[:] = other.physics.data.qvel
    lifted = values_now(env)
    assert env.task.state.base_position[0, 2] == before.base_position[0, 2] + 1.0
    up = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(env.task.state.feet, before.feet + up, atol=1e-12)
    for part in ("time", "filter"):
        np.testing.assert_array_equal(getattr(env.task.state, part), getattr(before, part))
    other.physics.data.qpos[2] += 1.0
    other.physics.forward()
    assert lifted.tobytes() == values_now(other).tobytes()
    assert trace(env, given) == trace(other, given)


def test_a_pose_of_the_plan_follows_from_its_abstract_state() -> None:
    """So positions that somebody set are undone, and the clearest rule stays: s' = s + a."""
    env, other = (tsbench.load("rocket_navigation", "planning") for _ in range(2))
    given = actions(env, 6)
    for one in (env, other):
        one.reset()
        trace(one, given[:3])
    env.physics.data.qpos[:] += 1.0
    env.physics.forward()
    assert values_now(env).tobytes() == values_now(other).tobytes()
    np.testing.assert_array_equal(env.physics.data.qpos, other.physics.data.qpos)
    assert trace(env, given[3:]) == trace(other, given[3:])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("variant", [None, "planning"])
def test_a_copied_environment_goes_on_alike(
    copied: Callable[[Any], Any], variant: tsbench.Variant | None
) -> None:
    env = tsbench.load("rocket_navigation", variant, seed=3)
    env.reset()
    given = actions(env, 12)
    trace(env, given[:5])
    twin = copied(env)
    assert trace(twin, given[5:]) == trace(env, given[5:])
    assert twin.control_timestep() == env.control_timestep() == twin.task.mdp.timestep
    twin.physics.set_state(env.physics.get_state())
    assert twin.task.random.normal() == env.task.random.normal()
    physics = env.physics.copy()  # mere physics
    state = physics.get_state()
    assert state.shape == (physics.model.nq + physics.model.nv,)
    physics.set_state(np.zeros_like(state))
    assert trace(twin, given) == trace(env, given)


def test_forces_of_the_user_act() -> None:
    """A push by hand, written where MuJoCo has it, lasts until it is taken back."""
    env, other = (tsbench.load("laikago_walk") for _ in range(2))
    env.reset()
    other.reset()
    env.physics.named.data.xfrc_applied["trunk", 1] = 50.0
    trace(env, actions(env, 6))
    trace(other, actions(other, 6))
    assert env.physics.data.qpos[1] > other.physics.data.qpos[1] + 0.005
    env.reset()
    assert not env.physics.data.xfrc_applied.any()


def test_a_refused_action_leaves_the_episode_as_it_is() -> None:
    env, undisturbed = (environment(tasks.make("laikago_trot"), seed=0) for _ in range(2))
    given = actions(env, 6)
    for one in (env, undisturbed):
        one.reset()
        trace(one, given[:3])
    before = env.physics.get_state()
    for refused in (np.full(12, np.nan), np.zeros(11), "left", None, np.zeros((1, 12))):
        with pytest.raises(TsbenchError, match=r"^(the action|action of environment 0) "):
            env.step(refused)
    assert env.physics.get_state().tobytes() == before.tobytes()
    assert trace(env, given[3:]) == trace(undisturbed, given[3:])
