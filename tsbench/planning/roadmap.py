"""Probabilistic roadmaps (Kavraki et al. 1996), and roadmaps layered by the phase of a gait.

A roadmap covers a space with Halton samples, joins near ones where the straight way is free, and
takes the quickest way from start to goal. The layered roadmap has nodes and moves in place of
samples and edges, and the best way through it is found by dynamic programming.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.stats import qmc

from tsbench.core.errors import PlanError
from tsbench.core.motion import MAX_FRAMES, Plan, Roadmap
from tsbench.core.roadmap import Lattice, RoadmapSpace

# Of two ways that take equally long the straighter one is taken: each unit of length, in plan
# steps, costs this many plan steps more.
LENGTH_COST = 1e-3
BLOCK = 100_000  # edges that are checked together
ROUNDS = 20  # of shortcutting, at most
MOST_POINTS = 500  # of a way, besides its corners, that shortcuts may join
# What the file of a roadmap holds (`core.motion`): beside start and goal so many nodes, and as many
# edges as there are pairs of near samples.
MOST_SAMPLES = MAX_FRAMES - 2
MOST_PAIRS = 1_000_000
CYCLES = 2  # that a layered roadmap looks ahead


@dataclass(frozen=True)
class Graph:
    """Points and the free straight ways between them.

    Attributes:
        points: shape (n, d).
        edges: pairs of indices of points, the smaller first, int64, shape (m, 2).
        costs: of each edge, shape (m,).
        checked: edges that were checked, free or not.
    """

    points: np.ndarray
    edges: np.ndarray
    costs: np.ndarray
    checked: int

    def quickest(self, first: int, last: int) -> list[int] | None:
        """The points on the cheapest way between two points, by Dijkstra's algorithm; None if there
        is no way."""
        count = len(self.points)
        matrix = coo_array((self.costs, self.edges.T), shape=(count, count)).tocsr()
        _, before = dijkstra(matrix, directed=False, indices=first, return_predecessors=True)
        way = [last]
        while way[-1] != first:
            if before[way[-1]] < 0:
                return None
            way.append(int(before[way[-1]]))
        return way[::-1]


@dataclass(frozen=True)
class Route:
    """A way from start to goal.

    Attributes:
        graph: the roadmap that it was found in.
        corners: points between which it is straight, shape (k, d).
        points: where it is after each plan step, shape (T + 1, d).
    """

    graph: Graph
    corners: np.ndarray
    points: np.ndarray

    def drawn(self, space: RoadmapSpace[Any], plan: Plan) -> Roadmap:
        """The roadmap and the way as they are drawn beside the plan that follows the way."""
        return Roadmap(
            task=plan.task,
            task_version=plan.task_version,
            timestep=plan.timestep,
            nodes=space.places(self.graph.points),
            edges=self.graph.edges,
            path=space.places(self.corners),
            checked=self.graph.checked,
        )


def expect_size(samples: int, neighbours: int) -> None:
    """Checks that the file of a roadmap will hold it, before it is planned with.

    Raises:
        ValueError: there are too many samples or neighbours, or fewer than none.
    """
    if not 0 <= samples <= MOST_SAMPLES:
        raise ValueError(f"samples must lie in 0 to {MOST_SAMPLES:,}, not {samples}")
    most = MOST_PAIRS // max(samples, 1000)
    if not 1 <= neighbours <= most:
        raise ValueError(
            f"neighbours must lie in 1 to {most:,} with {samples:,} samples, not {neighbours}"
        )


def halton(low: np.ndarray, high: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Scrambled Halton points in a box, shape (count, d)."""
    points = qmc.Halton(len(low), scramble=True, rng=np.random.default_rng(seed)).random(count)
    scaled: np.ndarray = low + points * (high - low)
    return scaled


def find_route(
    space: RoadmapSpace[Any], samples: int, neighbours: int, seed: int, *, shortcut: bool = False
) -> Route:
    """The quickest way through a roadmap.

    Args:
        space: to plan in.
        samples: Halton samples, of which those that are not free are dropped.
        neighbours: nearest samples that each sample is joined to.
        seed: of the samples.
        shortcut: whether the way is straightened.

    Raises:
        PlanError: the roadmap has no way from start to goal.
    """
    graph = connected(space, sampled(space, samples, seed), neighbours)
    way = graph.quickest(0, 1)
    if way is None:
        raise no_way(samples)
    corners = graph.points[way]
    if shortcut:
        corners = straightened(space, corners)
    return Route(graph, corners, resampled(space, corners))


def sampled(space: RoadmapSpace[Any], samples: int, seed: int) -> np.ndarray:
    """Start, goal and those Halton samples that are free, shape (n, d)."""
    points = halton(space.low, space.high, samples, seed)
    return np.concatenate([[space.start, space.goal], points[space.free(points, points)]])


def no_way(samples: int) -> PlanError:
    return PlanError(
        f"the roadmap of {samples} samples has no way to the goal: "
        "more method.samples or method.neighbours are needed"
    )


