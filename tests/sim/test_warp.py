"""Physics on mujoco-warp is the same MDP as in C MuJoCo.

It runs on warp's CPU device, with the kernels that a GPU runs. Tolerances are in SI units.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import mujoco
import numpy as np
import pytest

from tsbench import TsbenchError, cli, tasks
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.flips import flips
from tsbench.evaluation.protocol import SMOKE
from tsbench.evaluation.robustness import mass_scale
from tsbench.sim.agreement import (
    Gaps,
    disagreements,
    one_step_gaps,
    whole_episode_gaps,
)
from tsbench.sim.change import Change
from tsbench.sim.disturbed import Disturbances, physics_factors, variants
from tsbench.sim.physics import Physics
from tsbench.sim.push import Push
from tsbench.testing.episodes import one_of_each_kind

pytest.importorskip("mujoco_warp", reason="needs the extra: tsbench[gpu]")

import torch

from tsbench.sim.device import DeviceEnvironment
from tsbench.sim.warp import HostPhysics, WarpPhysics, Worlds, capacity

pytestmark = pytest.mark.warp

ON_CPU = partial(HostPhysics, device="cpu")
EVERYTHING = Disturbances(
    push=200.0, calm=0.2, interval=0.5, mass=0.2, friction=0.5, strength=0.1, latency=3
)


def made(name: str, count: int, disturbances: Disturbances | None = None, **more: Any) -> Any:
    """WarpPhysics from perturbed starts, and the states in which all its episodes begin."""
    physics: WarpPhysics[Any] = WarpPhysics(
        tasks.make(name), count, device="cpu", pool=count, perturbed=True, threads=1,
        disturbances=disturbances, **more,
    )  # fmt: skip
    return physics, physics.begin(torch.arange(count), torch.ones(count, dtype=torch.bool))


def small_actions(physics: WarpPhysics[Any], steps: int) -> list[torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    shape = (len(physics.diverged), physics.task.action_size)
    return [0.4 * torch.rand(shape, generator=rng) - 0.2 for _ in range(steps)]


def same(one: Any, other: Any, rows: Any = slice(None)) -> bool:
    """The same bits in all quantities of two states."""
    return all(torch.equal(v[rows], getattr(other, name)[rows]) for name, v in vars(one).items())


def check(gaps: Gaps) -> None:
    assert len(gaps.reward) >= 100
    assert disagreements(gaps) == []


@pytest.mark.parametrize("name", tasks.names())
def test_each_step_agrees_with_c_mujoco(name: str) -> None:
    check(one_step_gaps(tasks.make(name), ON_CPU))


@pytest.mark.parametrize("name", tasks.names())
def test_pushes_and_changed_physics_agree(name: str) -> None:
    task = tasks.make(name)
    change = Change(mass=1.2, friction=0.5, strength=0.8)
    check(
        one_step_gaps(
            task, ON_CPU, change=change, pushed=500.0 * mass_scale(task), episodes=1, seed=1
        )
    )


@pytest.mark.parametrize("name", ["rocket_navigation", "rocket_obstacles"])
def test_whole_flights_agree(name: str) -> None:
    """Errors add up, but nothing in a flight makes them grow."""
    gaps = whole_episode_gaps(tasks.make(name), ON_CPU)
    for quantity, apart in {**gaps.state, "observation": gaps.observation}.items():
        assert apart.max() < 1e-3, quantity
    assert gaps.reward.max() < 1e-4
    assert not gaps.ending.any()


def test_a_push_by_hand() -> None:
    """A falling rocket of 5 kg, damped by 2.5 N s/m: a step in which a push of 10 N begins at half
    time gives it half the impulse, and the next one the whole."""
    task = tasks.make("rocket_navigation")
    physics: Any = ON_CPU(task, 2)
    physics.push = Push(
        np.array([9.0, 0.01]), np.array([0.1, 0.1]), np.array([[10.0, 0.0, 0.0]] * 2)
    )
    state = physics.begin(np.random.default_rng(0), np.arange(2))
    speed = 0.0
    for share in (0.5, 1.0):
        state = physics.advance(state, np.zeros((2, 2)))
        speed += 0.02 * (share * 10.0 - 2.5 * speed) / (5.0 + 0.02 * 2.5)
        np.testing.assert_allclose(state.velocity[:, 0], [0.0, speed], atol=1e-6)


@pytest.mark.parametrize("name", one_of_each_kind())
def test_worlds_have_their_own_physics(name: str) -> None:
    """One action from one start: each world goes where C MuJoCo goes with that world's model."""
    disturbances, count = Disturbances(mass=0.3, friction=0.5, strength=0.2), 6
    warp, _ = made(name, count, disturbances, seed=4)
    task = warp.task
    factors = physics_factors(disturbances, np.random.default_rng(4), count)
    models = variants(warp.worlds.model, factors)
    np.testing.assert_allclose(torch.stack(warp.unseen(), 1).numpy(), factors, rtol=1e-6)
    physics: Physics[Any] = Physics(task, count, threads=1)
    physics.batch.set_models(models)
    start = task.start(np.random.default_rng(0), 1, perturbed=True)
    rows, none = np.arange(count), np.zeros(count, int)
    state = physics.place(rows, start.rows(none))
    warp.worlds.qpos[:], warp.worlds.qvel[:] = (
        torch.tensor(values.repeat(count, axis=0)) for values in (start.qpos, start.qvel)
    )
    action = np.tile(np.linspace(1.0, -1.0, task.action_size), (count, 1))
    here = state.replace(**{n: torch.tensor(v).float() for n, v in vars(state).items()})
    for _ in range(4):
        here = warp.advance(here, torch.tensor(action).float())
        state = physics.advance(state, action)
    wanted, found = task.observation(state), task.observation(here).double().numpy()
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    assert len(np.unique(np.round(wanted[:, :30].sum(axis=1), 3))) == count


