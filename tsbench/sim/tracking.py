"""The imitation variant of a task: same states, actions and physics, a tracking reward."""

from __future__ import annotations

from tsbench.core.arrays import Array, array_namespace
from tsbench.core.motion import ReferenceMotion
from tsbench.core.state import Rng, S, Start
from tsbench.core.task import Plant, SimulatedTask, Task, plannable


class Imitation(SimulatedTask[S]):
    """A task whose reward, start and early ending follow a reference motion.

    Observations, actions and physics are the task's (P).

    Attributes:
        task: the task whose observations, actions and physics are used.
        tracker: the reward, start and ending that replace the task's.
    """

    def __init__(self, task: Task[S], reference: ReferenceMotion, form: str | None = None) -> None:
        """`form` picks one of the task's tracking rewards.

        Raises:
            TsbenchError: the task has no such variant, the reference does not fit it, or `form` is
                unknown.
        """
        self.task = task = plannable(task)
        task.check_fit(reference)
        self.tracker = task.tracker(reference, form)
        self.name, self.version = task.name, task.version
        self.timestep = task.timestep
        self.observation_size, self.action_size = task.observation_size, task.action_size
        self.horizon, self.max_reward = self.tracker.horizon, self.tracker.max_reward

    @property
    def plant(self) -> Plant[S]:
        return self.task

    def observation(self, state: S) -> Array:
        return self.task.observation(state)

    def value_observation(self, state: S) -> Array:
        return self.task.value_observation(state)

    def reward(self, previous: S, action: Array, state: S) -> Array:
        return self.tracker.reward(previous, action, state)

    def terminal(self, state: S) -> Array:
        return self.tracker.terminal(state)

    def violated(self, state: S) -> Array:
        return self.task.violated(state)

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        """Starts along the reference motion or, if perturbed, near the task's own start."""
        if perturbed:
            return self.task.start(rng, count, perturbed=True)
        return self.tracker.start(rng, count)


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
