"""Recordings of an episode or of a plan: poses, forces, contacts and rewards over time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from tsbench.core.motion import ReferenceMotion
from tsbench.core.policy import Policy
from tsbench.core.state import Readings, State
from tsbench.core.task import Task, plannable
from tsbench.evaluation.evaluate import check_fit
from tsbench.evaluation.oracle import Outcome, outcome
from tsbench.sim.episodes import PolicyFunction, play
from tsbench.sim.model import sensor_slices
from tsbench.sim.physics import Physics
from tsbench.sim.push import Push

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Recording:
    """T steps of one robot.

    Attributes:
        task: the task that defines physics and rewards.
        qpos: generalised positions, shape (T + 1, nq).
        qvel: generalised velocities, shape (T + 1, nv).
        controls: of the actuators in each step, shape (T, nu).
        forces: on each body in each step from outside, as MuJoCo's `xfrc_applied`: newtons at its
            centre of mass, newton metres; world frame, shape (T, nbody, 6).
        states: of the task, with time as the batch axis.
        actions: shape (T, action_size).
        solved: whether it counts as a success at its end; None along a plan.
        violated: whether a mishap spoiled it (`Task.mishap`).
    """

    task: Task[Any]
    qpos: Array
    qvel: Array
    controls: Array
    forces: Array
    states: State
    actions: Array
    solved: bool | None
    violated: bool

    @property
    def times(self) -> Array:
        """Seconds, shape (T + 1,)."""
        return np.asarray(np.arange(len(self.qpos)) * self.task.timestep, np.float64)

    @property
    def duration(self) -> float:
        """Seconds."""
        return float(self.times[-1])

    @property
    def goal_distance(self) -> Array:
        """Metres, shape (T + 1,)."""
        return np.asarray(self.task.goal_distance(self.states), np.float64)

    @cached_property
    def reward_terms(self) -> dict[str, Array]:
        """The terms of each step's reward, and under "reward" the reward, each of shape (T,)."""
        before, after = self.states.rows(slice(0, -1)), self.states.rows(slice(1, None))
        terms = self.task.reward_terms(before, self.actions, after)
        return {**terms, "reward": self.task.reward(before, self.actions, after)}

    @cached_property
    def outcome(self) -> Outcome:
        """The return and the measures of the motion, those that need actions only where something
        acted."""
        return outcome(self.task, self.states, None if self.solved is None else self.actions)

    @property
    def measures(self) -> dict[str, float | None]:
        """`Task.measures` of the motion."""
        return self.outcome.measures

    @property
    def ending(self) -> str:
        """Why the episode ended, in words."""
        if self.solved:
            return "solved"
        if len(self.actions) < self.task.horizon:
            return self.task.mishap if self.violated else "ended early, unsolved"
        return f"{self.task.mishap if self.violated else 'unsolved'}, time is up"

    @cached_property
    def scheduled(self) -> NDArray[np.bool_] | None:
        """Whether each foot is scheduled to stand, shape (T + 1, feet); None without a schedule."""
        contacts = self.task.drawing().contacts
        return None if contacts is None else np.asarray(contacts(self.times), bool)

    @cached_property
    def support(self) -> Support:
        """The robot's contacts with the ground."""
        return _support(self)


@dataclass(frozen=True, eq=False)
class Support:
    """A robot's contacts with the ground; world frame, metres.

    Attributes:
        feet: centres of `Drawing.feet`, shape (T + 1, feet, 3).
        contacts: whether each foot presses on the ground, shape (T + 1, feet).
        com: whole-body centre of mass, shape (T + 1, 3).
        pressure: centre of pressure, the mean of all contact points with the ground weighted by
            their normal forces; NaN without contact, shape (T + 1, 3).
    """

    feet: Array
    contacts: NDArray[np.bool_]
    com: Array
    pressure: Array


