"""The batched simulation against the dm_control environment: equal floats over whole episodes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.core.motion import ReferenceMotion
from tsbench.core.state import Start
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.kinematic import Planning
from tsbench.sim.physics import Physics
from tsbench.sim.tracking import Imitation
from tsbench.testing.episodes import compare, plannable_tasks, play_batched, same

ROWS = 3


def test_equal_through_a_collision() -> None:
    """Rockets that fall onto an obstacle and roll off it."""
    task = tasks.make("rocket_obstacles")
    above = np.add(task.constants()["obstacles"][0], [0.0, 1.5])
    qpos = np.array([[*above, 0.0], [*above, 0.4], [above[0] + 0.7, above[1], 2.0]])
    starts = Start(np.zeros(ROWS), qpos, np.zeros((ROWS, 3)), np.zeros((ROWS, 0)))
    actions = np.zeros((task.horizon, ROWS, 2))
    states, _ = play_batched(task, starts, actions[:100])
    assert np.all(np.any([task.violated(state) for state in states], axis=0))
    compare(task, starts, actions)


@pytest.mark.parametrize("name", tasks.names())
def test_rows_do_not_know_each_other(name: str) -> None:
    """A row is equal for any number of threads, any other rows, and any order of rows."""
    task = tasks.make(name)
    rng = np.random.default_rng(0)
    starts = task.start(rng, 7, perturbed=True)
    actions = rng.uniform(-1.0, 1.0, (40, 7, task.action_size))
    states, rewards = play_batched(task, starts, actions, threads=1)
    threaded, _ = play_batched(task, starts, actions, threads=2)
    assert all(same(*pair) for pair in zip(states, threaded, strict=True))

    alone, alone_rewards = play_batched(task, starts.rows(slice(4, 5)), actions[:, 4:5])
    assert all(same(a.rows(slice(4, 5)), b) for a, b in zip(states, alone, strict=True))
    np.testing.assert_array_equal(rewards[:, 4:5], alone_rewards)

    order = np.array([3, 6, 0, 5, 1, 4, 2])
    shuffled = Start(*(getattr(starts, field.name)[order] for field in fields(Start)))
    permuted, permuted_rewards = play_batched(task, shuffled, actions[:, order])
    assert all(same(a.rows(order), b) for a, b in zip(states, permuted, strict=True))
    np.testing.assert_array_equal(rewards[:, order], permuted_rewards)


@pytest.mark.parametrize("name", plannable_tasks())
@pytest.mark.parametrize("variant", [None, "planning"])
def test_episodes_begin_anew(name: str, variant: tsbench.Variant | None) -> None:
    """Several episodes in a row: each equals that of a new environment."""
    batch = tsbench.load_batched(name, variant, count=2, threads=1)
    steps = batch.mdp.horizon + 50  # at least one whole episode of each
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1.0, 1.0, (steps, 2, batch.mdp.action_size))
    actions[30:, 0] = 0.0  # one row idles from here on
    observations, transitions = [batch.reset()], []
    for action in actions:
        transitions.append(batch.step(action))
        observations.append(transitions[-1].observation)
    episodes = 0
    for index in range(2):
        single = tsbench.load(name, variant)
        time_step = single.reset()
        for step in range(steps):
            (observed,) = time_step.observation.values()
            assert observed.tobytes() == observations[step][index].tobytes()
            time_step = single.step(actions[step, index])
            transition = transitions[step]
            assert time_step.reward == transition.reward[index]
            ended = transition.terminal[index] or transition.truncated[index]
            assert time_step.last() == ended
            if ended:
                assert time_step.discount == (0.0 if transition.terminal[index] else 1.0)
                time_step = single.reset()
                episodes += 1
    assert episodes >= 2


def test_a_start_leaves_the_others_alone() -> None:
    task = tasks.make("laikago_trot")
    rng = np.random.default_rng(0)
    starts = task.start(rng, 4, perturbed=True)
    physics, undisturbed = Physics(task, 4, threads=1), Physics(task, 4, threads=1)
    state, expected = (p.place(np.arange(4), starts) for p in (physics, undisturbed))
    for step in range(12):
        action = rng.uniform(-1.0, 1.0, (4, 12))
        state, expected = physics.advance(state, action), undisturbed.advance(expected, action)
        if step == 5:
            fresh = physics.begin(rng, np.array([0, 2]))
            state = state.updated(np.array([0, 2]), fresh)
            assert np.all(state.time[[0, 2]] == 0.0)
    others = np.array([1, 3])
    assert same(state.rows(others), expected.rows(others))
    assert not np.any(state.base_position[[0, 2]] == expected.base_position[[0, 2]])


def test_states_are_not_overwritten() -> None:
    task = tasks.make("rocket_obstacles")
    physics = Physics(task, 2, threads=1)
    state = physics.begin(np.random.default_rng(0), np.arange(2))
    before = [getattr(state, f.name).copy() for f in fields(state)]
    physics.advance(state, np.ones((2, 2)))
    for field, value in zip(fields(state), before, strict=True):
        np.testing.assert_array_equal(getattr(state, field.name), value)
    assert physics.substeps == 2
    laikago = Physics(tasks.make("laikago_walk"), 3, threads=1)
    laikago.advance(laikago.begin(np.random.default_rng(0), np.arange(3)), np.zeros((3, 12)))
    assert laikago.substeps == 60


def test_truncation_and_termination() -> None:
    """An episode that ends in a terminal state at its last step is terminal."""
    task = tasks.make("rocket_navigation")
    planning = Planning(task)
    batch = BatchedEnvironment(planning, planning, 2, 0)
    batch.reset()
    # Down at 5 m/s: 10 m take 40 steps, the 41st is out of bounds.
    action = np.tile([[0.0, -1.0, 0.0], [0.0, 0.0, 0.0]], (1, 1))
    for step in range(1, 42):
        transition = batch.step(action)
        assert transition.terminal.tolist() == [step == 41, False]
        assert not transition.truncated.any()
        assert batch.steps.tolist() == [step % 41, step]
    batch.steps[:] = planning.horizon - 1  # at the last step
    batch.state = batch.state.replace(position=np.array([[0.0, -10.0], [0.0, 0.0]]))
    transition = batch.step(action)
    assert transition.terminal.tolist() == [True, False]
    assert transition.truncated.tolist() == [False, True]
    assert batch.steps.tolist() == [0, 0]
    np.testing.assert_array_equal(batch.state.position, np.zeros((2, 2)))


def test_steps_that_an_arrival_spares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rows are at the goal after their third step, but the second one fell on its way in."""
    planning = Planning(tasks.make("laikago_walk"))
    second = lambda task, state: np.arange(len(state.time)) == 1  # noqa: E731
    monkeypatch.setattr(type(planning.task), "violated", second)
    batch = BatchedEnvironment(planning, planning, 3, 0)
    batch.reset()
    idle = np.zeros((3, planning.action_size))
    for _ in range(2):
        assert batch.step(idle).spared.tolist() == [0, 0, 0]
    offset = np.array([[1.25, 0.0, 0.0], [1.25, 0.0, 0.0], [0.0, 0.0, 0.0]])
    base, feet = batch.state.base_position + offset, batch.state.feet + offset[:, None]
    batch.state = batch.state.replace(base_position=base, com=base, feet=feet)
    transition = batch.step(idle)
    assert transition.terminal.tolist() == [True, True, False]
    assert transition.spared.tolist() == [planning.horizon - 3, 0, 0]
    assert batch.step(idle).spared.tolist() == [0, 0, 0]


