"""Changes to the physics that a policy was trained in."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco


@dataclass(frozen=True)
class Change:
    """Factors on the physics of a task.

    Attributes:
        mass: of every body, its inertia with it.
        friction: of every contact.
        strength: of every motor: the force or torque that it gives, and the most that it can.
    """

    mass: float = 1.0
    friction: float = 1.0
    strength: float = 1.0

    def apply(self, model: mujoco.MjModel) -> None:
        """Changes a compiled model in place."""
        model.body_mass *= self.mass
        model.body_inertia *= self.mass
        model.geom_friction *= self.friction
        model.actuator_gainprm *= self.strength
        model.actuator_biasprm *= self.strength
        model.actuator_forcerange *= self.strength
        # Recompute the values that the compiler derives from masses: weights of subtrees, inertias.
        mujoco.mj_setConst(model, mujoco.MjData(model))
