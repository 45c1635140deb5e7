"""Changes to the physics that a policy was trained in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco

CONES = {
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
}


@dataclass(frozen=True)
class Change:
    """What is different in the physics of a task: factors, and how contacts and time are computed.

    Attributes:
        mass: of every body, its inertia with it.
        friction: of every contact.
        strength: of every motor: the force or torque that it gives, and the most that it can.
        cone: of friction in the contact solver, "pyramidal" or "elliptic"; None for the model's.
        impratio: stiffness of contacts against slipping over that against sinking in (mujoco's
            option of that name); None for the model's.
        refine: physics steps in place of one, each that much shorter. The control rate stays.
    """

    mass: float = 1.0
    friction: float = 1.0
    strength: float = 1.0
    cone: str | None = None
    impratio: float | None = None
    refine: int = 1

    def __post_init__(self) -> None:
        if self.cone is not None and self.cone not in CONES:
            raise ValueError(f"cone must be one of {', '.join(CONES)}, not {self.cone}")
        if self.impratio is not None and not 0.0 < self.impratio < math.inf:
            raise ValueError(f"impratio must be positive, not {self.impratio}")
        if not 1 <= self.refine <= 1000:
            raise ValueError(f"refine must lie between 1 and 1000, not {self.refine}")

    def after(self, first: Change) -> Change:
        """Both changes as one: factors multiply, and where both name a contact model this one
        holds."""
        return Change(
            mass=first.mass * self.mass,
            friction=first.friction * self.friction,
            strength=first.strength * self.strength,
            cone=first.cone if self.cone is None else self.cone,
            impratio=first.impratio if self.impratio is None else self.impratio,
            refine=first.refine * self.refine,
        )

    def apply(self, model: mujoco.MjModel) -> None:
        """Changes a compiled model in place. Whoever steps it has to take `refine` times as many
        steps."""
        model.body_mass *= self.mass
        model.body_inertia *= self.mass
        model.geom_friction *= self.friction
        model.pair_friction *= self.friction
        model.actuator_gainprm *= self.strength
        model.actuator_biasprm *= self.strength
        model.actuator_forcerange *= self.strength
        if self.cone is not None:
            model.opt.cone = CONES[self.cone]
        if self.impratio is not None:
            model.opt.impratio = self.impratio
        model.opt.timestep /= self.refine
        # What the compiler derived from masses: weights of subtrees, inertias at rest.
        mujoco.mj_setConst(model, mujoco.MjData(model))
