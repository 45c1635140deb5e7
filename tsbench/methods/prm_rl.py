"""PRM-RL (Faust et al. 2018): a roadmap whose edges a learned policy can drive, and that policy.

1. Drive: PPO learns to go to the task's goal from points near it. Sent to another point, the policy
   sees its state moved along with the world so that the point lies at the goal.
2. Roadmap: the edges on the quickest way are driven some times each, from rest and from the task's
   noisy starts. An edge is kept if the lower Wilson bound of its success is high enough; else the
   next quickest way is tried. Edges that lie on no such way are not driven, to save steps. An edge
   is driven in the direction of the way that is tried first, and its verdict holds for ways in the
   other direction too, though gravity makes the two differ.
3. Distil: the policy is sent from corner to corner of the way. Which corner is next depends on the
   position alone, so all that is a function of the task's observation. A network learns it by
   DAgger (Ross et al. 2011): in each round the network flies, and the sent policy says what it
   should have done.

All three take environment steps of the physics budget.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import binomtest

from tsbench.core.arrays import Array
from tsbench.core.errors import PlanError, TsbenchError
from tsbench.core.method import AUDITS, Problem, Workspace
from tsbench.core.policy import Policy
from tsbench.core.roadmap import DrivableSpace
from tsbench.core.state import Rng, S, Start
from tsbench.core.task import Plant, SimulatedTask, Task, plannable, roadmap_space
from tsbench.methods import options, planned_task
from tsbench.planning.roadmap import (
    Graph,
    Route,
    connected,
    expect_size,
    no_way,
    resampled,
    sampled,
)
from tsbench.rl.distil import Lesson, distilled
from tsbench.rl.stages import learn_physics, settings
from tsbench.sim.episodes import PolicyFunction, play
from tsbench.sim.kinematic import plan_along
from tsbench.sim.physics import Physics

STAGES = ("imitate",)

DETOUR = 1e3  # factor on the cost of an edge that failed: it is taken where nothing else is left
SLOWNESS, PATIENCE = 2.0, 2.0  # an edge may take this times the planner's seconds, and 2 s
ERRAND = 8.0  # s, of an episode of learning to drive
ROUNDS = 8  # of DAgger
EPOCHS, LAST = 10, 20  # passes over all that was seen, in a round and in the last one
FLIGHTS = 128  # episodes in a round, at most
CONFIDENCE = 0.95  # of the Wilson bounds


@dataclass(frozen=True)
class Options:
    """Attributes:
    samples: Halton samples of the roadmap, at most `roadmap.MOST_SAMPLES`.
    neighbours: nearest samples that each of them is joined to; samples times neighbours may be
        `roadmap.MOST_PAIRS`.
    reach: length of an edge at most, in plan steps; from as far away driving is learned.
    rollouts: how often an edge is driven: once from the nominal start, else from perturbed ones.
    least: lower Wilson bound of an edge's success that keeps it; at most that of an edge which all
        rollouts drive.
    drive: share of the physics budget spent on learning to drive.
    test: share spent on driving edges; the rest is for distilling.
    audit: what a way with edges that cannot be driven does: "stop" ends the run, "warn" goes on;
        None for what the budget says.
    """

    samples: int = 200
    neighbours: int = 48
    reach: float = 100.0
    rollouts: int = 20
    least: float = 0.7
    drive: float = 0.6
    test: float = 0.15
    audit: str | None = "warn"

    def __post_init__(self) -> None:
        for name, low, high in (
            ("rollouts", 2, 10_000), ("reach", 1.0, 1e6), ("least", 0.0, 1.0),
            ("drive", 0.01, 0.98), ("test", 0.0, 0.98),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must lie in {low} to {high}, not {getattr(self, name)}")
        expect_size(self.samples, self.neighbours)
        if (most := lower_bound(self.rollouts, self.rollouts)) < self.least:
            raise ValueError(
                f"least must be at most {most:.3f}, the bound of an edge that all {self.rollouts} "
                f"rollouts drive, not {self.least}: no edge would be kept"
            )
        if self.drive + self.test > 0.99:
            raise ValueError("test and drive must leave a share of the budget to distil with")
        if self.audit not in (None, *AUDITS):
            raise ValueError(f"audit must be stop, warn or null, not {self.audit}")


def lower_bound(driven: int, rollouts: int) -> float:
    """The lower Wilson bound of the success of an edge that was driven so often."""
    return float(binomtest(driven, rollouts).proportion_ci(CONFIDENCE, "wilson").low)


def train(problem: Problem, workspace: Workspace) -> Policy:
    chosen: Options = options(Options, problem)
    task = planned_task(problem, "prm_rl")
    space = roadmap_space(task, "prm_rl")
    if not isinstance(space, DrivableSpace):
        raise TsbenchError(f"the method prm_rl cannot do {task.name}: no policy goes to any point")
    act = problem.budget.act
    driving, testing = round(chosen.drive * act), round(chosen.test * act)
    errands = Errands(task, space, chosen.reach)
    driver = learn_physics(problem, workspace, "drive", errands, "imitate", driving)
    policy = driver.policy(task, "prm_rl")
    route = drivable_route(problem, workspace, space, policy, chosen, testing)
    plan = plan_along(task, space, route.points)
    plan.save(workspace.directory / "plan.npz")
    task.reference(plan).save(workspace.directory / "reference.npz")
    route.drawn(space, plan).save(workspace.directory / "roadmap.npz")
    return followed(problem, workspace, space, route, policy, act - driving - testing)


class Sent(SimulatedTask[S]):
    """A task whose observation sends a policy for it to other points than the goal."""

    def __init__(
        self,
        task: Task[S],
        space: DrivableSpace[S],
        target: Callable[[S], np.ndarray],
        horizon: int,
        *,
        arrives: bool = False,
    ) -> None:
        """`target` is where a state is sent to, (n, d) or (d,); `arrives` ends episodes there."""
        self.task, self.space, self.target, self.arrives = task, space, target, arrives
        self.name, self.version, self.timestep = task.name, task.version, task.timestep
        self.observation_size, self.action_size = task.observation_size, task.action_size
        self.max_reward, self.horizon = task.max_reward, horizon

    @property
    def plant(self) -> Plant[S]:
        return self.task

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        return self.task.start(rng, count, perturbed=perturbed)

    def observation(self, state: S) -> Array:
        return self.task.observation(self.space.sent(state, self.target(state)))

    def value_observation(self, state: S) -> Array:
        return self.task.value_observation(self.space.sent(state, self.target(state)))

    def reward(self, previous: S, action: Array, state: S) -> Array:
        return self.task.reward(previous, action, state)

    def reached(self, state: S) -> Array:
        away = self.task.goal_distance(self.space.sent(state, self.target(state)))
        return away < (self.space.near if self.arrives else 0.0)

    def terminal(self, state: S) -> Array:
        spoiled = self.task.terminal(state) | (self.arrives & self.task.violated(state))
        return spoiled | self.reached(state)

    def violated(self, state: S) -> Array:
        return self.task.violated(state)


def always(point: np.ndarray) -> Callable[[Any], np.ndarray]:
    """The same point (d,) from every state."""
    return lambda _: point


class Errands(Sent[S]):
    """To the task's goal from points within a reach of it."""

    def __init__(self, task: Task[S], space: DrivableSpace[S], reach: float) -> None:
        super().__init__(task, space, always(space.goal), round(ERRAND / task.timestep))
        self.reach = reach

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        away = self.reach * self.space.scale
        points = self.space.goal + rng.uniform(-away, away, (count, len(away)))
        points = np.clip(points, self.space.low, self.space.high)
        points = np.where(self.space.free(points, points)[:, None], points, self.space.goal)
        return self.space.moved(self.task.start(rng, count, perturbed=True), points)


