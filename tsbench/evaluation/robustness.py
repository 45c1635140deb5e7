"""Pushes: the survival surface over force, heading and phase, and its summaries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.stats import binomtest

from tsbench.core.state import Start
from tsbench.core.task import Task
from tsbench.evaluation.protocol import REFERENCE_MASS, Protocol
from tsbench.sim.episodes import PolicyFunction, play
from tsbench.sim.physics import Physics
from tsbench.sim.push import Push, direction

# Pushes that are played side by side. Each rocket takes 15 MB of address space; more are no faster.
_BLOCK = 128


@dataclass(frozen=True)
class Surface:
    """Attributes:
    forces_N: as they act on this task's body.
    headings_rad: from the first axis of `Task.push_plane` to the second.
    phases: control steps at which the pushes begin.
    survived: by force, heading and phase, 0 or 1.
    """

    forces_N: tuple[float, ...]  # noqa: N815  newtons
    headings_rad: tuple[float, ...]
    phases: tuple[int, ...]
    survived: tuple[tuple[tuple[int, ...], ...], ...]

    def __post_init__(self) -> None:
        shape = (len(self.forces_N), len(self.headings_rad), len(self.phases))
        if np.shape(self.survived) != shape:
            raise ValueError("survived does not fit forces_N, headings_rad and phases")


@dataclass(frozen=True)
class Robustness:
    """Attributes:
    survival_100N: share of the pushes of the paper's claim that are survived.
    survival_100N_interval: 95 % by Wilson's score, [low, high].
    impulse_50: the impulse in N s at which half of the pushes are survived (`impulse_50`).
    impulse_50_is_lower_bound: more than half survive the largest impulse tried, which it is.
    mass_scale: of this task's body to Laikago's; all forces are scaled by it.
    push_duration_s: of every push.
    surface: every push that was tried.
    """

    survival_100N: float  # noqa: N815
    survival_100N_interval: tuple[float, float]  # noqa: N815
    impulse_50: float
    impulse_50_is_lower_bound: bool
    mass_scale: float
    push_duration_s: float
    surface: Surface


def robustness(
    policy: PolicyFunction, task: Task[Any], protocol: Protocol, threads: int | None = None
) -> Robustness:
    """Pushes a policy in every way that the protocol says."""
    scale = mass_scale(task)
    forces = np.array(protocol.forces, float) * scale
    phases = task.push_steps[:: protocol.phases]
    survived, unpushed = survival(policy, task, forces, phases, protocol, threads)
    by_force = survived.mean(axis=(1, 2))
    claimed = survived[protocol.forces.index(protocol.claim)]
    middle, is_bound = impulse_50(forces * protocol.duration, by_force, unpushed)
    return Robustness(
        survival_100N=float(claimed.mean()),
        survival_100N_interval=wilson(int(claimed.sum()), claimed.size),
        impulse_50=middle,
        impulse_50_is_lower_bound=is_bound,
        mass_scale=scale,
        push_duration_s=protocol.duration,
        surface=Surface(
            forces_N=tuple(forces.tolist()),
            headings_rad=tuple(protocol.directions().tolist()),
            phases=phases,
            survived=tuple(
                tuple(tuple(row) for row in plane) for plane in survived.astype(int).tolist()
            ),
        ),
    )


def mass_scale(task: Task[Any]) -> float:
    """Mass of what a push moves, over Laikago's."""
    model = task.spec().compile()
    mass = float(model.body_subtreemass[model.body(task.pushed).id])
    return round(mass / REFERENCE_MASS, 6)


def survival(
    policy: PolicyFunction,
    task: Task[Any],
    forces: np.ndarray,
    phases: tuple[int, ...],
    protocol: Protocol,
    threads: int | None = None,
) -> tuple[np.ndarray, bool]:
    """Which pushes are survived, shape (forces, headings, phases); and whether none would be.

    Args:
        policy: that is pushed.
        task: its task.
        forces: newtons, shape (n,).
        phases: control steps at which pushes begin.
        protocol: says headings and duration.
        threads: for the physics, None for all cores.
    """
    moments, alive, unpushed = _moments(policy, task, phases, threads)
    headings = protocol.directions()
    shape = (len(forces), len(headings), len(phases))
    survived = np.zeros(shape, bool)
    if not alive.any():
        return survived, unpushed
    # By phase: what is pushed at one instant has as many steps left.
    phase, force, heading = np.nonzero(np.moveaxis(np.broadcast_to(alive, shape), -1, 0))
    starts = moments.rows(phase)
    pushes = Push(
        time=starts.time,
        duration=np.full(len(phase), protocol.duration),
        force=forces[force, None] * direction(task, headings[heading]),
    )
    # The blocks share one physics: memory that is freed in between does not always go back.
    physics: Physics[Any] = Physics(task, min(_BLOCK, len(phase)), threads=threads)
    for first in range(0, len(phase), _BLOCK):
        block = slice(first, first + _BLOCK)
        rows = np.arange(len(phase[block]))
        physics.push = pushes.rows(block)
        begin = physics.place(rows, starts.rows(block))
        episodes = play(task, physics, policy, len(rows), begin=begin)
        survived[force[block], heading[block], phase[block]] = episodes.survived
    return survived, unpushed


def _moments(
    policy: PolicyFunction, task: Task[Any], phases: tuple[int, ...], threads: int | None
) -> tuple[Start, np.ndarray, bool]:
    """The nominal episode at each phase, as places to go on from; whether it had not ended by
    then, shape (phases,); and whether it survived without a push."""
    physics: Physics[Any] = Physics(task, 1, threads=threads)
    qpos, qvel = physics.batch.bind("qpos"), physics.batch.bind("qvel")

    def record(state: Any) -> np.ndarray:
        return np.concatenate([state.time[:, None], qpos, qvel, task.memory(state)], axis=-1)

    episode = play(task, physics, policy, 1, record=record)
    assert episode.states is not None
    at = np.array(phases)
    ends = np.cumsum([1, qpos.shape[1], qvel.shape[1]])
    time, positions, velocities, memory = np.split(episode.states[at, 0], ends, axis=-1)
    moments = Start(time[:, 0], positions, velocities, memory)
    return moments, at < episode.lengths[0], bool(episode.survived[0])


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % confidence interval of a share by Wilson's score (J. Am. Stat. Assoc. 22, 1927)."""
    interval = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def impulse_50(
    impulses: np.ndarray, survival: np.ndarray, unpushed: bool = True
) -> tuple[float, bool]:
    """The smallest impulse at which half of the pushes are survived.

    Survival over impulse is first made to fall monotonically, by the nearest such sequence in
    least squares, and then interpolated linearly between the impulses. No push is an impulse of
    zero, which all or none survive.

    Args:
        impulses: tried, in N s, rising, shape (n,).
        survival: share of the pushes survived at each, shape (n,).
        unpushed: whether the episode without a push is survived.

    Returns:
        N s; and whether that is only a lower bound, since more than half survive the largest.
    """
    x = np.concatenate([[0.0], impulses])
    y = isotonic_regression(np.concatenate([[float(unpushed)], survival]), increasing=False).x
    below = np.flatnonzero(y <= 0.5)
    if not len(below):
        return float(x[-1]), True
    first = int(below[0])
    if first == 0:
        return 0.0, False
    share = (y[first - 1] - 0.5) / (y[first - 1] - y[first])
    return float(x[first - 1] + share * (x[first] - x[first - 1])), False