def test_room_for_contacts_and_constraints_by_hand() -> None:
    """Laikago: eight spheres and the corners of a box meet the floor, with four rows each, and
    twelve joints have limits. A rocket has two obstacles, each with a sensor of its distance."""

    def room(name: str) -> tuple[int, int]:
        return capacity(tasks.make(name).spec().compile())

    assert room("laikago_trot") == (8 + 8, 4 * 16 + 12)
    assert room("rocket_navigation") == (1, 1)  # at least
    assert room("rocket_obstacles") == (2 + 2, 4 * 2)


@pytest.mark.parametrize("too_little", [{"contacts": 2}, {"rows": 4}])
def test_too_little_room_is_an_error(too_little: dict[str, Any]) -> None:
    physics, state = made("laikago_trot", 2, **too_little)
    physics.check()
    physics.worlds.qpos[:, 2] = 0.3  # feet and knees in the floor
    physics.advance(state, torch.zeros(2, 12))
    with pytest.raises(TsbenchError, match=r"the physics ran out of room .* a world: let fewer"):
        physics.check()


@pytest.mark.parametrize("name", one_of_each_kind())
@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e12])
def test_a_world_that_diverges_spoils_no_other(name: str, number: float) -> None:
    physics, state = made(name, 6)
    first, second = small_actions(physics, 2)
    before = physics.snapshot()
    wanted = physics.advance(state, first)
    after = physics.advance(wanted, second)
    physics.restore(before)
    physics.worlds.qvel[2, -1] = number
    found = physics.advance(state, first)
    assert physics.diverged.tolist() == [False, False, True, False, False, False]
    assert physics.warned() == {"diverged": 1}
    others = torch.arange(6) != 2
    assert same(found, wanted, others)
    assert same(found, state, ~others)  # it keeps the state before
    # Its next episode is as good as any, and the others go on.
    fresh = physics.begin(torch.arange(6), ~others)
    kept = found.replace(
        **{n: torch.where(others.reshape(-1, *[1] * (v.ndim - 1)), getattr(found, n), v)
           for n, v in vars(fresh).items()}
    )  # fmt: skip
    action = torch.where(others[:, None], second, first)
    found = physics.advance(kept, action)
    assert not physics.diverged.any()
    assert same(found, after, others)
    assert same(found, wanted, ~others)