def drivable_route(
    problem: Problem,
    workspace: Workspace,
    space: DrivableSpace[Any],
    driver: PolicyFunction,
    chosen: Options,
    budget: int,
) -> Route:
    """The quickest way through a roadmap, of edges that the driver can drive, and the graph of all
    such edges that were found.

    Raises:
        PlanError: the roadmap has no way to the goal; or the way has edges that cannot be driven
            or were not tried, and that stops the run.
    """
    graph = connected(space, sampled(space, chosen.samples, problem.seed), chosen.neighbours)
    short = space.steps(*graph.points[graph.edges.T]) <= chosen.reach
    graph = replace(graph, edges=graph.edges[short], costs=graph.costs[short])
    index = {frozenset(edge): k for k, edge in enumerate(graph.edges.tolist())}
    task, rollouts, rng = problem.task, chosen.rollouts, np.random.default_rng(problem.seed)
    physics: Physics[Any] = Physics(task, rollouts, threads=problem.threads)
    kept: dict[int, bool] = {}
    taken = 0
    with workspace.stage("roadmap", budget) as monitor:
        while True:
            way = graph.quickest(0, 1)
            if way is None:
                raise no_way(chosen.samples)
            edges = [(a, b, index[frozenset((a, b))]) for a, b in pairwise(way)]
            untried = [edge for edge in edges if edge[2] not in kept]
            if not untried:
                break
            a, b, edge = untried[0]
            first, second = graph.points[a], graph.points[b]
            seconds = plannable(task).abstraction().timestep * float(space.steps(first, second))
            horizon = round((SLOWNESS * seconds + PATIENCE) / task.timestep)
            if taken + rollouts * horizon > budget:
                break
            leg = Sent(task, space, always(second), horizon, arrives=True)
            # The nominal start gives one outcome only, so that all others are noisy.
            starts = [task.start(rng, 1), task.start(rng, rollouts - 1, perturbed=True)]
            start = space.moved(Start.joined(starts), first)
            begin = physics.place(np.arange(rollouts), start)
            episodes = play(leg, physics, driver, rollouts, begin=begin)
            driven = int((leg.reached(episodes.final) & ~episodes.course.violated).sum())
            kept[edge] = lower_bound(driven, rollouts) >= chosen.least
            if not kept[edge]:
                graph.costs[edge] *= DETOUR
            taken += int(episodes.lengths.sum())
            monitor.physics_substeps = physics.substeps
            monitor.update(taken, {"driven": driven / rollouts, "edges_kept": sum(kept.values())})
    bad = sum(not kept.get(edge, False) for _, _, edge in edges)
    workspace.note(
        f"roadmap: {len(kept)} of {len(graph.edges)} edges driven {rollouts} times each, "
        f"{sum(kept.values())} kept; {bad} of the way's {len(edges)} edges are none of them"
    )
    if bad and (chosen.audit or problem.budget.audit) == "stop":
        raise PlanError(
            f"{bad} of the way's {len(edges)} edges could not be driven; "
            "act more steps, or go on with method.audit=warn"
        )
    corners = graph.points[way]
    proved = np.array([edge for edge, held in kept.items() if held], int)
    graph = Graph(graph.points, graph.edges[proved], graph.costs[proved], len(kept))
    return Route(graph, corners, resampled(space, corners))