def connected(space: RoadmapSpace[Any], points: np.ndarray, neighbours: int) -> Graph:
    """The free straight ways between each point and its nearest others, by the plan steps that the
    slowest coordinate needs."""
    count = min(neighbours + 1, len(points))  # each point is its own nearest
    _, near = cKDTree(points / space.scale).query(points / space.scale, count, p=np.inf)
    pairs = np.stack([np.repeat(np.arange(len(points)), count), near.ravel()], axis=-1)
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=-1), axis=0)
    return joined(space, points, pairs)


def joined(space: RoadmapSpace[Any], points: np.ndarray, pairs: np.ndarray) -> Graph:
    """The graph of those pairs (m, 2) of points between which the straight way is free."""
    blocks = np.array_split(pairs, max(1, -(-len(pairs) // BLOCK)))
    free = np.concatenate([space.free(points[i], points[j]) for i, j in (b.T for b in blocks)])
    edges = pairs[free].astype(np.int64)
    first, second = points[edges[:, 0]], points[edges[:, 1]]
    return Graph(points, edges, _costs(space, first, second), len(pairs))


def straightened(space: RoadmapSpace[Any], corners: np.ndarray) -> np.ndarray:
    """The corners (k, d) of a way, with shortcuts.

    The points of the way after each plan step, or fewer on a long way, and its corners are joined
    to all others that they can move straight to, and the cheapest way through them is taken. This
    is repeated as long as it helps.
    """
    cost = np.inf
    for _ in range(ROUNDS):
        times = _times(space, corners)
        spacing = max(1.0, times[-1] / MOST_POINTS)
        points = _along(corners, times, np.union1d(np.arange(0.0, times[-1], spacing), times))
        pairs = np.stack(np.triu_indices(len(points), 1), axis=-1)
        graph = joined(space, points, pairs)
        found = graph.quickest(0, len(points) - 1)
        assert found is not None  # the way itself is in the graph
        corners, before = points[found], cost
        cost = float(_costs(space, corners[:-1], corners[1:]).sum())
        if cost > before - 1e-6:
            break
    return corners


def resampled(space: RoadmapSpace[Any], corners: np.ndarray) -> np.ndarray:
    """The points (T + 1, d) of a way after each plan step; only the last step may be slower than
    the fastest."""
    times = _times(space, corners)
    return _along(corners, times, np.append(np.arange(times[-1] - 1e-9), times[-1]))


def _costs(space: RoadmapSpace[Any], first: np.ndarray, second: np.ndarray) -> np.ndarray:
    length = np.linalg.norm((second - first) / space.scale, axis=-1)
    costs: np.ndarray = space.steps(first, second) + LENGTH_COST * length
    return costs


def _times(space: RoadmapSpace[Any], corners: np.ndarray) -> np.ndarray:
    """Plan steps from the first to each corner."""
    return np.concatenate([[0.0], np.cumsum(space.steps(corners[:-1], corners[1:]))])


def _along(corners: np.ndarray, times: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The points on a way at the times `at`."""
    return np.stack([np.interp(at, times, column) for column in corners.T], axis=-1)


def best_cycle(lattice: Lattice) -> list[np.ndarray]:
    """The best move from each node of each layer: its index in `Lattice.moves`, of shape
    `Lattice.shape`, by dynamic programming over some cycles from the last layer backwards.

    With d the distance gained, rewards grow by the same factor everywhere on the way, so the value
    of a node is V(d, node) = growth^d W(node), and
    W(node) = max over moves of reward x worth(next node) + growth x W(next node).
    At the end of the last cycle W is 1, as much as a step at the goal earns at most: to come nearer
    to the goal counts most, and of equally fast motions the one that earns most is taken.
    """
    layers = range(lattice.layers)
    moves, worth = [lattice.moves(layer) for layer in layers], [lattice.worth(k) for k in layers]
    value = np.ones(lattice.shape)
    choice: list[np.ndarray] = []
    for layer in [*reversed(layers)] * CYCLES:
        following = worth[(layer + 1) % lattice.layers]
        best = np.full(lattice.shape, -np.inf)
        chosen = np.zeros(lattice.shape, np.int16)
        for index, move in enumerate(moves[layer]):
            here, there = _windows(lattice.shape, move.shift)
            gain = move.reward * following[there] + move.growth * value[there]
            better = gain > best[here]
            np.copyto(best[here], gain, where=better)
            np.copyto(chosen[here], index, where=better)
        value = best
        choice = [chosen, *choice[: lattice.layers - 1]]
    return choice


def _windows(
    shape: tuple[int, ...], shift: tuple[int, ...]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The nodes that a shift can start from, and those that it leads to."""
    here = tuple(slice(max(-s, 0), n - max(s, 0)) for n, s in zip(shape, shift, strict=True))
    there = tuple(slice(max(s, 0), n - max(-s, 0)) for n, s in zip(shape, shift, strict=True))
    return here, there


def cycled(lattice: Lattice, steps: int) -> np.ndarray:
    """The actions (steps, action_size) of the best cycle from the start, repeated."""
    choice = best_cycle(lattice)
    moves = [lattice.moves(layer) for layer in range(lattice.layers)]
    node, actions = lattice.start, []
    for step in range(steps):
        layer = step % lattice.layers
        move = moves[layer][choice[layer][node]]
        node = tuple(n + s for n, s in zip(node, move.shift, strict=True))
        actions.append(move.action)
    return np.array(actions)