@pytest.mark.parametrize("name", one_of_each_kind())
def test_a_snapshot_goes_on_to_the_same_bits(name: str) -> None:
    physics, state = made(name, 6, EVERYTHING, seed=3)
    actions = small_actions(physics, 12)

    def go_on(state: Any, actions: list[torch.Tensor]) -> list[Any]:
        states = []
        for number, action in enumerate(actions):
            state = physics.advance(state, action)
            if number % 3 == 1:  # episodes end in some rows
                rows = torch.arange(6) % 2 == number % 2
                fresh = physics.begin(torch.arange(6).flip(0), rows)
                state = replace(
                    state,
                    **{n: torch.where(rows.reshape(-1, *[1] * (v.ndim - 1)), getattr(fresh, n), v)
                       for n, v in vars(state).items()},
                )  # fmt: skip
            states.append(state)
        return states

    state = go_on(state, actions[:5])[-1]
    snapshot = physics.snapshot()
    wanted = go_on(state, actions[5:])
    other, _ = made(name, 6, EVERYTHING, seed=3)
    for again in (physics, other):
        physics = again
        physics.restore(snapshot)
        found = go_on(state, actions[5:])
        assert all(same(*pair) for pair in zip(found, wanted, strict=True))
    assert physics.substeps == 12 * 6 * physics.plant.substeps


def test_disturbances_are_drawn_for_each_episode() -> None:
    """As those of `DisturbedPhysics` are; and an episode's depend on nothing that its world or
    another one did before."""
    count = 400
    disturbances = Disturbances(push=20.0, calm=0.3, interval=0.5, latency=3)
    physics, _ = made("rocket_navigation", count, disturbances, seed=1)
    which, everyone = torch.arange(count), torch.ones(count, dtype=torch.bool)

    def drawn() -> list[torch.Tensor]:
        return [v.clone() for v in (physics.worlds.force, physics.worlds.first, physics._latency)]

    force, first, latency = drawn()
    size = force.norm(dim=-1)
    assert not force[..., 1].any()  # the rocket's plane
    assert 19.0 < size.max() <= 20.0
    calm = ~size.any(dim=1)
    assert 0.2 < calm.float().mean() < 0.4
    assert 9.0 < size[~calm].mean() < 11.0
    angle = torch.atan2(force[..., 2], force[..., 0])[size > 0.0]
    assert torch.histc(angle, 4, -np.pi, np.pi).min() > 0.22 * len(angle)
    assert 0.0 <= first.min() < 0.02
    assert 0.48 < first.max() <= 0.5
    assert torch.bincount(latency).min() > 70
    assert len(torch.bincount(latency)) == 4
    physics.begin(which, everyone)
    second = drawn()
    assert (second[0] != force).any(dim=(1, 2)).float().mean() > 0.7
    again, _ = made("rocket_navigation", count, disturbances, seed=1)
    physics = again
    physics.begin(which, which < 100)
    for found, wanted in zip(drawn(), second, strict=True):
        assert torch.equal(found[:100], wanted[:100])
    assert torch.equal(drawn()[0][100:], force[100:])


def test_pushes_and_latency_grow_over_the_first_steps() -> None:
    """After a quarter of the steps of `rise`, pushes have at most a quarter of the full force, and
    a latency of up to 2 steps is the whole part of a uniform number below 1 + 2 / 4: 0 or 1."""
    count = 50
    physics, state = made("rocket_navigation", count, Disturbances(push=20.0, rise=4000, latency=2))
    for bound, latest in ((0.0, 0), (5.0, 1), (10.0, 1), (15.0, 2), (20.0, 2), (20.0, 2)):
        physics.begin(torch.arange(count), torch.ones(count, dtype=torch.bool))
        largest = float(physics.worlds.force.norm(dim=-1).max())
        assert 0.9 * bound <= largest <= bound + 1e-5
        assert set(physics._latency.tolist()) == set(range(latest + 1))
        for _ in range(20):  # 1,000 environment steps
            state = physics.advance(state, torch.zeros(count, 2))


