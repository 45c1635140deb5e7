"""Pushes: which are survived and recovered from, over force, heading and phase; in figures."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import isotonic_regression

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
    forces_N: as they act on this task's body.
    headings_rad: from the first axis of `Task.push_plane` to the second.
    phases: control steps at which the pushes begin.
    survived: by force, heading and phase, 0 or 1.
    recovered: survived and solved, the same.
    """

    forces_N: tuple[float, ...]  # noqa: N815  newtons
    headings_rad: tuple[float, ...]
    phases: tuple[int, ...]
    survived: tuple[tuple[tuple[int, ...], ...], ...]
    recovered: tuple[tuple[tuple[int, ...], ...], ...]

    def __post_init__(self) -> None:
        shape = (len(self.forces_N), len(self.headings_rad), len(self.phases))
        for name in ("survived", "recovered"):
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"{name} does not fit forces_N, headings_rad and phases")
        if np.any(np.greater(self.recovered, self.survived)):
            raise ValueError("recovered must not hold where survived does not")


@dataclass(frozen=True)
class Robustness:
    """What a policy stands, over a fixed grid of pushes, all of which are tried: the shares are
    exact, no samples of anything.

    Attributes:
        survival_100N: share of the pushes of the paper's claim that are survived.
        recovery_100N: that are survived and solved.
        survival_impulse_50: the impulse in N s at which half of the pushes are survived
            (`impulse_50`).
        survival_impulse_50_is_lower_bound: more than half survive the largest impulse tried, which
            it is.
        recovery_impulse_50: the same of pushes that are recovered from.
        recovery_impulse_50_is_lower_bound: the same.
        mass_scale: of this task's body to Laikago's; all forces are scaled by it.
        push_duration_s: of every push.
        surface: every push that was tried.
    """

    survival_100N: float  # noqa: N815
    recovery_100N: float  # noqa: N815
    survival_impulse_50: float
    survival_impulse_50_is_lower_bound: bool
    recovery_impulse_50: float
    recovery_impulse_50_is_lower_bound: bool
    mass_scale: float
    push_duration_s: float
    surface: Surface


@dataclass(frozen=True)
class Outcome:
    """Attributes:
    survived: which pushes are, shape (forces, headings, phases).
    recovered: which are survived and solved, the same shape.
    calm: whether the episode without a push is survived; and whether it is recovered, that is
        solved too.
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
    """Pushes a policy in every way that the protocol says."""
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
    """Mass of what a push moves, over Laikago's."""
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
    """What comes of every push.

    Args:
        policy: that is pushed.
        task: its task.
        forces: newtons, shape (n,).
        phases: control steps at which pushes begin.
        protocol: says headings, duration and physics.
        threads: for the physics, None for all cores.
        engine: that everything is played in.
    """
    calm = engine(task, 1, threads=threads, change=protocol.physics)
    moments = _moments(policy, task, phases, calm)
    headings = protocol.directions()
    shape = (len(forces), len(headings), len(phases))
    survived, recovered = np.zeros(shape, bool), np.zeros(shape, bool)
    if not moments.alive.any():
        return Outcome(survived, recovered, moments.calm)
    # By phase: what is pushed at one instant has as many steps left.
    grid = np.moveaxis(np.broadcast_to(moments.alive, shape), -1, 0)
    phase, force, heading = np.nonzero(grid)
    starts, courses = moments.starts.rows(phase), moments.courses.rows(phase)
    pushes = Push(
        time=starts.time,
        duration=np.full(len(phase), protocol.duration),
        force=forces[force, None] * direction(task, headings[heading]),
    )
    # The blocks share one physics: memory that is freed in between does not always go back.
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
        starts: places to go on from, one for each phase.
        courses: that led there.
        alive: whether the episode had not ended by then, shape (phases,).
        calm: whether it survived without a push, and whether it was solved too.
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
    """The smallest impulse that half of the pushes withstand: survive, or recover from.

    Their share over impulse is first made to fall monotonically, by the nearest such sequence in
    least squares, and then interpolated linearly between the impulses. No push is an impulse of
    zero, which all or none withstand.

    Args:
        impulses: tried, in N s, rising, shape (n,).
        shares: of the pushes withstood at each, shape (n,).
        unpushed: whether the episode without a push counts as one.

    Returns:
        N s; and whether that is only a lower bound, since more than half withstand the largest.
    """
    x = np.concatenate([[0.0], impulses])
    y = isotonic_regression(np.concatenate([[float(unpushed)], shares]), increasing=False).x
    below = np.flatnonzero(y <= 0.5)
    if not len(below):
        return float(x[-1]), True
    first = int(below[0])
    if first == 0:
        return 0.0, False
    share = (y[first - 1] - 0.5) / (y[first - 1] - y[first])
    return float(x[first - 1] + share * (x[first] - x[first - 1])), False
