"""Roadmaps: their samples, edges, ways and cycles, against closed forms and brute force."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import qmc

from tsbench import TsbenchError, tasks
from tsbench.core.errors import PlanError
from tsbench.core.motion import Roadmap
from tsbench.core.roadmap import Lattice, Move, RoadmapSpace
from tsbench.core.task import plannable, roadmap_space
from tsbench.planning import roadmap
from tsbench.planning.path import segment_distance
from tsbench.planning.roadmap import (
    Graph,
    Route,
    best_cycle,
    connected,
    cycled,
    find_route,
    halton,
    resampled,
    straightened,
)
from tsbench.sim.kinematic import plan_along
from tsbench.tasks.rocket import Rocket


class Plane(RoadmapSpace[Any]):
    """A square of 10 x 10 in which one plan step goes 0.5 in any direction, with a wall."""

    def __init__(self, *, wall: bool = False) -> None:
        self.low, self.high, self.scale = np.zeros(2), np.full(2, 10.0), np.full(2, 0.5)
        self.start, self.goal = np.array([1.0, 1.0]), np.array([9.0, 7.0])
        self.wall = wall

    def free(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """The wall is x = 5 below y = 8."""
        crosses = (first[:, 0] - 5.0) * (second[:, 0] - 5.0) <= 0.0
        across = np.where(first[:, 0] == second[:, 0], 1.0, second[:, 0] - first[:, 0])
        y = first[:, 1] + (5.0 - first[:, 0]) / across * (second[:, 1] - first[:, 1])
        return ~(crosses & (y < 8.0)) if self.wall else np.ones(len(first), bool)

    def steps(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        steps: np.ndarray = np.linalg.norm(second - first, axis=-1) / 0.5
        return steps

    def action(self, state: Any, point: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def places(self, points: np.ndarray) -> np.ndarray:
        return np.insert(points, 2, 0.0, axis=-1)


def test_halton_points_cover_the_box_evenly() -> None:
    low, high = np.array([-10.0, 2.0]), np.array([30.0, 3.0])
    points = halton(low, high, 1024, seed=3)
    assert points.shape == (1024, 2)
    assert np.all((points >= low) & (points <= high))
    cells = np.floor((points - low) / (high - low) * (8, 8)).astype(int)
    counts = np.bincount(cells[:, 0] * 8 + cells[:, 1], minlength=64)
    assert counts.min() >= 12  # 16 in each cell on average; of random points some have 6
    assert counts.max() <= 20
    rng = np.random.default_rng(0)
    scaled = (points - low) / (high - low)
    assert qmc.discrepancy(scaled) < 0.1 * qmc.discrepancy(rng.uniform(size=(1024, 2)))


def test_halton_points_have_a_seed() -> None:
    box = np.zeros(3), np.ones(3)
    np.testing.assert_array_equal(halton(*box, 50, seed=1), halton(*box, 50, seed=1))
    assert (
        len(np.unique(np.concatenate([halton(*box, 50, seed) for seed in range(4)]), axis=0)) == 200
    )


def test_the_quickest_way_through_a_graph() -> None:
    """By hand: 0-1-3 costs 1 + 5, 0-2-3 costs 4 + 1, 0-1-2-3 costs 1 + 2 + 1; 4 is apart."""
    points = np.arange(5.0)[:, None]
    edges = np.array([[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]])
    graph = Graph(points, edges, np.array([1.0, 4.0, 2.0, 5.0, 1.0]), checked=5)
    assert graph.quickest(0, 3) == [0, 1, 2, 3]
    assert graph.quickest(3, 0) == [3, 2, 1, 0]
    assert graph.quickest(0, 4) is None


def test_neighbours_are_the_nearest() -> None:
    """Points on a line at 0, 1, 3, 7, each joined to its nearest other."""
    space = Plane()
    points = np.array([[0.0, 1.0], [1.0, 1.0], [3.0, 1.0], [7.0, 1.0]])
    graph = connected(space, points, neighbours=1)
    assert graph.edges.tolist() == [[0, 1], [1, 2], [2, 3]]
    np.testing.assert_allclose(graph.costs, np.array([2.0, 4.0, 8.0]) * (1 + roadmap.LENGTH_COST))
    assert graph.checked == 3


def taken(space: RoadmapSpace[Any], route: Route) -> float:
    """Plan steps of a way, not rounded."""
    return float(space.steps(route.corners[:-1], route.corners[1:]).sum())


@pytest.mark.parametrize("seed", range(3))
def test_a_free_way_is_nearly_straight(seed: int) -> None:
    """The straight way is 10 long, 20 plan steps: roadmaps come near it, shortcuts find it."""
    space = Plane()
    few, many, cut = (
        taken(space, find_route(space, samples, 24, seed, shortcut=shortcut))
        for samples, shortcut in ((100, False), (4000, False), (100, True))
    )
    assert 20.0 <= many <= 20.0 * 1.03
    assert 20.0 <= few <= 20.0 * 1.25
    assert cut == pytest.approx(20.0, rel=1e-6)


def test_shortcuts_round_a_corner() -> None:
    """The best way touches the wall's end at (5, 8): sqrt(4^2 + 7^2) + sqrt(4^2 + 1) = 12.185."""
    space = Plane(wall=True)
    best = (np.sqrt(65.0) + np.sqrt(17.0)) / 0.5
    rough = find_route(space, 2000, 16, 0)
    route = find_route(space, 2000, 16, 0, shortcut=True)
    assert best <= taken(space, route) <= 1.02 * best
    assert taken(space, route) < taken(space, rough) < 1.1 * best
    assert space.free(route.corners[:-1], route.corners[1:]).all()
    np.testing.assert_array_equal(route.corners[0], space.start)
    np.testing.assert_array_equal(route.corners[-1], space.goal)
    assert straightened(space, route.corners).shape[1] == 2


