"""The method prm_rl: where a policy is sent, which edges are kept, and what is distilled."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tsbench import TsbenchError, tasks
from tsbench.core.errors import PlanError
from tsbench.core.method import Budget, Problem
from tsbench.core.motion import Roadmap
from tsbench.core.roadmap import DrivableSpace
from tsbench.core.task import plannable, roadmap_space
from tsbench.methods import prm_rl
from tsbench.methods.prm_rl import Errands, Sent, always, drivable_route, next_corner
from tsbench.planning.roadmap import Graph, Route
from tsbench.rl.distil import Lesson, distilled
from tsbench.rl.settings import PPOSettings
from tsbench.runs import config, execute
from tsbench.runs.directory import RunDirectory
from tsbench.sim.episodes import play
from tsbench.sim.physics import Physics
from tsbench.tasks.rocket import Rocket
from tsbench.testing.contracts import Desk

TRAINING = {"imitate": {"rollout": 8, "epochs": 1, "minibatches": 2, "hidden": [16]}}


def problem(budget: int, **options: Any) -> Problem:
    task = tasks.make("rocket_navigation", distance=20.0)
    return Problem(task, Budget(192, budget, 8, audit="warn"), TRAINING, options, seed=0, threads=1)


def space_of(task: Any) -> DrivableSpace[Any]:
    space = roadmap_space(task, "prm_rl")
    assert isinstance(space, DrivableSpace)
    return space


def steering(observation: np.ndarray) -> np.ndarray:
    """A policy of a rocket that does not look at where it is, only at where the goal is."""
    offset, speed = observation[..., 6:8], observation[..., 3:5]
    tilt = np.clip(-0.05 * offset[..., 0] + 0.1 * speed[..., 0], -0.4, 0.4)
    side = 8.0 * (tilt - observation[..., 2]) - 3.0 * observation[..., 5]
    main = 0.5 + 0.2 * (offset[..., 1] - speed[..., 1])
    return np.clip(np.stack([main, side], axis=-1), -1.0, 1.0)


def test_a_sent_policy_flies_as_it_does_to_the_goal() -> None:
    """From a to b it makes the same flight as from (goal + a - b) to the goal, moved by b - goal:
    so to send a policy is to train it near the goal."""
    task = tasks.make("rocket_navigation")
    space = space_of(task)
    first, second = np.array([10.0, 8.0]), np.array([18.0, 12.0])
    flights = []
    for point, start in ((second, first), (space.goal, space.goal + first - second)):
        physics: Physics[Any] = Physics(task, 1, threads=1)
        begin = physics.place(
            np.arange(1), space.moved(task.start(np.random.default_rng(0), 1), start)
        )
        sent = Sent(task, space, always(point), 200)
        episode = play(sent, physics, steering, 1, begin=begin, record=lambda s: s.position)
        assert episode.states is not None
        flights.append(episode.states[:, 0] - point)
    assert np.ptp(flights[0], axis=0).max() > 3.0
    np.testing.assert_allclose(flights[0], flights[1], atol=1e-6)


def test_a_critic_sees_what_the_task_shows_it() -> None:
    class Shown(Rocket):
        def value_observation(self, state: Any) -> Any:
            return state.position

    task = Shown(**vars(tasks.make("rocket_navigation")))
    space, point = space_of(task), np.array([3.0, 1.0])
    state = plannable(task).abstraction().start(2)
    seen = Sent(task, space, always(point), 100).value_observation(state)
    np.testing.assert_array_equal(seen, state.position + (space.goal - point))


def test_a_leg_ends_where_it_leads() -> None:
    task = tasks.make("rocket_navigation")
    space = space_of(task)
    leg = Sent(task, space, always(np.array([3.0, 0.0])), 300, arrives=True)
    state = plannable(task).abstraction().start(4)
    state = state.replace(position=np.array([[0.0, 0.0], [2.1, 0.0], [3.0, 0.9], [-20.0, 0.0]]))
    assert leg.reached(state).tolist() == [False, True, True, False]
    assert leg.terminal(state).tolist() == [False, True, True, True]


def test_errands_begin_within_reach() -> None:
    task = tasks.make("rocket_obstacles")
    space = space_of(task)
    starts = Errands(task, space, reach=60.0).start(np.random.default_rng(0), 500)
    away = np.abs(starts.qpos[:, :2] - space.goal)
    assert 10.0 < away.max() <= 15.0 + 0.5  # 60 plan steps of 0.25 m, and the noise of starts
    assert np.all(starts.qpos[:, :2] <= space.high + 0.5)
    assert isinstance(task, Rocket)
    distance = [
        np.linalg.norm(starts.qpos[:, :2] - obstacle, axis=-1) for obstacle in task.obstacles
    ]
    assert np.min(distance) > 0.5


def test_the_next_corner() -> None:
    """A way of 10 m to the right and 10 m up: the corner is next until 1 m of it is left."""
    task = tasks.make("rocket_navigation")
    corners = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    points = np.concatenate([[[x, 0.0] for x in range(11)], [[10.0, z] for z in range(1, 11)]])
    route = Route(Graph(corners, np.zeros((0, 2), np.int64), np.zeros(0), 0), corners, points)
    target = next_corner(space_of(task), route)
    state = plannable(task).abstraction().start(5)
    positions = [[0.0, 2.0], [8.4, -1.0], [9.6, 0.2], [12.0, 5.0], [10.0, 10.0]]
    found = target(state.replace(position=np.array(positions)))
    assert found.tolist() == [[10.0, 0.0], [10.0, 0.0], [10.0, 10.0], [10.0, 10.0], [10.0, 10.0]]


def test_edges_that_cannot_be_driven_are_refused(tmp_path: Path) -> None:
    """A policy that falls drives only edges that lead down. With a generous idea of what is near,
    any policy drives all."""
    given = problem(200_000, samples=60)
    space = space_of(given.task)
    chosen = prm_rl.Options(samples=60, rollouts=6, least=0.5)

    def falling(observation: np.ndarray) -> np.ndarray:
        return np.zeros((len(observation), 2))

    desk = Desk(tmp_path)
    drivable_route(given, desk, space, falling, chosen, 20_000)
    assert re.search(r"; [1-9] of the way's \d+ edges are none", desk.notes[0])
    assert 0 < desk.reports["roadmap"][-1] <= 20_000
    strict = replace(given, budget=replace(given.budget, audit="stop"))
    stern = replace(chosen, audit=None)
    with pytest.raises(PlanError, match=r"edges could not be driven; .*method\.audit=warn"):
        drivable_route(strict, Desk(tmp_path), space, falling, stern, 20_000)
    desk = Desk(tmp_path)
    space.near = 1e3  # m: so that every start is there
    route = drivable_route(strict, desk, space, falling, stern, 20_000)
    assert " 0 of the way's " in desk.notes[0]
    assert len(route.graph.edges) == route.graph.checked == len(route.corners) - 1
    np.testing.assert_array_equal(route.corners[[0, -1]], [space.start, space.goal])


def test_a_network_learns_a_lesson() -> None:
    task = tasks.make("rocket_navigation")
    rng = np.random.default_rng(0)
    observations = rng.uniform(-5.0, 5.0, (4000, 10))
    actions = np.clip(np.stack([observations[:, 0] / 5, observations[:, 1] / -10], axis=-1), -1, 1)
    settings = PPOSettings(hidden=(32, 32), encoding="symlog", learning_rate=3e-3)
    policy, error = distilled(task, "prm_rl", Lesson(observations, actions), settings, 0, 150)
    spread = np.mean(np.var(actions, axis=0))
    assert error < 0.1 * spread
    assert np.mean((policy(observations) - actions) ** 2) < 0.1 * spread
    assert policy.info.encoding == "symlog"
    assert policy.info.layers == (10, 32, 32, 2)


def test_what_a_run_leaves(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    policy = prm_rl.train(problem(400), desk)
    assert policy.info.method == "prm_rl"
    assert [name for name, _ in desk.stages] == ["drive", "roadmap", "distil"]
    assert sum(steps for _, steps in desk.stages) == 400
    assert len(Roadmap.load(tmp_path / "roadmap.npz").nodes) == 202
    assert (tmp_path / "plan.npz").exists()


def test_an_interrupted_run_ends_with_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed while it distils, it drives the edges and distils again after it is resumed."""
    words = [
        "task=rocket_navigation", "method=prm_rl", "budget=smoke", "threads=1", "checkpoint=0",
        "task.budgets.smoke.act=2000", "task.constants.distance=8.0", "method.rollouts=2",
        "method.least=0.3",
        "task.training.imitate.rollout=2", "task.training.imitate.minibatches=2",
    ]  # fmt: skip

    def run(directory: Path) -> RunDirectory:
        chosen = replace(config.compose(words), directory=str(directory))
        execute.execute(chosen, words, Console(quiet=True))
        return RunDirectory(directory)

    class Crash(BaseException):
        """Nothing catches it."""

    def crash(*_: Any) -> Any:
        raise Crash

    whole = run(tmp_path / "whole")
    with monkeypatch.context() as patch:
        patch.setattr(prm_rl, "distilled", crash)
        with pytest.raises(Crash):
            run(tmp_path / "broken")
    broken = RunDirectory(tmp_path / "broken")
    execute.resume(broken.path, Console(quiet=True))
    assert broken.policy().sha256 == whole.policy().sha256
    stages = [[(stage.name, stage.steps) for stage in r.record().stages] for r in (whole, broken)]
    assert stages[0] == stages[1]
    assert [name for name, _ in stages[0]] == ["drive", "roadmap", "distil"]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("laikago_trot", {}, "the method prm_rl cannot do laikago_trot: no policy goes to any"),
        ("rocket_navigation", {"rollouts": 1}, "method.rollouts must lie in 2 to 10000, not 1"),
        ("rocket_navigation", {"samples": 21_000}, "method.samples must lie in 0 to 19,998, not"),
        ("rocket_navigation", {"rollouts": 8}, "method.least must be at most 0.676, the bound of"),
        ("rocket_navigation", {"drive": 0.9, "test": 0.1}, "must leave a share of the budget"),
        ("rocket_navigation", {"audit": "skip"}, "method.audit must be stop, warn or null"),
    ],
)
def test_what_it_refuses(name: str, options: Any, message: str, tmp_path: Path) -> None:
    given = replace(problem(400, **options), task=tasks.make(name))
    with pytest.raises(TsbenchError, match=message):
        prm_rl.train(given, Desk(tmp_path))
