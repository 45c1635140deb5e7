"""The imitation variant of a task: same states, actions and physics, a tracking reward."""

from __future__ import annotations

from typing import Any

import mujoco

from tsbench.mdp import Abstraction, Array, Readings, Rng, S, Start, Task, array_namespace
from tsbench.motion import Audit, Plan, ReferenceMotion


class Imitation(Task[S]):
    """A task whose reward, start and early ending follow a reference motion."""

    def __init__(self, task: Task[S], reference: ReferenceMotion, form: str | None = None) -> None:
        """`form` picks one of the task's tracking rewards.

        Raises:
            TsbenchError: the reference does not fit the task, or `form` is unknown.
        """
        task.check_fit(reference)
        self.task = task
        self._reference = reference
        self.tracking = task.tracker(reference, form)
        self.name = task.name
        self.version = task.version
        self.horizon = self.tracking.horizon
        self.timestep = task.timestep
        self.substeps = task.substeps
        self.pushed = task.pushed
        self.push_plane = task.push_plane
        self.imitation_forms = task.imitation_forms
        self.observation_size = task.observation_size
        self.action_size = task.action_size
        self.max_reward = self.tracking.max_reward

    def reward(self, previous: S, action: Array, state: S) -> Array:
        return self.tracking.reward(previous, action, state)

    def terminal(self, state: S) -> Array:
        return self.tracking.terminal(state)

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """Starts along the reference motion; perturbed, anywhere near the task's own start."""
        return (
            self.task.start(rng, count, perturbed=True)
            if perturbed
            else self.tracking.start(rng, count)
        )

    def observation(self, state: S) -> Array:
        return self.task.observation(state)

    def spec(self) -> mujoco.MjSpec:
        return self.task.spec()

    def control(self, state: S, action: Array) -> tuple[Array, Array]:
        return self.task.control(state, action)

    def read(self, readings: Readings) -> S:
        return self.task.read(readings)

    def memory(self, state: S) -> Array:
        return self.task.memory(state)

    @property
    def push_steps(self) -> tuple[int, ...]:
        return self.task.push_steps

    def success(self, state: S) -> Array:
        return self.task.success(state)

    def violated(self, state: S) -> Array:
        return self.task.violated(state)

    def goal_distance(self, state: S) -> Array:
        return self.task.goal_distance(state)

    def ideal(self) -> S:
        return self.task.ideal()

    def abstraction(self) -> Abstraction[S]:
        return self.task.abstraction()

    def reference(self, plan: Plan) -> ReferenceMotion:
        return self.task.reference(plan)

    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        return self.task.audit(plan, reference)

    def constants(self) -> dict[str, Any]:
        return self.task.constants()

    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> Any:
        return self.task.tracker(reference, form)


def deepmimic_reward(pose: Array, velocity: Array, end_effectors: Array, com: Array) -> Array:
    """The tracking reward of DeepMimic (Peng et al. 2018, arXiv 1804.02717, section 5).

    0.65 exp(-2 sum pose^2) + 0.1 exp(-0.1 sum velocity^2)
    + 0.15 exp(-40 sum end_effectors^2) + 0.1 exp(-10 |com|^2), at most 1.

    Args:
        pose: rotation angle between each joint and its reference in radians, shape (..., joints).
        velocity: joint velocity errors in rad/s, shape (..., joints).
        end_effectors: end effector position errors in metres, shape (..., feet, 3).
        com: error of the whole-body centre of mass in metres, shape (..., 3).
    """
    xp = array_namespace(pose)
    return (
        0.65 * xp.exp(-2.0 * xp.sum(pose * pose, axis=-1))
        + 0.1 * xp.exp(-0.1 * xp.sum(velocity * velocity, axis=-1))
        + 0.15 * xp.exp(-40.0 * xp.sum(end_effectors * end_effectors, axis=(-2, -1)))
        + 0.1 * xp.exp(-10.0 * xp.sum(com * com, axis=-1))
    )