def test_a_way_is_resampled_at_full_speed() -> None:
    """1.2 long at 0.5 a plan step, round a corner: two full steps and a slower one."""
    space = Plane()
    corners = np.array([[1.0, 1.0], [1.7, 1.0], [1.7, 1.5]])
    points = resampled(space, corners)
    np.testing.assert_allclose(points, [[1.0, 1.0], [1.5, 1.0], [1.7, 1.3], [1.7, 1.5]])
    whole = resampled(space, np.array([[1.0, 1.0], [2.0, 1.0]]))  # no empty step at the end
    np.testing.assert_allclose(whole, [[1.0, 1.0], [1.5, 1.0], [2.0, 1.0]])


def test_no_way_is_said_in_one_line() -> None:
    with pytest.raises(PlanError, match=r"of 3 samples has no way .*more method\.samples"):
        find_route(Plane(wall=True), 3, 2, 0)


def test_distance_from_segments() -> None:
    first = np.array([[0.0, 0.0], [0.0, 0.0], [3.0, 4.0], [2.0, 0.0]])
    second = np.array([[4.0, 0.0], [0.0, 1.0], [3.0, 4.0], [9.0, 0.0]])
    distance = segment_distance(np.array([1.0, 2.0]), first, second)
    np.testing.assert_allclose(distance, [2.0, np.sqrt(2.0), np.sqrt(8.0), np.sqrt(5.0)])


centre = st.tuples(st.floats(2.0, 15.0), st.floats(1.0, 9.0))


@settings(max_examples=40)
@given(obstacles=st.lists(centre, min_size=1, max_size=3), seed=st.integers(0, 99))
def test_no_edge_crosses_an_inflated_obstacle(
    obstacles: list[tuple[float, float]], seed: int
) -> None:
    """Points every few centimetres along all edges of a rocket's roadmap and along its way."""
    task = Rocket("rocket", 20.0, tuple(obstacles), 600)
    space = task.abstraction().roadmap_space()
    points = halton(space.low, space.high, 120, seed)
    points = points[space.free(points, points)]
    edges = points[connected(space, points, 8).edges]
    share = np.linspace(0.0, 1.0, 300)[:, None, None]
    along = (edges[:, 0] + share * (edges[:, 1] - edges[:, 0])).reshape(-1, 2)
    try:
        corners = find_route(space, 300, 12, seed).corners
    except TsbenchError:  # an obstacle lies on the goal, or fills the way to it
        corners = points[:1]
    way = (corners[:-1] + share * (corners[1:] - corners[:-1])).reshape(-1, 2)
    for obstacle in obstacles:
        for places in (along, way):
            distance = np.linalg.norm(places - obstacle, axis=-1)
            assert distance.min(initial=np.inf) >= 0.5 + 0.72