def test_actions_come_late_by_the_latency_of_the_episode() -> None:
    physics, state = made("rocket_navigation", 40, Disturbances(latency=3))
    main = torch.linspace(0.6, 1.0, 5)
    late = physics._latency
    assert set(late.tolist()) == {0, 1, 2, 3}
    assert [one.tolist() for one in physics.unseen()] == [late.tolist()]
    for step in range(5):
        state = physics.advance(
            state, torch.stack([main[step] * torch.ones(40), torch.zeros(40)], 1)
        )
        due = torch.where(late <= step, main[(step - late).clip(0)], torch.zeros(40))
        torch.testing.assert_close(physics.worlds.ctrl[:, 0], 50.0 * due)
    physics.begin(torch.arange(40), torch.ones(40, dtype=torch.bool))
    assert not physics._actions.any()


def test_critics_see_what_disturbs_an_episode() -> None:
    physics, _ = made("rocket_navigation", 6, EVERYTHING)
    environment: Any = DeviceEnvironment(physics.task, physics, 6, 0, torch.device("cpu"))
    observation, value = environment.reset()
    for _ in range(3):
        assert torch.equal(value[:, -4:], torch.stack(physics.unseen(), 1))
        assert torch.equal(value[:, :-4], physics.task.value_observation(environment.state))
        assert observation.shape == (6, physics.task.observation_size)
        transition = environment.step(torch.zeros(6, 2))
        observation, value = transition.observation, transition.value_observation


def test_starts_are_those_of_the_task() -> None:
    """The pool holds what C MuJoCo makes of the task's own starts, and time may begin late."""
    physics, state = made("laikago_trot", 8)
    start = physics.task.start(np.random.default_rng(0), 8, perturbed=True)
    wanted = Physics(physics.task, 8, threads=1).place(np.arange(8), start)
    for name, values in vars(wanted).items():
        np.testing.assert_allclose(getattr(state, name).numpy(), values, atol=1e-6)
        assert getattr(state, name).dtype == torch.float32
    some = torch.arange(8) % 2 == 0
    before = physics.worlds.qpos.clone()
    physics.begin(torch.zeros(8, dtype=torch.int64), some)
    assert torch.equal(physics.worlds.qpos[~some], before[~some])
    assert torch.equal(physics.worlds.qpos[some], before[:1].expand(4, -1))


def test_rows_that_are_not_stepped_stay_where_they_are() -> None:
    task = tasks.make("rocket_obstacles")
    physics: Any = ON_CPU(task, 4)
    state = physics.begin(np.random.default_rng(0), np.arange(4))
    state = physics.advance(state, np.ones((4, 2)))
    qpos, qvel = physics.pose()
    some = np.array([3, 1])
    found = physics.advance(state.rows(some), np.zeros((2, 2)), some)
    after, speed = physics.pose()
    np.testing.assert_array_equal(after[[0, 2]], qpos[[0, 2]])
    np.testing.assert_array_equal(speed[[0, 2]], qvel[[0, 2]])
    np.testing.assert_array_equal(found.position, after[some, :2])
    assert physics.substeps == 6
    physics.worlds.qpos[1, 0] = float("nan")
    kept = physics.advance(found, np.zeros((2, 2)), some)
    assert physics.diverged.tolist() == [1]
    np.testing.assert_array_equal(kept.position[1], found.position[1])
    assert np.isfinite(kept.position).all()


def test_a_score_is_played_in_the_second_engine() -> None:
    task = tasks.make("rocket_obstacles")

    def climb(observation: np.ndarray) -> np.ndarray:
        return np.tile([0.6, 0.0], (len(observation), 1))

    certified = evaluate(climb, task, protocol=SMOKE, threads=1)
    other = evaluate(climb, task, protocol=SMOKE.elsewhere("warp"), engine=ON_CPU)
    assert other.protocol == "smoke in warp"
    assert other.normalized_reward != certified.normalized_reward
    assert other.normalized_reward == pytest.approx(certified.normalized_reward, rel=1e-3)
    assert [one.flipped for one in flips(certified, other)] == [0] * 5


