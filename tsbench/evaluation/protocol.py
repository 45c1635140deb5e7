"""Evaluation protocol v1: everything that a score depends on beside the policy and the task.

The protocol is frozen, and a test holds its hash. Another number makes a new protocol with a new
name. All policies meet the same starts, changes and pushes (common random numbers). Every mean
includes the episodes that fail.

1. *Nominal*: one episode from the task's own start.
2. *Perturbed*: 100 episodes from the task's distribution of starts (`Task.start`). A generator
   seeded with (seed, i) draws the start of episode i, so that each episode can be repeated alone.
3. *Changes*: the first 20 perturbed starts in changed physics: other masses, friction and motor
   strength, late actions, and another contact model (an elliptic cone, half the time step). A score
   must not depend on the solver in which the policy was trained.
4. *Pushes*: a force on the body's centre of mass for 0.1 s during the nominal episode, at 16
   headings in the task's push plane and at every phase of the motion (`Task.push_steps`). The
   protocol gives the forces on a body of Laikago's mass. They are scaled by mass for other bodies,
   so that equal pushes change the velocity of a free body equally: 100 N by 0.393 m/s. The steps
   before a push are the same for all pushes and are played once. The steps after a push are played
   to the end of the episode.

*Solved*: the whole episode meets the task's definition of success (`Task.success`).
*Survived*: the episode went on to its last step or its goal without a violation. A fall, a
collision, leaving the world and straying beyond the start are failures. An episode that ends before
its push has not survived the push. *Recovered*: survived and solved.
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
        name: the key of this condition in a score.
        change: the change of the model.
        delay: control steps by which actions come late.
    """

    name: str
    change: Change = field(default_factory=Change)
    delay: int = 0

    def on(self, physics: Change) -> Condition:
        """The same condition on top of other physics."""
        return replace(self, change=self.change.after(physics))


@dataclass(frozen=True)
class Protocol:
    """Attributes:
    name: the name of the protocol, which a score carries.
    ranked: whether a leaderboard may rank scores by this protocol.
    seed: seed of all random starts.
    perturbed: number of episodes from perturbed starts.
    changed: number of these starts that are also played in each changed physics.
    conditions: the changed physics.
    headings: number of headings of the pushes, evenly spread from the first axis of
        `Task.push_plane`.
    phases: stride through `Task.push_steps`: 1 takes every phase, 2 every second one.
    forces: forces of the pushes in newtons on a body of `REFERENCE_MASS`, rising.
    claim: the force that the paper claims a policy to survive.
    duration: seconds of a push.
    logged: number of perturbed episodes whose actions are kept, so that the physics can be
        replayed.
    tolerance: allowed difference of shares between kinds of machine. Rewards may differ by this
        share of the best motion's reward.
    impulse_tolerance: allowed difference of impulses, as a share of the larger one.
    physics: the physics of all episodes. The changes of the conditions come on top.
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
        """The same protocol in other physics, one of `PHYSICS`. Its scores are never ranked."""
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
# For runs that take seconds: the same parts with too few episodes to judge a policy.
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
    """The starts of the perturbed episodes. A generator seeded with (seed, i) draws start i. A
    dm_control environment of the task with that seed starts in the same state."""
    return Start.joined(
        [
            task.start(np.random.default_rng((protocol.seed, episode)), 1, perturbed=True)
            for episode in range(protocol.perturbed)
        ]
    )
