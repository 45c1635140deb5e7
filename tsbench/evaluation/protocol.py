"""Evaluation protocol v1: everything that a score depends on beside the policy and the task.

It is frozen, and a test holds its hash. Whatever would change a number here makes a new protocol
with a new name. All policies meet the same starts, changes and pushes (common random numbers), and
an episode that fails stays in every mean as the failure that it is.

1. *Nominal*: one episode from the task's own start.
2. *Perturbed*: 100 episodes from the task's distribution of starts (`Task.start`). Episode i
   takes its start from a generator seeded with (seed, i), so that it can be had alone.
3. *Changes*: the first 20 of those starts in changed physics: other masses, friction and motors,
   actions that come late, and another contact model (an elliptic cone, half the time step): what
   a policy does must not hang on the solver that it was trained in.
4. *Pushes*: a horizontal force (for the rocket, one in its plane) on the body's centre of mass for
   0.1 s, at 16 headings and at every phase of the motion (`Task.push_steps`), in the nominal
   episode. The forces are those on a body of Laikago's mass; on another they are scaled by mass,
   so that a push would change the velocity of a free body by the same: 100 N by 0.393 m/s. What
   comes before the push is the same for all, so that it is played once and gone on from; what
   comes after is played to the end of the episode.

*Solved*: what the task calls success (`Task.success`), judged over the whole episode.
*Survived*: the episode went on to its last step or its goal without a violation. A fall, a
collision, and leaving the world or straying beyond the start are failures, and so is an episode
that is over before its push: nobody has seen it survive. *Recovered*: survived and solved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tsbench.core.state import Start
from tsbench.core.task import Task
from tsbench.sim.change import Change

REFERENCE_MASS = 25.433  # kg, of Laikago


@dataclass(frozen=True)
class Condition:
    """Physics that a policy was not trained for.

    Attributes:
        name: as the score has it.
        change: to the model.
        delay: control steps by which actions come late.
    """

    name: str
    change: Change = field(default_factory=Change)
    delay: int = 0

    def on(self, physics: Change) -> Condition:
        """The same on top of another physics."""
        return replace(self, change=self.change.after(physics))


@dataclass(frozen=True)
class Protocol:
    """Attributes:
    name: as the score has it.
    ranked: whether a score by it can stand on a leaderboard.
    seed: of all random starts.
    perturbed: episodes from perturbed starts.
    changed: how many of the same starts are played in each changed physics.
    conditions: the changed physics.
    headings: of the pushes, evenly spread from the first axis of `Task.push_plane` on.
    phases: of the pushes: 1 takes all of `Task.push_steps`, 2 every second one.
    forces: of the pushes in newtons, on a body of `REFERENCE_MASS`, rising.
    claim: the one of them that the paper claims to be survived.
    duration: of the pushes in seconds.
    logged: perturbed episodes whose actions are kept, to replay the physics from.
    tolerance: by which shares may differ on another kind of machine, and rewards as shares of the
        best motion's.
    impulse_tolerance: the same for impulses, as a share.
    physics: what everything is played in; the changes of the conditions come on top.
    """

    name: str
    ranked: bool
    seed: int
    perturbed: int
    changed: int
    conditions: tuple[Condition, ...]
    headings: int
    phases: int
    forces: tuple[float, ...]
    claim: float = 100.0
    duration: float = 0.1
    logged: int = 10
    tolerance: float = 0.05
    impulse_tolerance: float = 0.1
    physics: Change = field(default_factory=Change)

    def directions(self) -> np.ndarray:
        """The headings in radians, shape (headings,)."""
        return np.arange(self.headings) * (2.0 * math.pi / self.headings)

    def elsewhere(self, physics: str) -> Protocol:
        """The same asked in another physics, one of `PHYSICS`. No score by it can be ranked."""
        name = f"{self.name} in {physics}"
        return replace(self, name=name, ranked=False, physics=PHYSICS[physics])


# Other ways to compute the same world, by name. "warp" changes nothing in the model: it is another
# engine, which `evaluate` has to be given (`sim.warp.HostPhysics`).
PHYSICS = {
    "elliptic": Change(cone="elliptic", impratio=10.0),
    "half_step": Change(refine=2),
    "warp": Change(),
}
CONDITIONS = (
    Condition("mass x 0.8", Change(mass=0.8)),
    Condition("mass x 1.2", Change(mass=1.2)),
    Condition("friction x 0.5", Change(friction=0.5)),
    Condition("friction x 1.25", Change(friction=1.25)),
    Condition("motor strength x 0.8", Change(strength=0.8)),
    Condition("motor strength x 1.2", Change(strength=1.2)),
    Condition("latency 1 control step", delay=1),
    Condition("latency 2 control steps", delay=2),
    Condition("elliptic cone", PHYSICS["elliptic"]),
    Condition("half the time step", PHYSICS["half_step"]),
)

V1 = Protocol(
    name="v1",
    ranked=True,
    seed=0,
    perturbed=100,
    changed=20,
    conditions=CONDITIONS,
    headings=16,
    phases=1,
    forces=(50, 100, 150, 200, 250, 300, 350, 400, 450, 500, 550, 600),
)
# For runs that take seconds: the same questions, asked too seldom for an answer.
SMOKE = Protocol(
    name="smoke",
    ranked=False,
    seed=0,
    perturbed=10,
    changed=1,
    conditions=(CONDITIONS[0], CONDITIONS[7]),
    headings=4,
    phases=8,
    forces=(100, 400),
)
PROTOCOLS = {protocol.name: protocol for protocol in (V1, SMOKE)}


def perturbed_starts(task: Task[Any], protocol: Protocol) -> Start:
    """Episode i starts as a dm_control environment of the task seeded with (seed, i) does."""
    return Start.joined(
        [
            task.start(np.random.default_rng((protocol.seed, episode)), 1, perturbed=True)
            for episode in range(protocol.perturbed)
        ]
    )