def record_episode(task: Task[Any], policy: PolicyFunction, push: Push | None = None) -> Recording:
    """Plays one episode from the task's own start.

    Args:
        task: the task.
        policy: the policy, a function of observations (n, o).
        push: a push on the robot during the episode, or None.

    Raises:
        TsbenchError: the policy is for another task, version or physics.
    """
    if isinstance(policy, Policy):
        check_fit(policy, task)
    physics: Physics[Any] = Physics(task, 1, push=push)
    bound = [physics.batch.bind(name) for name in ("qpos", "qvel", "ctrl", "xfrc_applied")]
    states: list[Any] = []

    def record(state: Any) -> np.ndarray:
        states.append(state)
        return np.concatenate([array.reshape(1, -1) for array in bound], axis=1)

    episode = play(task, physics, policy, 1, seed=0, record=record)
    assert episode.states is not None
    length = int(episode.lengths[0])
    sizes = np.cumsum([array[0].size for array in bound])[:-1]
    qpos, qvel, controls, forces = np.split(episode.states[: length + 1, 0], sizes, axis=1)
    return Recording(
        task=task,
        qpos=qpos,
        qvel=qvel,
        controls=controls[1:],
        forces=forces[1:].reshape(length, -1, 6),
        states=State.joined(states),
        actions=episode.actions[:length, 0],
        solved=bool(task.success(episode.final, episode.course)[0]),
        violated=bool(episode.course.violated[0]),
    )


def record_motion(task: Task[Any], motion: ReferenceMotion) -> Recording:
    """Records a motion as if the physics followed it exactly, without forces and actions.

    Raises:
        TsbenchError: the motion does not fit the task.
    """
    plannable(task).check_fit(motion)
    model = task.spec().compile()
    data = mujoco.MjData(model)
    sensors = np.zeros((len(motion.qpos), model.nsensordata))
    for row, qpos, qvel in zip(sensors, motion.qpos, motion.qvel, strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        row[:] = data.sensordata
    memory = task.start(np.random.default_rng(0), 1).memory
    states = task.read(
        Readings(
            time=np.arange(len(sensors)) * motion.timestep,
            qpos=motion.qpos,
            qvel=motion.qvel,
            sensors={name: sensors[:, part] for name, part in sensor_slices(model).items()},
            memory=np.repeat(memory, len(sensors), axis=0),
        )
    )
    return Recording(
        task=task,
        qpos=motion.qpos,
        qvel=motion.qvel,
        controls=np.zeros((motion.steps, model.nu)),
        forces=np.zeros((motion.steps, model.nbody, 6)),
        states=states,
        actions=np.zeros((motion.steps, task.action_size)),
        solved=None,
        violated=bool(np.any(task.violated(states))),
    )


def _support(recording: Recording) -> Support:
    """The forces are those that MuJoCo finds for each state and the step that led there, as the
    schedule and the reward pair it; for the first state, the step that begins there."""
    model = recording.task.spec().compile()
    feet = [model.geom(name).id for name in recording.task.drawing().feet]
    fixed = model.body_weldid[model.geom_bodyid] == 0  # geoms that cannot move: the ground
    data = mujoco.MjData(model)
    count = len(recording.qpos)
    centres, contacts = np.zeros((count, len(feet), 3)), np.zeros((count, len(feet)), bool)
    com, pressure = np.zeros((count, 3)), np.full((count, 3), np.nan)
    wrench = np.zeros(6)
    for frame in range(count):
        step = max(frame - 1, 0)
        data.qpos[:], data.qvel[:] = recording.qpos[frame], recording.qvel[frame]
        data.ctrl[:], data.xfrc_applied[:] = recording.controls[step], recording.forces[step]
        mujoco.mj_forward(model, data)
        centres[frame], com[frame] = data.geom_xpos[feet], data.subtree_com[0]
        total, moment = 0.0, np.zeros(3)
        for index in range(data.ncon):
            contact = data.contact[index]
            if not fixed[contact.geom].any():
                continue
            mujoco.mj_contactForce(model, data, index, wrench)
            total, moment = total + wrench[0], moment + wrench[0] * contact.pos
            contacts[frame] |= np.isin(feet, contact.geom) & (wrench[0] > 0.0)
        if total > 0.0:
            pressure[frame] = moment / total
    return Support(centres, contacts, com, pressure)
