"""Robustness: the pushes that a policy survives and recovers from, by force, heading and phase."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy  # loads `scipy.optimize` when it is used

from tsbench.core.state import Course, Start
from tsbench.core.task import Task
from tsbench.evaluation.protocol import REFERENCE_MASS, Protocol
from tsbench.sim.dynamics import Engine, PlacedDynamics
from tsbench.sim.episodes import PolicyFunction, play
from tsbench.sim.physics import Physics
from tsbench.sim.push import Push, direction


@dataclass(frozen=True)
class Surface:
    """Attributes:
    forces_N: the forces on this task's body.
    headings_rad: angles from the first axis of `Task.push_plane` towards the second.
    phases: control steps at which the pushes begin.
    survived: 1 for each push that was survived, else 0, by force, heading and phase.
    recovered: 1 for each push that was survived and after which the task was solved, else 0, in
        the same order.
    """

    forces_N: tuple[float, ...]  # noqa: N815  newtons
    headings_rad: tuple[float, ...]
    phases: tuple[int, ...]
    survived: tuple[tuple[tuple[int, ...], ...], ...] = field(repr=False)
    recovered: tuple[tuple[tuple[int, ...], ...], ...] = field(repr=False)

    def __post_init__(self) -> None:
        shape = (len(self.forces_N), len(self.headings_rad), len(self.phases))
        for name in ("survived", "recovered"):
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"{name} does not fit forces_N, headings_rad and phases")
        if not all(abs(heading) <= 2.0 * math.pi for heading in self.headings_rad):
            raise ValueError("headings_rad must lie within a turn")
        if np.any(np.greater(self.recovered, self.survived)):
            raise ValueError("recovered must not hold where survived does not")


@dataclass(frozen=True)
class Robustness:
    """The pushes that a policy withstands. Every push of a fixed grid is tried once, so the shares
    are exact and no samples.

    Attributes:
        survival_100N: share of the pushes with the force of the paper's claim that are survived.
        recovery_100N: share of the same pushes that are recovered from: survived, and the task
            solved.
        survival_impulse_50: the impulse in N s at which half of the pushes are survived
            (`impulse_50`).
        survival_impulse_50_is_lower_bound: whether more than half of the pushes with the largest
            impulse are survived. `survival_impulse_50` is then that impulse.
        recovery_impulse_50: the impulse in N s at which half of the pushes are recovered from.
        recovery_impulse_50_is_lower_bound: the same as for survival.
        mass_scale: mass of this task's body over Laikago's. All forces are scaled by this number.
        push_duration_s: seconds of every push.
        surface: every push, with its outcome.
    """

    survival_100N: float  # noqa: N815
    recovery_100N: float  # noqa: N815
    survival_impulse_50: float
    survival_impulse_50_is_lower_bound: bool
    recovery_impulse_50: float
    recovery_impulse_50_is_lower_bound: bool
    mass_scale: float
    push_duration_s: float
    surface: Surface = field(repr=False)


@dataclass(frozen=True)
class Outcome:
    """Attributes:
    survived: whether each push is survived, shape (forces, headings, phases).
    recovered: whether each push is survived and the task solved, the same shape.
    calm: whether the episode without a push is survived, and whether it is also solved.
    """

    survived: np.ndarray
    recovered: np.ndarray
    calm: tuple[bool, bool]


def robustness(
    policy: PolicyFunction,
    task: Task[Any],
    protocol: Protocol,
    threads: int | None = None,
    engine: Engine = Physics,
) -> Robustness:
    """Plays every push of the protocol."""
    scale = mass_scale(task)
    forces = np.array(protocol.forces, float) * scale
    phases = task.push_steps[:: protocol.phases]
    outcome = pushed(policy, task, forces, phases, protocol, threads, engine)
    claim, impulses = protocol.forces.index(protocol.claim), forces * protocol.duration
    (survival, survival_bound), (recovery, recovery_bound) = (
        impulse_50(impulses, held.mean(axis=(1, 2)), calm)
        for held, calm in zip((outcome.survived, outcome.recovered), outcome.calm, strict=True)
    )
    return Robustness(
        survival_100N=float(outcome.survived[claim].mean()),
        recovery_100N=float(outcome.recovered[claim].mean()),
        survival_impulse_50=survival,
        survival_impulse_50_is_lower_bound=survival_bound,
        recovery_impulse_50=recovery,
        recovery_impulse_50_is_lower_bound=recovery_bound,
        mass_scale=scale,
        push_duration_s=protocol.duration,
        surface=Surface(
            forces_N=tuple(forces.tolist()),
            headings_rad=tuple(protocol.directions().tolist()),
            phases=phases,
            survived=_plain(outcome.survived),
            recovered=_plain(outcome.recovered),
        ),
    )


def _plain(surface: np.ndarray) -> tuple[tuple[tuple[int, ...], ...], ...]:
    return tuple(tuple(tuple(row) for row in plane) for plane in surface.astype(int).tolist())


def mass_scale(task: Task[Any]) -> float:
    """The mass that a push moves, over Laikago's mass."""
    model = task.spec().compile()
    mass = float(model.body_subtreemass[model.body(task.pushed).id])
    return round(mass / REFERENCE_MASS, 6)


