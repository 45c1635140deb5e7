"""The planning variant of a task: its reward, start and ending under kinematic dynamics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from tsbench.core.arrays import Array
from tsbench.core.motion import Plan
from tsbench.core.roadmap import RoadmapSpace
from tsbench.core.state import Course, Rng, S
from tsbench.core.task import MDP, Task, plannable


class Planning(MDP[S]):
    """The planning variant of a task, in which an action changes the state directly: s' = s + a.

    The reward is the task's reward times the abstraction's `dynamics_reward`. Planning has no
    reward of its own that could come to differ from the task's.
    """

    seconds = 0.0  # in a physics engine, which planning does not use

    def __init__(self, task: Task[S], *, explore: float = 0.0) -> None:
        """`explore` is the share of episodes that begin at a sampled state instead of the start. In
        kinematics an episode can begin in any state, which makes exploration easy.

        Raises:
            TsbenchError: the task has no planning variant.
        """
        self.task = task = plannable(task)
        self.explore = explore
        self.abstraction = task.abstraction()
        self.name = task.name
        self.version = task.version
        self.horizon = self.abstraction.horizon
        self.timestep = self.abstraction.timestep
        self.observation_size = self.abstraction.observation_size
        self.action_size = self.abstraction.action_size
        self.max_reward = task.max_reward

    def observation(self, state: S) -> Array:
        return self.abstraction.observation(state)

    def value_observation(self, state: S) -> Array:
        return self.abstraction.value_observation(state)

    def reward(self, previous: S, action: Array, state: S) -> Array:
        reward = self.task.reward(previous, action, state)
        return reward * self.abstraction.dynamics_reward(state)

    def terminal(self, state: S) -> Array:
        return self.task.terminal(state)

    def reached(self, state: S) -> Array:
        return self.task.reached(state)

    def violated(self, state: S) -> Array:
        return self.task.violated(state)

    def begun(self, state: S) -> Course:
        return self.task.begun(state)

    def followed(self, course: Course, previous: S, state: S) -> Course:
        return self.task.followed(course, previous, state)

    def quality(self, course: Course) -> Array:
        return self.task.quality(course)

    # Its dynamics, for BatchedEnvironment

    diverged = np.zeros(0, int)  # kinematics cannot diverge

    def begin(self, rng: Rng, rows: np.ndarray) -> S:
        start = self.abstraction.start(len(rows))
        if not self.explore:
            return start
        sampled = np.flatnonzero(rng.uniform(size=len(rows)) < self.explore)
        return start.updated(sampled, self.abstraction.sample(rng, len(sampled)))

    def advance(self, state: S, action: Array, rows: np.ndarray | None = None) -> S:
        return self.abstraction.advance(state, action)

    def unseen(self) -> tuple[np.ndarray, ...]:
        return ()

    def snapshot(self) -> dict[str, Any]:
        return {"explore": self.explore}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.explore = snapshot["explore"]


def rolled_out(task: Task[S], act: Callable[[S, int], Array]) -> Plan:
    """The plan of a planner: its actions from the task's start to the episode's end.

    Args:
        task: to plan for.
        act: the action (1, action_size) in a state, batch axis (1,), in a plan step.

    Raises:
        TsbenchError: the task has no planning variant.
    """
    planning = Planning(task)
    abstraction = planning.abstraction
    state = abstraction.start(1)
    states = [abstraction.flatten(state)[0]]
    rewards: list[float] = []
    while len(rewards) < planning.horizon and not planning.terminal(state)[0]:
        action = act(state, len(rewards))
        following = planning.advance(state, action)
        rewards.append(float(planning.reward(state, action, following)[0]))
        states.append(abstraction.flatten(following)[0])
        state = following
    return Plan(task.name, task.version, planning.timestep, np.array(states), np.array(rewards))


def plan_along(task: Task[S], space: RoadmapSpace[S], points: np.ndarray) -> Plan:
    """The plan that goes through points (T + 1, d), one each plan step, as far as the planning
    variant lets it, and stays at the last.

    Raises:
        TsbenchError: the task has no planning variant.
    """
    last = len(points) - 1
    return rolled_out(task, lambda state, step: space.action(state, points[min(step + 1, last)]))


def naive_plan(task: Task[S]) -> Plan:
    """The plan of a task's hand-made planner (`Abstraction.naive`).

    Raises:
        TsbenchError: the task has no planning variant.
    """
    abstraction = plannable(task).abstraction()
    return rolled_out(task, lambda state, _: abstraction.naive(state))