@pytest.mark.parametrize("name", ["rocket_navigation", "rocket_obstacles"])
@pytest.mark.parametrize("seed", range(10))
def test_rocket_plans_pass_their_audit(name: str, seed: int) -> None:
    """They are as fast as the speed limit allows along x: 51.96 m at 0.25 m a step."""
    task = plannable(tasks.make(name))
    space = roadmap_space(task, "prm")
    route = find_route(space, 1000, 16, seed)
    assert taken(space, route) == pytest.approx(60.0 * np.cos(np.pi / 6) / 0.25, rel=5e-3)
    plan = plan_along(task, space, route.points)
    audit = task.audit(plan, task.reference(plan))
    assert audit.passed, audit.failures


def test_a_roadmap_can_be_kept(tmp_path: Any) -> None:
    task = tasks.make("rocket_obstacles")
    space = roadmap_space(task, "prm")
    route = find_route(space, 200, 8, 0)
    drawn = route.drawn(space, plan_along(task, space, route.points))
    drawn.save(tmp_path / "roadmap.npz")
    again = Roadmap.load(tmp_path / "roadmap.npz")
    assert again.nodes.shape[1] == again.path.shape[1] == 3
    np.testing.assert_array_equal(again.edges, route.graph.edges)
    np.testing.assert_array_equal(
        again.nodes[:2], space.places(np.stack([space.start, space.goal]))
    )
    assert again.checked == route.graph.checked >= len(again.edges)
    for wrong in ({"edges": again.edges + 10**6}, {"edges": again.edges[:, :1]}, {"checked": -1}):
        with pytest.raises(TsbenchError, match="not a valid roadmap"):
            Roadmap(**{**vars(again), **wrong})


class Steps(Lattice):
    """A walker on 4 nodes, that may go on in layer 0 only, and whose nodes are worth different
    rewards in the two layers."""

    layers = 2
    shape = (4,)
    start = (1,)

    def moves(self, layer: int) -> Sequence[Move]:
        action = np.zeros(1)
        moves = [Move((1,), action, 0.3, 1.0), Move((0,), action + 1.0, 0.5, 1.0)]
        return [*moves, Move((-1,), action + 2.0, 0.2, 1.4)] if layer == 0 else moves

    def worth(self, layer: int) -> np.ndarray:
        return np.array([[0.2, 0.9, 0.4, 1.0], [0.7, 0.1, 0.8, 0.3]][layer])


def test_the_best_cycle_is_that_of_brute_force() -> None:
    lattice = Steps()
    count = lattice.layers * roadmap.CYCLES
    moves = [lattice.moves(step % 2) for step in range(count)]

    def value(node: int, sequence: tuple[int, ...]) -> float:
        total, growth = 0.0, 1.0
        for step, index in enumerate(sequence):
            move = moves[step][index]
            node += move.shift[0]
            if not 0 <= node < 4:
                return -np.inf
            total += growth * move.reward * lattice.worth((step + 1) % 2)[node]
            growth *= move.growth
        return total + growth

    choice = best_cycle(lattice)
    for node in range(4):
        found = {s: value(node, s) for s in itertools.product(*(range(len(m)) for m in moves))}
        best = max(found, key=lambda sequence: found[sequence])
        assert choice[0][node] == best[0]
        after = node + moves[0][best[0]].shift[0]
        assert choice[1][after] == best[1]
    actions = cycled(lattice, 6)
    assert actions.shape == (6, 1)
    assert actions[0, 0] == choice[0][1]