def pushed(
    policy: PolicyFunction,
    task: Task[Any],
    forces: np.ndarray,
    phases: tuple[int, ...],
    protocol: Protocol,
    threads: int | None = None,
    engine: Engine = Physics,
) -> Outcome:
    """The outcome of every push.

    Args:
        policy: the policy of the pushed robot.
        task: the task of the policy.
        forces: newtons, shape (n,).
        phases: control steps at which the pushes begin.
        protocol: gives headings, duration and physics.
        threads: threads of the physics, None for all cores.
        engine: the physics that plays everything.
    """
    calm = engine(task, 1, threads=threads, change=protocol.physics)
    moments = _moments(policy, task, phases, calm)
    headings = protocol.directions()
    shape = (len(forces), len(headings), len(phases))
    survived, recovered = np.zeros(shape, bool), np.zeros(shape, bool)
    if not moments.alive.any():
        return Outcome(survived, recovered, moments.calm)
    # Sorted by phase, so that the episodes of a block have about equally many steps left.
    grid = np.moveaxis(np.broadcast_to(moments.alive, shape), -1, 0)
    phase, force, heading = np.nonzero(grid)
    starts, courses = moments.starts.rows(phase), moments.courses.rows(phase)
    pushes = Push(
        time=starts.time,
        duration=np.full(len(phase), protocol.duration),
        force=forces[force, None] * direction(task, headings[heading]),
    )
    # All blocks share one physics, because freed memory does not always return to the system.
    size = min(calm.side_by_side, len(phase))
    physics = engine(task, size, threads=threads, change=protocol.physics)
    for first in range(0, len(phase), size):
        block = slice(first, first + size)
        rows = np.arange(len(phase[block]))
        physics.push = pushes.rows(block)
        begin, course = physics.place(rows, starts.rows(block)), courses.rows(block)
        episodes = play(task, physics, policy, len(rows), begin=begin, course=course)
        at = force[block], heading[block], phase[block]
        survived[at] = episodes.survived
        recovered[at] = episodes.survived & task.success(episodes.final, episodes.course)
    return Outcome(survived, recovered, moments.calm)


@dataclass(frozen=True)
class _Moments:
    """The nominal episode at each phase.

    Attributes:
        starts: the state at each phase, from which pushed episodes begin.
        courses: the course of the episode up to each phase.
        alive: whether the episode had not ended before each phase, shape (phases,).
        calm: whether the nominal episode is survived, and whether it is also solved.
    """

    starts: Start
    courses: Course
    alive: np.ndarray
    calm: tuple[bool, bool]


def _moments(
    policy: PolicyFunction,
    task: Task[Any],
    phases: tuple[int, ...],
    physics: PlacedDynamics[Any],
) -> _Moments:
    """The episode that `physics`, of one simulation, plays."""
    states: list[Any] = []

    def record(state: Any) -> np.ndarray:
        states.append(state)
        place = [state.time[:, None], *physics.pose(), task.memory(state)]
        return np.concatenate(place, axis=-1)

    episode = play(task, physics, policy, 1, record=record)
    assert episode.states is not None
    courses = [task.begun(states[0])]
    for previous, state in itertools.pairwise(states):
        courses.append(task.followed(courses[-1], previous, state))
    at = np.array(phases)
    ends = np.cumsum([1, *(part.shape[1] for part in physics.pose())])
    time, positions, velocities, memory = np.split(episode.states[at, 0], ends, axis=-1)
    survived = bool(episode.survived[0])
    return _Moments(
        starts=Start(time[:, 0], positions, velocities, memory),
        courses=Course.joined(courses).rows(np.minimum(at, len(courses) - 1)),
        alive=at < episode.lengths[0],
        calm=(survived, survived and bool(task.success(episode.final, episode.course)[0])),
    )


def impulse_50(
    impulses: np.ndarray, shares: np.ndarray, unpushed: bool = True
) -> tuple[float, bool]:
    """The smallest impulse at which at most half of the pushes are withstood.

    The shares are first replaced by the nearest sequence, in least squares, that never rises with
    the impulse. They are then interpolated linearly between the impulses. The episode without a
    push gives the share at an impulse of zero, which is 1 or 0.

    Args:
        impulses: the impulses of the pushes in N s, rising, shape (n,).
        shares: share of the pushes that are withstood (survived, or recovered from) at each
            impulse, shape (n,).
        unpushed: whether the episode without a push is withstood.

    Returns:
        The impulse in N s, and whether the impulse is only a lower bound, because more than half of
        the largest pushes are withstood.
    """
    x = np.concatenate([[0.0], impulses])
    y = scipy.optimize.isotonic_regression(
        np.concatenate([[float(unpushed)], shares]), increasing=False
    ).x
    below = np.flatnonzero(y <= 0.5)
    if not len(below):
        return float(x[-1]), True
    first = int(below[0])
    if first == 0:
        return 0.0, False
    share = (y[first - 1] - 0.5) / (y[first - 1] - y[first])
    return float(x[first - 1] + share * (x[first] - x[first - 1])), False
