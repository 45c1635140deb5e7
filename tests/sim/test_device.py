"""Environments on a torch device, compared with the batched environment in numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from tsbench import tasks
from tsbench.core.errors import NotFiniteError
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.device import DeviceEnvironment, DeviceKinematics, at_device
from tsbench.sim.kinematic import Planning
from tsbench.testing.episodes import plannable_tasks
from tsbench.testing.operations import WAITING, Operations

CPU = torch.device("cpu")
ROWS, STARTS, SEED = 24, 64, 5


class SameStarts(Planning[Any]):
    """The planning variant in numpy, with the starts that the device's environment draws."""

    def __init__(self, name: str, explore: float) -> None:
        super().__init__(tasks.make(name), explore=explore)
        self.sampled = self.abstraction.sample(np.random.default_rng(SEED), STARTS)
        self.drawn = torch.Generator().manual_seed(SEED)

    def draw(self) -> None:
        which = torch.zeros(ROWS, dtype=torch.int64)
        self.which = which.random_(0, STARTS, generator=self.drawn).numpy()

    def begin(self, rng: np.random.Generator, rows: np.ndarray) -> Any:
        which = self.which[rows]
        sampled = np.flatnonzero(which < round(self.explore * STARTS))
        start = self.abstraction.start(len(rows))
        return start.updated(sampled, self.sampled.rows(which[sampled]))


def on_device(name: str, explore: float) -> DeviceEnvironment[Any]:
    planning: Planning[Any] = Planning(tasks.make(name), explore=explore)
    dynamics = DeviceKinematics(planning, ROWS, SEED, CPU, pool=STARTS)
    return DeviceEnvironment(planning, dynamics, ROWS, SEED, CPU)


def actions(environment: Any, steps: int, scale: float) -> np.ndarray:
    """Random walks that end episodes early in some rows."""
    rng = np.random.default_rng(1)
    size = environment.mdp.action_size
    drift = rng.uniform(-scale, scale, (ROWS, size))
    values = drift + rng.normal(0.0, 0.3, (steps, ROWS, size))
    return np.asarray(values.astype(np.float32))


@pytest.mark.parametrize("name", plannable_tasks())
@pytest.mark.parametrize("explore", [0.0, 0.75])
def test_agrees_with_the_batched_environment(name: str, explore: float) -> None:
    """Several episodes in a row from the same starts under the same actions, step for step."""
    device, host = on_device(name, explore), SameStarts(name, explore)
    batch = BatchedEnvironment(host, host, ROWS, seed=0)
    host.draw()
    expected = batch.reset()
    observation, value = device.reset()
    np.testing.assert_allclose(observation, expected, atol=1e-4)
    ends = terminals = 0
    for action in actions(device, device.mdp.horizon + 30, 1.0):
        host.draw()
        wanted = batch.step(action.astype(float))
        found = device.step(torch.from_numpy(action))
        assert found.observation.dtype == found.reward.dtype == torch.float32
        ended = found.terminal | found.truncated
        np.testing.assert_array_equal(found.terminal, wanted.terminal)
        np.testing.assert_array_equal(found.truncated, wanted.truncated)
        np.testing.assert_array_equal(np.flatnonzero(ended), wanted.ended)
        np.testing.assert_array_equal(found.spared, wanted.spared)
        np.testing.assert_array_equal(device.steps, batch.steps)
        np.testing.assert_array_equal(device.course.violated, batch.course.violated)
        np.testing.assert_allclose(found.reward, wanted.reward, atol=1e-4)
        np.testing.assert_allclose(found.quality, wanted.quality, atol=1e-4)
        np.testing.assert_allclose(found.observation, wanted.observation, atol=1e-4)
        value = host.value_observation(batch.state)
        np.testing.assert_allclose(found.value_observation, value, atol=1e-4)
        for field, last in vars(wanted.final).items():
            at_end = getattr(found.following, field)[wanted.ended]
            np.testing.assert_allclose(at_end, last, atol=1e-4)
        ends, terminals = ends + len(wanted.ended), terminals + int(wanted.terminal.sum())
    assert ends >= ROWS
    assert terminals > 0
    device.check()


@pytest.mark.parametrize("name", plannable_tasks())
def test_a_step_never_waits_for_the_device(name: str) -> None:
    device = on_device(name, 0.5)
    device.reset()
    first, second = (torch.from_numpy(action) for action in actions(device, 2, 1.0))
    device.step(first)  # constants move to the device
    with Operations() as seen:
        device.step(second)
    assert "where" in seen.names
    assert not seen.names & {*WAITING, "_to_copy"}


def test_waiting_would_be_seen() -> None:
    """By reading a value, by a shape that depends on values, and by a number from the host."""
    values = torch.ones(3)
    for wait in (lambda: bool(values.any()), values.nonzero, lambda: torch.tensor(1.0)):
        with Operations() as seen:
            wait()
        assert seen.names & WAITING


def test_a_share_of_the_episodes_begins_at_sampled_states() -> None:
    device = on_device("rocket_navigation", 0.5)
    observation, _ = device.reset()
    away = (observation[:, :2] != 0.0).any(dim=1)
    np.testing.assert_array_equal(away, device._which < STARTS // 2)
    assert 0 < away.sum() < ROWS
    device.dynamics.planning.explore = 0.0  # type: ignore[attr-defined]
    observation, _ = device.reset()
    assert not observation[:, :2].any()


def test_a_snapshot_goes_on_to_the_last_bit() -> None:
    device = on_device("laikago_trot", 0.75)
    device.reset()
    walk = [torch.from_numpy(action) for action in actions(device, 60, 1.0)]
    for action in walk[:20]:
        device.step(action)
    snapshot = device.snapshot()
    other = on_device("laikago_trot", 0.0)
    other.reset()
    other.restore(snapshot)
    for action in walk[20:]:
        ours, theirs = device.step(action), other.step(action)
        for one, another in zip(
            (ours.observation, ours.reward, ours.terminal),
            (theirs.observation, theirs.reward, theirs.terminal),
            strict=True,
        ):
            assert torch.equal(one, another)


def test_numbers_that_are_not_finite_are_found_at_the_end_of_the_rollout() -> None:
    device = on_device("rocket_navigation", 0.0)
    device.reset()
    action = torch.zeros(ROWS, 3)
    device.step(action)
    device.check()
    action[7, 1] = torch.nan
    device.step(action)
    device.step(torch.zeros(ROWS, 3))
    with pytest.raises(NotFiniteError, match="action of environment 7 was not finite") as caught:
        device.check()
    assert caught.value.arrays["wrong"].any()


def test_rows_whose_physics_diverged_end_without_reward() -> None:
    device = on_device("rocket_navigation", 0.0)
    device.reset()
    device.dynamics.diverged[3] = True
    transition = device.step(torch.zeros(ROWS, 3))
    assert transition.terminal.tolist() == [row == 3 for row in range(ROWS)]
    assert transition.reward[3] == 0.0
    assert (transition.reward != 0.0).sum() == ROWS - 1
    assert transition.spared.tolist() == [0] * ROWS
    assert device.steps.tolist() == [int(row != 3) for row in range(ROWS)]


def test_floats_become_float32_and_nothing_else_changes() -> None:
    state = tasks.make("rocket_obstacles").abstraction().start(2)  # type: ignore[attr-defined]
    moved = at_device(state, CPU)
    assert moved.position.dtype == torch.float32
    assert moved.clearance.shape == (2, 2)