def test_the_command_counts_flipped_verdicts(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["evaluate", "zero", "task=rocket_navigation", "--protocol", "smoke"]
    assert cli.main([*words, "--physics", "warp"]) == 0
    assert "in physics warp, which is never ranked" in capsys.readouterr().out
    monkeypatch.delitem(sys.modules, "tsbench.sim.warp")
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    assert cli.main([*words, "--physics", "warp"]) == 2
    error = capsys.readouterr().err
    assert error == "tsbench: physics on warp needs the package mujoco_warp: install tsbench[gpu]\n"


def test_a_recording_that_does_something_else_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsbench.sim.warp.wp.capture_launch", lambda graph: None)
    with pytest.raises(TsbenchError, match="recorded another step than it was given"):
        ON_CPU(tasks.make("rocket_navigation"), 1)


def test_devices_that_there_are_not() -> None:
    make: Callable[..., Any] = partial(HostPhysics, tasks.make("rocket_navigation"), 1)
    with pytest.raises(TsbenchError, match="there is no cuda:99: torch finds"):
        make(device="cuda:99")
    with pytest.raises(TsbenchError, match="runs on cpu or cuda, not on meta"):
        make(device="meta")


SENSORS = """
<mujoco>
  <option timestep="0.01" integrator="Euler"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="ball" pos="0 0 0.3">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.1" mass="1"/>
      <site name="here" pos="0.05 0 0"/>
      <body pos="0.1 0 0">
        <joint name="arm" type="hinge" axis="0 1 0" range="-0.5 0.5" limited="true"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0" mass="0.2" contype="0"
              conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="arm" gear="3"/></actuator>
  <sensor>
    <jointpos joint="arm"/> <jointvel joint="arm"/> <jointlimitpos joint="arm"/>
    <framepos objtype="site" objname="here"/> <framelinvel objtype="site" objname="here"/>
    <accelerometer site="here"/> <gyro site="here"/> <velocimeter site="here"/>
    <subtreecom body="ball"/> <distance geom1="ball" geom2="floor" cutoff="2"/>
    <touch site="here"/>
  </sensor>
</mujoco>
"""


def test_sensors_of_any_kind_are_current() -> None:
    """After three physics steps, positions and velocities are those at the end, and accelerations
    those of the last step."""
    model = mujoco.MjModel.from_xml_string(SENSORS)
    data = mujoco.MjData(model)
    worlds = Worlds(model, 1, device=torch.device("cpu"), pushed="ball", timestep=0.03, substeps=3)
    data.qvel[:3] = worlds.qvel[0, :3] = torch.tensor([0.4, -0.2, 0.1])
    data.ctrl[:] = 1.0
    worlds.ctrl[:] = 1.0
    for _ in range(12):
        for _ in range(3):
            mujoco.mj_step(model, data)
        lagging = data.sensordata.copy()
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_sensorPos(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_sensorVel(model, data)
        worlds.step()
        found = worlds.sensordata[0].numpy()
        for sensor in range(model.nsensor):
            address, size = model.sensor_adr[sensor], model.sensor_dim[sensor]
            lags = model.sensor_needstage[sensor] == mujoco.mjtStage.mjSTAGE_ACC
            values = slice(address, address + size)
            wanted = (lagging if lags else data.sensordata)[values]
            np.testing.assert_allclose(found[values], wanted, atol=0.02 if lags else 5e-4)
    assert not worlds.diverged.any()
    worlds.check()


def test_sensors_of_a_model_are_current() -> None:
    """Each kind of sensor that a task's model has reads what C MuJoCo reads in the same place."""
    for name in one_of_each_kind():
        physics: Any = ON_CPU(tasks.make(name), 3)
        model = physics.worlds.model
        if not model.nsensor:
            continue
        start = physics.task.start(np.random.default_rng(0), 3, perturbed=True)
        physics.place(np.arange(3), start)
        for row in range(3):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = start.qpos[row], start.qvel[row]
            mujoco.mj_forward(model, data)
            found = physics.worlds.sensordata[row].numpy()
            np.testing.assert_allclose(found, data.sensordata, atol=1e-4)
