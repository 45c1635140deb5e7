"""What a task promises, tried on a few states before anything is spent on it.

The contract tests (`tsbench.testing`) ask for much more. These promises are those whose breach
would otherwise end in the middle of a computation, or give figures that mean nothing.
"""

from __future__ import annotations

import inspect
import operator
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from tsbench.core.arrays import Array
from tsbench.core.errors import TsbenchError, memory_errors, unknown
from tsbench.core.state import Rng, State
from tsbench.core.task import MDP, Plannable, Plant, Task
from tsbench.sim.kinematic import Planning
from tsbench.sim.physics import Physics

ROWS = 3  # states to try: another number than one, which numpy would stretch
TOLERANCE = 1e-6  # of a reward above the largest one, for rounding in float32


def check_promises(name: str, task: Task[Any]) -> None:
    """Checks attributes, model, and what the task's functions return for a few states.

    Args:
        name: that the task is registered under.
        task: the task made under that name.

    Raises:
        TsbenchError: a promise is broken, or a function of the task fails.
    """
    _Trial(name, task).check()


class _Trial:
    """The check of one task."""

    def __init__(self, name: str, task: Task[Any]) -> None:
        self.name, self.task = name, task

    def check(self) -> None:
        for kind in (MDP, Plant, Plannable):
            missing = [part for part in kind.__annotations__ if not hasattr(self.task, part)]
            if isinstance(self.task, kind) and missing:
                raise self.broken(f"it has no {missing[0]}")
        if self.task.name != self.name:
            raise self.broken(f"it names itself {self.task.name!r}")
        rng = np.random.default_rng(0)
        self.physics(rng)
        if isinstance(self.task, Plannable):
            self.planning(rng)

    def physics(self, rng: Rng) -> None:
        """A start and a step in full physics."""
        task = self.task
        with self.explained("spec"), memory_errors():
            model = task.spec().compile()
        bodies = [model.body(body).name for body in range(model.nbody)]
        if task.pushed not in bodies:
            raise unknown(f"body `pushed` of the task {self.name}", task.pushed, bodies)
        passed = task.substeps * model.opt.timestep
        if not np.isclose(passed, task.timestep, rtol=1e-9, atol=0.0):
            steps = f"{task.substeps} substeps of {model.opt.timestep:g} s"
            raise self.broken(f"{steps} take {passed:g} s, but its timestep is {task.timestep:g} s")
        with self.explained("start"):
            start = task.start(rng, ROWS)
        self.expect("the time of a start", start.time, ROWS)
        self.expect("qpos of a start", start.qpos, ROWS, model.nq)
        self.expect("qvel of a start", start.qvel, ROWS, model.nv)
        if np.ndim(start.memory) != 2:
            self.expect("the memory of a start", start.memory, ROWS, 0)
        action = rng.uniform(-1.0, 1.0, (ROWS, task.action_size))
        with self.explained("read"):
            physics = Physics(task, ROWS, threads=1)
            state = physics.place(np.arange(ROWS), start)
        self.controls(state, action, model, start.memory.shape[1])
        with self.explained("read"):
            following = physics.advance(state, action)
        self.mdp(task, "", state, action, following)
        course = task.begun(following)
        with self.explained("success"):
            self.verdict("success", task.success(following, course))
        with self.explained("goal_distance"):
            self.expect("goal_distance", task.goal_distance(following), ROWS)
        self.protocol()

    def protocol(self) -> None:
        """What the protocol asks of a task: the instants of pushes, and the best motion known."""
        task = self.task
        with self.explained("push_steps"):
            steps = tuple(task.push_steps)
            within = all(operator.index(step) in range(task.horizon) for step in steps)
        if not (steps and within and list(steps) == sorted(set(steps))):
            needed = f"one or more rising steps from 0 to {task.horizon - 1}"
            raise self.broken(f"push_steps are {steps}, not {needed}")
        with self.explained("ideal"):
            frames = np.shape(task.ideal().time)
        if frames != (task.horizon + 1,):
            needed = f"{task.horizon + 1}, one at the start and one after each step"
            raise self.broken(f"ideal has times of the shape {frames}; states needed: {needed}")

    def controls(
        self, state: State, action: np.ndarray, model: mujoco.MjModel, remembered: int
    ) -> None:
        with self.explained("control"):
            given = self.task.control(state, action)
        if not isinstance(given, tuple) or len(given) != 2:
            raise self.broken("control returns no pair of controls and memory")
        about = f" (action_size {self.task.action_size}, actuators in the model {model.nu})"
        self.expect("control" + about, given[0], ROWS, model.nu)
        self.expect("the memory that control returns", given[1], ROWS, remembered)

    def planning(self, rng: Rng) -> None:
        """Sampled states and a step of the planning variant."""
        with self.explained("abstraction"):
            planning = Planning(self.task)
            kinematics = planning.abstraction
        with self.explained("start of the planning variant"):
            kinematics.start(ROWS)
        with self.explained("sample"):
            state = kinematics.sample(rng, ROWS)
        action = rng.uniform(-1.0, 1.0, (ROWS, planning.action_size))
        with self.explained("advance"):
            following = kinematics.advance(state, action)
        with self.explained("flatten"):
            coordinates = kinematics.flatten(following)
        self.expect("flatten", coordinates, ROWS, len(kinematics.coordinates))
        with self.explained("naive"):
            self.expect("naive", kinematics.naive(state), ROWS, planning.action_size)
        with self.explained("dynamics_reward"):
            self.expect("dynamics_reward", kinematics.dynamics_reward(state), ROWS)
        self.mdp(planning, " of the planning variant", state, action, following)

    def mdp(
        self, mdp: MDP[Any], where: str, state: State, action: np.ndarray, following: State
    ) -> None:
        """What an MDP says of a step."""
        with self.explained(f"observation{where}"):
            seen = mdp.observation(following)
        about = f"observation{where} (observation_size {mdp.observation_size})"
        self.expect(about, seen, ROWS, mdp.observation_size)
        with self.explained(f"max_reward{where}"):
            most = float(mdp.max_reward)
        if not 0.0 < most < np.inf:
            raise self.broken(f"max_reward{where} is {most:g}, which normalises no reward")
        with self.explained(f"reward{where}"):
            reward = mdp.reward(state, action, following)
        self.expect(f"reward{where}", reward, ROWS)
        if (found := float(np.max(reward))) > most * (1.0 + TOLERANCE):
            raise self.broken(f"reward{where} is {found:g}, above its max_reward of {most:g}")
        for part in ("terminal", "reached", "violated"):
            with self.explained(part):
                self.verdict(part, getattr(mdp, part)(following))

    def verdict(self, part: str, found: Array) -> None:
        self.expect(part, found, ROWS)
        if found.dtype != bool:
            raise self.broken(f"{part} is of type {found.dtype}, not bool")

    def expect(self, part: str, found: Array, *shape: int) -> None:
        given = getattr(found, "shape", None)
        if given is None:
            raise self.broken(f"{part} is of type {type(found).__name__}, not an array")
        if given != shape:
            raise self.broken(f"{part} has the shape {given} for {ROWS} states, not {shape}")
        if not np.all(np.isfinite(found)):
            raise self.broken(f"{part} is not finite")

    def broken(self, reason: str) -> TsbenchError:
        return TsbenchError(f"the task {self.name}: {reason}")

    @contextmanager
    def explained(self, part: str) -> Iterator[None]:
        """Turns any exception of the task's code into a `TsbenchError` that says where it arose."""
        try:
            yield
        except TsbenchError:
            raise
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            folder = Path(inspect.getfile(type(self.task))).parent
            own = [frame for frame in frames if folder in Path(frame.filename).parents]
            place = (own or frames)[-1]
            reason = f"{type(error).__name__}: {error}"
            at = f"{Path(place.filename).name}, line {place.lineno}"
            raise self.broken(f"{part} fails with {reason} ({at})") from error