def test_steps_count_from_where_the_reference_is(
    naive_reference: Callable[[str], ReferenceMotion],
) -> None:
    task = Imitation(tasks.make("laikago_walk"), naive_reference("laikago_walk"))
    batch = BatchedEnvironment(task, Physics(task, 200, threads=1), 200, 0)
    batch.reset()
    np.testing.assert_allclose(batch.state.time, batch.steps / 30)
    assert batch.steps.max() > 100
    last = batch.steps == task.horizon - 1
    assert last.any()
    transition = batch.step(np.zeros((200, 12)))
    np.testing.assert_array_equal(transition.truncated, last & ~transition.terminal)
    for _ in range(5):  # and again in a new episode
        batch.step(np.zeros((200, 12)))
        np.testing.assert_allclose(batch.state.time, batch.steps / 30)
    assert np.any(batch.steps[last] > 6)


# A list of seeds: each row has a generator of its own.


@pytest.mark.parametrize("seeds", [[5, 6, 5], (7, None, 9)])
def test_a_seed_for_each_row(seeds: Any) -> None:
    """Its episodes, the second included, begin like those of an environment with that seed."""
    many = tsbench.load_batched("laikago_walk", count=3, seed=seeds, perturbed=True, threads=1)
    one = tsbench.load("laikago_walk", seed=seeds[2], perturbed=True)
    starts = []
    for _ in range(2):
        starts.append(many.reset())
        assert starts[-1][2].tobytes() == next(iter(one.reset().observation.values())).tobytes()
        assert (starts[-1][0].tobytes() == starts[-1][2].tobytes()) == (seeds[0] == seeds[2])
        many.step(np.zeros((3, 12)))
    assert not np.any(starts[0][1][:12] == starts[1][1][:12])
    before = many.snapshot()
    later = many.reset()
    many.restore(before)
    assert many.reset().tobytes() == later.tobytes()