def next_corner(space: DrivableSpace[S], route: Route) -> Callable[[S], np.ndarray]:
    """Where on the way a state is sent to: the first corner beyond the nearest point of the way
    that is not yet near."""
    corners, points = route.corners, route.points
    length = np.linalg.norm(np.diff(corners, axis=0), axis=-1)
    at = np.concatenate([[0.0], np.cumsum(length)])  # of each corner, m from the start
    length = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    along = np.concatenate([[0.0], np.cumsum(length)])
    following = np.minimum(np.searchsorted(at, along + space.near), len(corners) - 1)

    def target(state: S) -> np.ndarray:
        away = np.linalg.norm(space.points(state)[:, None] - points, axis=-1)
        return corners[following[np.argmin(away, axis=-1)]]

    return target


def followed(
    problem: Problem,
    workspace: Workspace,
    space: DrivableSpace[Any],
    route: Route,
    driver: PolicyFunction,
    budget: int,
) -> Policy:
    """The policy that does what the driver does when it is sent from corner to corner of a way."""
    task, network = problem.task, settings(problem, "imitate")
    steps = max(1, budget // ROUNDS)
    flights = min(FLIGHTS, max(1, steps // task.horizon))
    horizon = min(task.horizon, max(1, steps // flights))
    sent = Sent(task, space, next_corner(space, route), horizon)
    alone = Sent(task, space, always(space.goal), horizon)
    size, rng = task.observation_size, np.random.default_rng(problem.seed)
    physics: Physics[Any] = Physics(task, flights, threads=problem.threads, perturbed=True)
    seen, right = np.zeros((0, size)), np.zeros((0, task.action_size))
    taken, policy = 0, None

    def both(state: Any) -> np.ndarray:
        return np.concatenate([alone.observation(state), sent.observation(state)], axis=-1)

    with workspace.stage("distil", budget) as monitor:
        for number in range(1, ROUNDS + 1):
            who, mdp = (driver, sent) if policy is None else (policy, alone)
            seed = int(rng.integers(2**31))
            episodes = play(mdp, physics, who, flights, seed, record=both)
            assert episodes.states is not None
            going = np.arange(len(episodes.rewards))[:, None] < episodes.lengths
            states = episodes.states[: len(going)][going]
            seen = np.concatenate([seen, states[:, :size]])
            right = np.concatenate([right, driver(states[:, size:])])
            taken += int(episodes.lengths.sum())
            epochs = LAST if number == ROUNDS else EPOCHS
            lesson = Lesson(seen, right)
            policy, error = distilled(task, "prm_rl", lesson, network, problem.seed, epochs)
            monitor.physics_substeps = physics.substeps
            reward = float(episodes.returns.mean())
            monitor.update(taken, {"episode_return": reward, "squared_error": error})
    assert policy is not None
    return policy
