"""The dm_control environment: endings, starts, and agreement of states with the physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import tsbench
from tsbench import tasks
from tsbench.core.motion import ReferenceMotion
from tsbench.sim.single import PhysicsAdapter, environment
from tsbench.sim.tracking import Imitation
from tsbench.tasks.laikago import LaikagoState
from tsbench.tasks.rocket import Rocket


def adapter(env: Any) -> PhysicsAdapter:
    return cast(PhysicsAdapter, env.task)


def test_the_horizon_is_counted_in_steps() -> None:
    task = replace(cast(Rocket, tasks.make("rocket_navigation")), horizon=5)
    env = environment(task, 0)
    for _ in range(2):
        env.reset()
        time_steps = [env.step(np.zeros(2)) for _ in range(5)]
        assert [time_step.last() for time_step in time_steps] == [False] * 4 + [True]
        assert time_steps[-1].discount == 1.0
        assert adapter(env).state.time[0] == pytest.approx(0.1)


def test_a_terminal_state_at_the_last_step_is_terminal() -> None:
    """A rocket leaves the world in its last step, or would leave it in the step after."""
    rocket = cast(Rocket, tasks.make("rocket_navigation"))
    falling = tsbench.load("rocket_navigation")
    falling.reset()
    steps = 1
    while not falling.step(np.zeros(2)).last():
        steps += 1
    for horizon, length, discount in ((steps, steps, 0.0), (steps - 1, steps - 1, 1.0)):
        env = environment(replace(rocket, horizon=horizon), 0)
        env.reset()
        count = 1
        while not (time_step := env.step(np.zeros(2))).last():
            count += 1
        assert (count, time_step.discount) == (length, discount)


def test_perturbed_starts_follow_one_another() -> None:
    """One generator serves all episodes: the second starts elsewhere, the same in every run."""
    starts = []
    for _ in range(2):
        env = tsbench.load("laikago_walk", seed=3, perturbed=True)
        env.reset()
        first = env.physics.data.qpos.copy()
        env.step(np.ones(12))
        env.reset()
        starts.append((first, env.physics.data.qpos.copy()))
    np.testing.assert_array_equal(starts[0], starts[1])
    assert not np.any(starts[0][0][7:] == starts[0][1][7:])
    rng = np.random.default_rng(3)
    expected = [tasks.make("laikago_walk").start(rng, 1, perturbed=True).qpos[0] for _ in range(2)]
    np.testing.assert_array_equal(starts[0], expected)


def after_five_steps(name: str) -> tuple[Any, Any]:
    """An environment and its state."""
    env = tsbench.load(name, seed=0, perturbed=True)
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step(rng.uniform(-1.0, 1.0, env.action_spec().shape))
    return env, adapter(env).state


def test_laikagos_state_is_that_of_the_physics() -> None:
    """Observations and sensors are current, not a substep behind."""
    env, state = after_five_steps("laikago_trot")
    data = env.physics.data
    assert isinstance(state, LaikagoState)
    np.testing.assert_array_equal(state.base_position[0], data.qpos[:3])
    np.testing.assert_array_equal(state.joint_velocity[0], data.qvel[6:])
    env.physics.forward()
    for index, foot in enumerate(("FR_foot", "FL_foot", "RR_foot", "RL_foot")):
        np.testing.assert_array_equal(state.feet[0, index], env.physics.named.data.site_xpos[foot])
    np.testing.assert_array_equal(state.com[0], env.physics.named.data.subtree_com["trunk"])
    # The actuators get the filtered action, which the state stores.
    np.testing.assert_array_equal(
        data.ctrl, np.tile([0.0, 0.67, -1.33], 4) + state.filter[0, 24:36]
    )


def test_the_rockets_state_is_that_of_the_physics() -> None:
    env, state = after_five_steps("rocket_obstacles")
    data = env.physics.data
    np.testing.assert_array_equal(state.position[0], data.qpos[:2])
    np.testing.assert_array_equal(state.velocity[0], data.qvel[:2])
    before = data.sensordata.copy()
    env.physics.forward()
    np.testing.assert_array_equal(data.sensordata, before)
    np.testing.assert_array_equal(state.clearance[0], before)


def test_an_episode_along_the_reference_is_shorter(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    task = Imitation(tasks.make("laikago_trot"), naive_reference("laikago_trot"))
    env = environment(task, 1)
    lengths = []
    for _ in range(6):
        env.reset()
        first = round(adapter(env).state.time[0] * 30)
        steps = 1
        while not (time_step := env.step(np.zeros(12))).last():
            steps += 1
        if time_step.discount == 1.0:
            assert first + steps == task.horizon
            lengths.append(steps)
    assert len(set(lengths)) > 2


def test_actions_of_other_shapes_are_refused() -> None:
    """numpy would broadcast one number over all joints, and the rocket would ignore surplus
    ones."""
    trot = tsbench.load("laikago_trot")
    trot.reset()
    with pytest.raises(tsbench.TsbenchError, match=r"action has shape \(1,\), not \(12,\)"):
        trot.step(np.zeros(1))
    rockets = tsbench.load_batched("rocket_navigation", count=2)
    rockets.reset()
    for shape in ((2, 5), (1, 2), (2,)):
        with pytest.raises(tsbench.TsbenchError, match=r"not \(2, 2\)"):
            rockets.step(np.zeros(shape))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"variant": "imitation", "reference": "plan.npz"}, "must be a ReferenceMotion or None"),
        ({"push": "100N@0.5s:+y"}, "push must be a Push or None, not str"),
        ({"seed": -1}, "seed must not be negative, not -1"),
        ({"distance": "far"}, "distance of laikago_trot must be a number, not 'far'"),
        ({"count": 0}, "count must be at least 1, not 0"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], message: str) -> None:
    load: Any = tsbench.load_batched if "count" in arguments else tsbench.load
    with pytest.raises(tsbench.TsbenchError, match=message):
        load("laikago_trot", **arguments)


def test_actions_of_any_number_type() -> None:
    results = []
    for action in ([1, 0], np.array([1, 0]), np.array([1.0, 0.0], np.float32)):
        env = tsbench.load("rocket_navigation")
        env.reset()
        results.append(env.step(action).observation)
    assert all(
        np.array_equal(next(iter(result.values())), next(iter(results[0].values())))
        for result in results
    )