@pytest.mark.parametrize(
    ("seed", "message"),
    [
        ([1], "a list of seeds must have one for each of 2, not 1"),
        ([1, -2], "seed must not be negative, not -2"),
        ([1, "two"], "seed must be a whole number or None, not 'two'"),
        ("5", "seed must be a whole number or None, not '5'"),
        (1.5, "seed must be a whole number or None, not 1.5"),
    ],
)
def test_refused_seeds(seed: Any, message: str) -> None:
    with pytest.raises(TsbenchError, match=message):
        tsbench.load_batched("rocket_navigation", count=2, seed=seed)
    if not isinstance(seed, list):
        with pytest.raises(TsbenchError, match=message):
            tsbench.load("rocket_navigation", seed=seed)


@pytest.mark.parametrize(
    ("count", "message"),
    [
        (0, "count must be at least 1, not 0"),
        ("a", "count must be a whole number, not 'a'"),
        (2.0, r"count must be a whole number, not 2\.0"),
        (None, "count must be a whole number, not None"),
    ],
)
def test_refused_counts(count: Any, message: str) -> None:
    with pytest.raises(TsbenchError, match=f"^{message}$"):
        tsbench.load_batched("rocket_navigation", count=count)


def test_a_count_may_be_one_of_numpy() -> None:
    count: Any = np.int64(2)
    assert tsbench.load_batched("rocket_navigation", count=count, threads=1).count == 2


# Nothing is stepped that has no state to go on from.


@pytest.mark.parametrize("variant", [None, "planning"])
def test_a_step_before_the_first_reset(variant: tsbench.Variant | None) -> None:
    many = tsbench.load_batched("rocket_navigation", variant, count=2)
    size = many.mdp.action_size
    for refused in (
        lambda: many.step(np.zeros((2, size))),
        lambda: many.begin(np.array([0])),
        lambda: many.restore({}),
    ):
        with pytest.raises(TsbenchError, match=r"call reset\(\) first: .* never reset"):
            refused()


@pytest.mark.parametrize("variant", [None, "planning"])
@pytest.mark.parametrize("refused", [np.nan, np.zeros((2, 9)), [["up", "down"]] * 2, None])
def test_a_refused_action_changes_nothing(variant: tsbench.Variant | None, refused: Any) -> None:
    """The episode of 39 steps still has 39, of the plan 15."""
    many = tsbench.load_batched("rocket_navigation", variant, count=2, distance=3.0, threads=1)
    many.reset()
    size, horizon = many.mdp.action_size, many.mdp.horizon
    refused = np.full((2, size), np.nan) if refused is np.nan else refused
    for step in range(horizon):
        if step == 5:
            before, state = many.steps.copy(), many.state
            for _ in range(4):
                with pytest.raises(TsbenchError, match=r"^(the action|action of environment 0) "):
                    many.step(refused)
            assert many.state is state
            np.testing.assert_array_equal(many.steps, before)
        hover = np.zeros((2, size))
        hover[:, 0] = 0.5 * (step % 2) if variant is None else 0.0
        assert many.step(hover).truncated.all() == (step == horizon - 1)


