"""A task's full physics, of many episodes at once.

It runs on `mujoco.batch`, which steps the simulations on a pool of threads, one per core, and then
updates position and velocity sensors. `mujoco.rollout` would leave the sensors one substep behind,
and updating them would take an extra step. docs/speed.md compares the speed of both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from time import perf_counter
from typing import Any, Generic

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from tsbench.core.arrays import Array
from tsbench.core.errors import TsbenchError
from tsbench.core.state import Readings, Rng, S, Start
from tsbench.core.task import SimulatedTask
from tsbench.sim.change import Change
from tsbench.sim.model import UNSTABLE, sensor_slices
from tsbench.sim.push import Push
from tsbench.sim.quiet import QUIET

_CURRENT = int(mujoco.mjtStage.mjSTAGE_VEL)
_NUMBER = 1  # index of the number of warnings of a kind in `Batch.warning`


def physics_model(task: SimulatedTask[Any], change: Change | None) -> mujoco.MjModel:
    """The model of a task's full physics, without what is only drawn: 10 % faster, the same states
    to the last bit."""
    spec = task.plant.spec()
    spec.compiler.discardvisual = True
    model = spec.compile()
    (change or Change()).apply(model)
    return model


class Physics(Generic[S]):
    """A task's full physics.

    Attributes:
        batch: the simulations.
        push: the push that disturbs the episodes, or None.
        substeps: physics steps done so far, all episodes together.
        warnings: number of mujoco warnings of each kind (mjtWarning), all episodes together.
        diverged: rows in which mujoco met a huge or not finite number in the last step. mujoco
            itself resets such a simulation and continues it, so the episode must end.
        seconds: wall-clock time spent in mujoco so far.
        side_by_side: how many episodes are best played at once. Each rocket takes 15 MB of address
            space; more are no faster.
    """

    side_by_side = 128

    def __init__(
        self,
        task: SimulatedTask[S],
        count: int,
        *,
        threads: int | None = None,
        perturbed: bool = False,
        push: Push | None = None,
        change: Change | None = None,
    ) -> None:
        """`threads` None means all cores; `perturbed` picks the task's perturbed starts.

        Raises:
            TsbenchError: there are more or fewer pushes than simulations.
        """
        if push is not None:
            push.expect_count(count)
        self.task = task
        self.plant = task.plant
        self.perturbed = perturbed
        self.push = push
        self.substeps = 0
        self.seconds = 0.0
        self.warnings = np.zeros(int(mujoco.mjtWarning.mjNWARNING), int)
        self.diverged = np.zeros(0, int)
        model = physics_model(task, change)
        self._nstep = self.plant.substeps * (change or Change()).refine  # in a control step
        # With memory of its own a simulation goes on from the sensors that were brought up to date,
        # which otherwise costs half a substep; among twenty substeps that does not pay.
        self.batch = Batch(model, count, threads or 0, persistent=self._nstep == 1)
        self._sensors = sensor_slices(model)
        self._qpos = self.batch.bind("qpos")
        self._qvel = self.batch.bind("qvel")
        self._ctrl = self.batch.bind("ctrl")
        self._sensordata = self.batch.bind("sensordata")
        self._force = self.batch.bind("xfrc_applied")[:, model.body(self.plant.pushed).id, :3]

    def begin(self, rng: Rng, rows: np.ndarray) -> S:
        return self.place(rows, self.task.start(rng, len(rows), perturbed=self.perturbed))

    def place(self, rows: np.ndarray, start: Start) -> S:
        """Puts the simulations in `rows` where `start` says and returns their states."""
        ids = np.asarray(rows, np.int32)
        began = perf_counter()
        with _computing():
            self.batch.reset(ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
            self._qpos[rows] = start.qpos
            self._qvel[rows] = start.qvel
            self.batch.forward(ids, stage=_CURRENT)
        self.seconds += perf_counter() - began
        return self._read(rows, start.time, start.memory)

    def advance(self, state: S, action: Array, rows: np.ndarray | None = None) -> S:
        control, memory = self.plant.control(state, action)
        at = slice(None) if rows is None else rows
        self._ctrl[at] = control
        self._force[at] = self.push_force(state.time, at)
        self.batch.warning[:] = 0
        began = perf_counter()
        with _computing():
            ids = None if rows is None else np.asarray(rows, np.int32)
            self.batch.step(ids, nstep=self._nstep, stage=_CURRENT)
        self.seconds += perf_counter() - began
        self.substeps += len(control) * self._nstep
        following = self._read(at, state.time + self.task.timestep, memory)
        warned = self.batch.warning[at, :, _NUMBER]
        self.warnings += warned.sum(axis=0)
        failed = np.flatnonzero(warned[:, UNSTABLE].any(axis=1))
        self.diverged = failed if rows is None else rows[failed]
        if len(failed):
            following = following.updated(failed, state.rows(failed))
        return following

    def push_force(self, time: np.ndarray, rows: np.ndarray | slice) -> np.ndarray:
        """Newtons in the world frame on the pushed body of the simulations in `rows`, over the
        control steps that begin at `time` (n,); shape (n, 3)."""
        if self.push is None:
            return np.zeros((len(time), 3))
        return self.push.rows(rows).during(time, self.task.timestep)

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """qpos (n, nq) and qvel (n, nv) of all simulations."""
        return self._qpos.copy(), self._qvel.copy()

    def unseen(self) -> tuple[np.ndarray, ...]:
        return ()

    def warned(self) -> dict[str, int]:
        """Number of mujoco warnings by mujoco's name of their kind; kinds that never came are left
        out."""
        return {
            mujoco.mjtWarning(kind).name: int(self.warnings[kind])
            for kind in np.flatnonzero(self.warnings)
        }

    def snapshot(self) -> dict[str, Any]:
        # The rows of mjSTATE_INTEGRATION, from which mujoco continues to the last bit.
        return {
            "simulations": self.batch.state,
            "substeps": self.substeps,
            "warnings": self.warnings,
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.batch.state[:] = snapshot["simulations"]
        self.substeps = snapshot["substeps"]
        self.warnings = snapshot["warnings"]

    def _read(self, rows: Any, time: np.ndarray, memory: np.ndarray) -> S:
        # Copies, because the next step overwrites the batch's arrays.
        sensordata = self._sensordata[rows].copy()
        return self.plant.read(
            Readings(
                time=time,
                qpos=self._qpos[rows].copy(),
                qvel=self._qvel[rows].copy(),
                sensors={name: sensordata[..., part] for name, part in self._sensors.items()},
                memory=memory,
            )
        )


@contextmanager
def _computing() -> Iterator[None]:
    """Silences mujoco's warnings, and turns its errors into a `TsbenchError`."""
    try:
        with QUIET:
            yield
    except (SimulationError, ValueError) as error:
        if isinstance(error, ValueError) and "mjcb_" not in str(error):
            raise
        reason = " ".join(str(error).split())
        raise TsbenchError(f"the physics cannot go on: {reason}") from None
