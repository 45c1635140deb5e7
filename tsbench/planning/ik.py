"""Inverse kinematics: full poses for a legged robot from its base and feet, by mink."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from tsbench.core.lazy import Lazy

if TYPE_CHECKING:
    import mink
else:
    mink = Lazy("mink")  # loads as long as all else that a task needs

SOLVER = "daqp"
TOLERANCE = 1e-4  # m, within which a foot counts as at its target
MAX_ITERATIONS = 50
DT = 1.0  # s, nominal: mink divides by it, the integration multiplies by it


class FootPoses:
    """Solves for joint angles that put the feet at their targets while the base is fixed.

    Each solution starts from the one before, so neighbouring targets give neighbouring poses.
    """

    def __init__(self, model: mujoco.MjModel, feet: Sequence[str], home: np.ndarray) -> None:
        """
        Args:
            model: a robot whose first joint is free.
            feet: names of the sites at the foot centres.
            home: generalised positions that the first solution starts from, shape (nq,).
        """
        self._home = home.copy()
        self._feet = [model.site(foot).id for foot in feet]
        self._configuration = mink.Configuration(model, q=home.copy())
        self._tasks = [
            mink.FrameTask(foot, "site", position_cost=1.0, orientation_cost=0.0) for foot in feet
        ]
        self._freeze = [mink.DofFreezingTask(model, dof_indices=list(range(6)))]
        self._limits = [mink.ConfigurationLimit(model)]

    def solve(self, base: np.ndarray, feet: np.ndarray) -> tuple[np.ndarray, float]:
        """Solves for one pose.

        Args:
            base: base position and orientation quaternion (w, x, y, z), shape (7,).
            feet: foot centres in the world frame in metres, shape (feet, 3).

        Returns:
            Generalised positions, shape (nq,), and the largest distance that remains between a
            foot and its target in metres. Joint limits always hold, so a target out of reach leaves
            a distance. The caller judges it.
        """
        q, residual = self._descend(self._configuration.q, base, feet)
        if residual > TOLERANCE:  # perhaps a local minimum: try again from the home pose
            again, other = self._descend(self._home, base, feet)
            if other < residual:
                q, residual = again, other
        self._configuration.update(q)
        return q, residual

    def _descend(
        self, first: np.ndarray, base: np.ndarray, feet: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Gauss-Newton iterations from the joint angles of `first`. See `solve`."""
        configuration = self._configuration
        q = first.copy()
        q[:7] = base
        configuration.update(q)
        for task, target in zip(self._tasks, feet, strict=True):
            task.set_target(mink.SE3.from_translation(target))
        residual = self._residual(feet)
        for _ in range(MAX_ITERATIONS):
            if residual < TOLERANCE:
                break
            try:
                velocity = mink.solve_ik(
                    configuration,
                    self._tasks,
                    DT,
                    SOLVER,
                    damping=1e-8,
                    limits=self._limits,
                    constraints=self._freeze,
                )
            except mink.NoSolutionFound:
                break
            configuration.integrate_inplace(velocity, DT)
            improved = self._residual(feet)
            if improved > 0.999 * residual:  # the joint limits allow no further progress
                residual = improved
                break
            residual = improved
        return configuration.q.copy(), residual

    def _residual(self, feet: np.ndarray) -> float:
        found = self._configuration.data.site_xpos[self._feet]
        return float(np.linalg.norm(found - feet, axis=-1).max())