def test_a_failed_step_needs_a_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    """The physics has gone on, so that the state and the physics no longer agree."""
    many = tsbench.load_batched("rocket_navigation", count=2, threads=1)
    first = many.reset()
    with monkeypatch.context() as patched:
        patched.setattr(type(many.mdp), "reward", lambda *_: np.array([0.0, np.nan]))
        with pytest.raises(TsbenchError, match="reward of environment 1 is not finite"):
            many.step(np.zeros((2, 2)))
    with pytest.raises(TsbenchError, match=r"call reset\(\) first: .* their last step failed"):
        many.step(np.zeros((2, 2)))
    assert many.reset().tobytes() == first.tobytes()
    many.step(np.zeros((2, 2)))


def test_some_rows_are_stepped_and_some_begun() -> None:
    """The others keep their states, and a row goes on as if it had been alone."""
    many = tsbench.load_batched("rocket_obstacles", count=3, seed=[1, 2, 3], perturbed=True)
    many.reset()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 3, 2))
    for action in actions[:3]:
        transition = many.advance(action, np.array([0, 2]))
        assert transition.reward[1] == 0.0
        assert transition.observation.shape == (3, many.mdp.observation_size)
    assert many.steps.tolist() == [3, 0, 3]
    many.begin(np.array([0]))
    for action in actions[3:]:
        many.step(action)
    assert many.steps.tolist() == [3, 3, 6]
    for row, (resets, given) in enumerate([(2, actions[3:]), (1, actions[3:]), (1, actions)]):
        one = tsbench.load("rocket_obstacles", seed=row + 1, perturbed=True)
        for _ in range(resets):
            one.reset()
        for action in given:
            last = one.step(action[row])
        assert last.observation["observations"].tobytes() == many.observation()[row].tobytes()


# Threads do not survive a fork.


def in_a_child(function: Callable[[], Any]) -> str:
    """What a forked child says to a call: the result, or the error's line."""
    context = multiprocessing.get_context("fork")
    answers = context.SimpleQueue()

    def child() -> None:
        try:
            answers.put(str(function()))
        except TsbenchError as error:
            answers.put(str(error))

    process = context.Process(target=child)
    process.start()
    process.join(60.0)
    hangs = process.is_alive()
    if hangs:
        process.kill()
        process.join()
    return "hangs" if hangs else answers.get()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_is_refused() -> None:
    """Its own process can use the environment as before."""
    many = tsbench.load_batched("laikago_trot", count=4, threads=2)
    many.reset()
    many.step(np.zeros((4, 12)))
    state = many.state
    for call in (
        lambda: many.step(np.zeros((4, 12))),
        many.reset,
        lambda: many.begin(np.array([1])),
    ):
        assert in_a_child(call).startswith("these environments were made in another process")
    assert many.state is state
    many.step(np.zeros((4, 12)))


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_makes_its_own() -> None:
    """Also while its parent has one."""
    many = tsbench.load_batched("rocket_navigation", count=3, threads=2)
    expected = many.reset()

    def own() -> Any:
        batch = tsbench.load_batched("rocket_navigation", count=3, threads=2)
        batch.reset()
        return batch.step(np.zeros((3, 2))).reward.sum()

    assert in_a_child(own) == str(many.step(np.zeros((3, 2))).reward.sum())
    assert many.reset().tobytes() == expected.tobytes()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_single_environment_survives_a_fork() -> None:
    """It has no threads."""
    single = tsbench.load("laikago_trot")
    single.reset()
    found = in_a_child(lambda: single.step(np.zeros(12)).reward)
    assert found == str(single.step(np.zeros(12)).reward)
