"""A task's full physics on mujoco-warp: a second physics engine, in float32, on a GPU or a CPU.

`WarpPhysics` is for learning: its states are torch tensors that never leave the device.
`HostPhysics` is for scores: numpy arrays go in and come out, as with `Physics`.

Both run `Worlds`. Its control step is recorded once, as a graph of kernels, and then replayed: a
CUDA graph on a GPU, and warp's own recording on a CPU (29 times faster for four worlds than as many
single launches). A graph holds pointers, so arrays are written to and never replaced. The kernels
are compiled when they are first used on a machine, which takes about a minute, and then kept.

What differs from `Physics`: numbers have 24 bits instead of 53, and the contact solver stops at a
tolerance of 1e-6 instead of 1e-8, which float32 does not reach. Without `deterministic`, a GPU adds
numbers in any order, so that last bits differ from run to run; with it, a step costs about twelve
times as much (H200, 8,192 worlds).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from time import perf_counter
from typing import Any, Generic

import mujoco
import numpy as np

from tsbench.core.arrays import Array
from tsbench.core.errors import TsbenchError
from tsbench.core.state import Readings, Rng, S, Start
from tsbench.core.task import SimulatedTask
from tsbench.sim.change import Change
from tsbench.sim.device import Replayed, at_device, merged, no_garbage_collection, tensor
from tsbench.sim.disturbed import Disturbances, physics_factors, variants
from tsbench.sim.model import sensor_slices
from tsbench.sim.physics import Physics, physics_model
from tsbench.sim.push import Push

try:
    import mujoco_warp as mjw
    import torch
    import warp as wp
except ModuleNotFoundError as error:
    raise TsbenchError(
        f"physics on warp needs the package {error.name}: install tsbench[gpu]"
    ) from None

POOL = 16_384  # starts that episodes on a device are drawn from
PHYSICS = (
    4_096  # different masses, frictions and strengths at most: world i has those of i % PHYSICS
)
_PLACED = 256  # starts that the pool places side by side

# What no step may do: leave out contacts or constraints because an array is full. The solver's
# limits of iterations are none of these: C MuJoCo has them too, and goes on.
_OVERFLOW = (
    mjw.OverflowType.NEFC
    | mjw.OverflowType.NJMAX_NNZ
    | mjw.OverflowType.BROADPHASE
    | mjw.OverflowType.NARROWPHASE
    | mjw.OverflowType.CCD
    | mjw.OverflowType.HFIELD
    | mjw.OverflowType.CONTACT_MATCH
    | mjw.OverflowType.NVMAX
    | mjw.OverflowType.EPA_HORIZON
    | mjw.OverflowType.TACTILE
)
_HUGE = 1e10  # mjMAXVAL: C MuJoCo gives up a simulation with a larger number

# Contacts at most between two geoms of these types; any others have up to _CONTACTS.
_GEOM = mujoco.mjtGeom
_POINTS = {
    (int(one), int(two)): points
    for one, two, points in (
        (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_SPHERE, 1),
        (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_CAPSULE, 2),
        (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_SPHERE, 1),
        (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, 1),
        (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_BOX, 1),
        (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_MESH, 1),
    )
}
_CONTACTS = 8
_MOST_CONTACTS = 128  # of a world; models in which more could touch at once hardly ever have more


_DISTANCE_SENSORS = (
    mujoco.mjtSensor.mjSENS_GEOMDIST,
    mujoco.mjtSensor.mjSENS_GEOMNORMAL,
    mujoco.mjtSensor.mjSENS_GEOMFROMTO,
)
_PLACE_SENSORS = (
    mujoco.mjtSensor.mjSENS_JOINTPOS,
    mujoco.mjtSensor.mjSENS_BALLQUAT,
    mujoco.mjtSensor.mjSENS_FRAMEPOS,
    mujoco.mjtSensor.mjSENS_FRAMEQUAT,
    mujoco.mjtSensor.mjSENS_FRAMEXAXIS,
    mujoco.mjtSensor.mjSENS_FRAMEYAXIS,
    mujoco.mjtSensor.mjSENS_FRAMEZAXIS,
    mujoco.mjtSensor.mjSENS_SUBTREECOM,
)


@wp.kernel(enable_backward=False)
def _apply_pushes(
    time: wp.array[float],
    first: wp.array[float],
    interval: wp.array[float],
    duration: wp.array[float],
    force: wp.array2d[wp.vec3],
    timestep: float,
    body: int,
    applied: wp.array2d[wp.spatial_vector],
) -> None:
    """The force of the latest push that begins before the end of the control step (`Push`)."""
    i = wp.tid()
    end = time[i] + timestep
    number = wp.clamp(int(wp.floor((end - first[i]) / interval[i])), 0, force.shape[1] - 1)
    begin = first[i]
    if number > 0:  # the interval of a single push is infinite
        begin += float(number) * interval[i]
    covered = wp.min(begin + duration[i], end) - wp.max(begin, time[i])
    # Rounded, because full cover must give exactly one; float32 does not hold more digits.
    share = wp.clamp(wp.round(covered / timestep * 1.0e4) / 1.0e4, 0.0, 1.0)
    applied[i, body] = wp.spatial_vector(share * force[i, number], wp.vec3(0.0))


@wp.kernel(enable_backward=False)
def _disturb(
    begins: wp.array[wp.bool],
    seed: int,
    steps: wp.array[wp.int64],
    strongest: float,
    rise: float,
    calm: float,
    axis1: wp.vec3,
    axis2: wp.vec3,
    latest: int,
    interval: wp.array[float],
    episode: wp.array[int],
    first: wp.array[float],
    force: wp.array2d[wp.vec3],
    latency: wp.array[wp.int64],
) -> None:
    """Draws the pushes and the latency of the episodes that begin. The numbers depend on seed,
    world and number of the episode in its world only."""
    i = wp.tid()
    if not begins[i]:
        return
    episode[i] = episode[i] + 1
    rng = wp.rand_init(wp.randi(wp.rand_init(seed, i)), episode[i])
    level = 1.0
    if rise > 0.0:
        level = wp.min(float(steps[0]) / rise, 1.0)
    largest = strongest * level
    if wp.randf(rng) < calm:
        largest = 0.0
    for k in range(force.shape[1]):
        heading = wp.randf(rng) * wp.static(math.tau)
        size = wp.randf(rng) * largest
        force[i, k] = size * (wp.cos(heading) * axis1 + wp.sin(heading) * axis2)
    if strongest > 0.0:
        first[i] = wp.randf(rng) * interval[i]
    late = int(wp.randf(rng) * (1.0 + level * float(latest)))
    latency[i] = wp.int64(wp.min(late, latest))


@wp.kernel(enable_backward=False)
def _look_for_divergence(
    rest: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    qacc: wp.array2d[float],
    act: wp.array2d[float],
    diverged: wp.array[wp.bool],
) -> None:
    """Marks the worlds with huge or not finite numbers and puts them to rest, so that they stay
    computable until their next episode begins."""
    i = wp.tid()
    bad = bool(False)  # noqa: UP018  a variable of warp's, not a constant
    for k in range(qpos.shape[1]):
        # Not `>`: comparisons with NaN are false.
        if not (wp.abs(qpos[i, k]) <= wp.static(_HUGE)):
            bad = True
    for k in range(qvel.shape[1]):
        if not (wp.abs(qvel[i, k]) <= wp.static(_HUGE)):
            bad = True
        if not (wp.abs(qacc[i, k]) <= wp.static(_HUGE)):
            bad = True
    for k in range(act.shape[1]):
        if not (wp.abs(act[i, k]) <= wp.static(_HUGE)):
            bad = True
    diverged[i] = bad
    if bad:
        for k in range(qpos.shape[1]):
            qpos[i, k] = rest[i % rest.shape[0], k]
        for k in range(qvel.shape[1]):
            qvel[i, k] = 0.0
            qacc[i, k] = 0.0
        for k in range(act.shape[1]):
            act[i, k] = 0.0


@wp.kernel(enable_backward=False)
def _clear(lags: wp.array[wp.bool], sensordata: wp.array2d[float]) -> None:
    """Zeros for sensors that write only what they sense, but not for those that lag."""
    i = wp.tid()
    for k in range(sensordata.shape[1]):
        if not lags[k]:
            sensordata[i, k] = 0.0


class Worlds:
    """n simulations of a model on one device, all stepped together.

    All attributes but `model` are torch tensors that share memory with warp's arrays. Write into
    them, never replace them.

    Attributes:
        model: the compiled model.
        qpos, qvel: generalised positions (n, nq) and velocities (n, nv).
        act: activations of actuators that have any, shape (n, na).
        ctrl: of the actuators, shape (n, nu).
        time: seconds since the start of the episode at which the next control step begins, (n,).
        sensordata: values of the sensors, shape (n, nsensordata). Current, as in `Readings`.
        first: seconds into the episode at which the first push begins, shape (n,).
        interval: seconds from one push to the next, shape (n,).
        duration: of the pushes in seconds, shape (n,).
        force: of the pushes in newtons, shape (n, pushes, 3).
        diverged: whether the last control step met a huge or not finite number, shape (n,).
        nefc: rows of constraints that each world had last, shape (n,).
        rows: of constraints that there is room for in each world.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        count: int,
        *,
        device: torch.device,
        pushed: str,
        timestep: float,
        substeps: int,
        pushes: int = 1,
        variants: Sequence[mujoco.MjModel] = (),
        deterministic: bool = False,
        contacts: int | None = None,
        rows: int | None = None,
    ) -> None:
        """
        Args:
            model: compiled.
            count: of worlds.
            device: that they live on.
            pushed: body that pushes act on.
            timestep: seconds in a control step.
            substeps: physics steps in a control step.
            pushes: of an episode.
            variants: models with other numbers; world i is stepped with number i modulo how many.
            deterministic: whether a GPU gives the same bits each time.
            contacts: of a world on average, at most; None for what the model can have.
            rows: of a world's constraints at most; None for what the model can have.
        """
        self.model = model
        self._timestep = timestep
        self._substeps = substeps
        self._body = model.body(pushed).id
        most_contacts, most_rows = capacity(model)
        wp.config.log_level = wp.LOG_ERROR  # its greeting would stand among a command's output
        wp.init()
        self._device = wp.device_from_torch(device)
        with wp.ScopedDevice(self._device):
            self._m = mjw.put_model(model)
            self._m.opt.deterministic = deterministic
            self._m.opt.warn_overflow = False  # printed by each world; `check` raises an error
            _vary(self._m, variants)
            self._d = mjw.make_data(
                model,
                nworld=count,
                nconmax=most_contacts if contacts is None else contacts,
                njmax=most_rows if rows is None else rows,
            )
            self._time = wp.zeros(count, dtype=float)
            self._first = wp.zeros(count, dtype=float)
            self._interval = wp.full(count, math.inf, dtype=float)
            self._duration = wp.zeros(count, dtype=float)
            self._force = wp.zeros((count, pushes), dtype=wp.vec3)
            self._diverged = wp.zeros(count, dtype=wp.bool)
            lags = np.repeat(
                model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC, model.sensor_dim
            )
            self._lagging, self._lags = bool(lags.any()), wp.array(lags, dtype=wp.bool)
        self.qpos, self.qvel = wp.to_torch(self._d.qpos), wp.to_torch(self._d.qvel)
        self.ctrl, self.sensordata = wp.to_torch(self._d.ctrl), wp.to_torch(self._d.sensordata)
        self.time, self.force = wp.to_torch(self._time), wp.to_torch(self._force)
        self.first, self.interval = wp.to_torch(self._first), wp.to_torch(self._interval)
        self.duration, self.diverged = wp.to_torch(self._duration), wp.to_torch(self._diverged)
        self.act, self._overflow = wp.to_torch(self._d.act), wp.to_torch(self._d.overflow)
        self.nefc, self.rows = wp.to_torch(self._d.nefc), self._d.njmax
        self._sensors = sensor_slices(model)
        self._streams: dict[Any, Any] = {}  # torch's, as warp's
        self._graph = self._recorded()

    def step(self) -> None:
        """One control step of all worlds, under `ctrl` and the pushes at `time`."""
        with self._stream():
            wp.capture_launch(self._graph)

    def look(self) -> None:
        """Brings the sensors up to date with `qpos` and `qvel`."""
        with self._stream():
            self._sense()

    def sensors(self, sensordata: Array) -> dict[str, Array]:
        """The values of each sensor by name, each (n, dim), in the values of all (n, sizes)."""
        return {name: sensordata[:, part] for name, part in self._sensors.items()}

    def launch(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        """One thread of a kernel for each world, in torch's order."""
        with self._stream():
            wp.launch(kernel, self._d.nworld, inputs, outputs)

    def check(self) -> None:
        """
        Raises:
            TsbenchError: a step since the beginning had more contacts or constraints than there was
                room for, and left some out.
        """
        found = int(np.bitwise_or.reduce(self._overflow.cpu().numpy())) & int(_OVERFLOW)
        if found:
            raise TsbenchError(
                f"the physics ran out of room ({mjw.OverflowType(found)!r}) for "
                f"{self._d.naconmax // self._d.nworld} contacts and {self._d.njmax} constraints a "
                "world: let fewer geoms touch in the model, or take C MuJoCo (device=cpu)"
            )

    def _stream(self) -> Any:
        """A context in which warp works on torch's current stream, so that their kernels keep the
        order in which they are called."""
        if self._device.is_cuda:
            current = torch.cuda.current_stream(wp.device_to_torch(self._device))
            if current not in self._streams:
                self._streams[current] = wp.stream_from_torch(current)
            return wp.ScopedStream(self._streams[current], sync_enter=False)
        return wp.ScopedDevice(self._device)

    def _recorded(self) -> Any:
        """The graph of a control step.

        Raises:
            TsbenchError: what was recorded is not what was called.
        """
        self.qpos[:] = torch.as_tensor(self.model.qpos0)
        with wp.ScopedDevice(self._device):
            self._launch()  # compiles and loads the kernels, which a recording must not
            wp.synchronize_device(self._device)
            wanted = torch.cat([self.qpos[0], self.qvel[0]]).clone()
            with no_garbage_collection(), wp.ScopedCapture(device=self._device) as capture:
                self._launch()
        self._rest()
        with self._stream():
            wp.capture_launch(capture.graph)
        found = torch.cat([self.qpos[0], self.qvel[0]])
        if not torch.allclose(found, wanted, rtol=1e-3, atol=1e-3):
            raise TsbenchError("warp recorded another step than it was given: the physics is wrong")
        self._rest()
        wp.synchronize_device(self._device)
        return capture.graph

    def _rest(self) -> None:
        self.qpos[:] = torch.as_tensor(self.model.qpos0)
        self.qvel[:] = 0.0
        self.act[:] = 0.0
        self._overflow[:] = 0

    def _launch(self) -> None:
        m, d = self._m, self._d
        inputs = [self._time, self._first, self._interval, self._duration, self._force]
        outputs = [d.xfrc_applied]
        wp.launch(_apply_pushes, d.nworld, [*inputs, self._timestep, self._body], outputs)
        # Sensors of accelerations lag by a substep: the last one measures them. `_sense` reads the
        # others at its end.
        flags = m.opt.disableflags
        for substep in range(self._substeps):
            if not self._lagging or substep < self._substeps - 1:
                m.opt.disableflags = flags | mjw.DisableBit.SENSOR
            mjw.step(m, d)
            m.opt.disableflags = flags
        wp.launch(
            _look_for_divergence,
            d.nworld,
            [m.qpos0],
            [d.qpos, d.qvel, d.qacc, d.act, self._diverged],
        )
        self._sense()

    def _sense(self) -> None:
        """Sensors of positions and velocities, at the current ones."""
        m, d, types = self._m, self._d, self.model.sensor_type
        if not len(types):
            return
        if np.isin(types, (*_PLACE_SENSORS, *_DISTANCE_SENSORS)).all():
            # They need no more than positions, and the contacts that measure distances.
            mjw.fwd_kinematics(m, d)
            if np.isin(types, _DISTANCE_SENSORS).any():
                mjw.collision(m, d)
            mjw.sensor_pos(m, d)
            return
        mjw.fwd_position(m, d, factorize=False)
        wp.launch(_clear, d.nworld, [self._lags], [d.sensordata])
        mjw.sensor_pos(m, d)
        mjw.fwd_velocity(m, d)
        mjw.sensor_vel(m, d)


def capacity(model: mujoco.MjModel) -> tuple[int, int]:
    """Contacts and rows of constraints that a world can have at once: if every pair of geoms that
    may touch did, and every limit were reached. Many pairs never touch all at once, so that beyond
    `_MOST_CONTACTS` there is no more room; `Worlds.check` tells where that was too little."""
    pairs = [
        (one, two)
        for one in range(model.ngeom)
        for two in range(one + 1, model.ngeom)
        if _may_touch(model, one, two)
    ]
    pairs += list(zip(model.pair_geom1, model.pair_geom2, strict=True))
    kinds = [(int(model.geom_type[one]), int(model.geom_type[two])) for one, two in pairs]
    contacts = [_POINTS.get((min(kind), max(kind)), _CONTACTS) for kind in kinds]
    # Sensors of distances take the place of contacts too.
    measured = int(np.isin(model.sensor_type, _DISTANCE_SENSORS).sum())
    sides = 2 * (max([*model.geom_condim, *model.pair_dim, 1]) - 1) or 1
    touching = min(sum(contacts), _MOST_CONTACTS)
    limits = int(np.sum(model.jnt_limited) + np.sum(model.tendon_limited))
    frictions = int(np.sum(model.dof_frictionloss > 0) + np.sum(model.tendon_frictionloss > 0))
    rows = touching * int(sides) + limits + frictions + 6 * model.neq
    # Not zero: recorded on a CPU, mujoco-warp's step without room for constraints moves nothing.
    return max(touching + measured, 1), max(rows, 1)


def _may_touch(model: mujoco.MjModel, one: int, two: int) -> bool:
    types, affinities, bodies = model.geom_contype, model.geom_conaffinity, model.geom_bodyid
    if not (types[one] & affinities[two] or types[two] & affinities[one]):
        return False
    first, second = model.body_weldid[bodies[one]], model.body_weldid[bodies[two]]
    return bool(first != second)


def _vary(m: Any, variants: Sequence[mujoco.MjModel]) -> None:
    """Gives each world the numbers of its variant, in every array in which variants differ."""
    if not variants:
        return
    for field in fields(m):
        array = getattr(m, field.name)
        if not getattr(array, "_is_batched", False) or not hasattr(variants[0], field.name):
            continue
        values = [np.asarray(getattr(one, field.name)) for one in variants]
        if all(np.array_equal(values[0], value) for value in values):
            continue
        varied = wp.array(
            np.stack(values).reshape(len(variants), *array.numpy().shape[1:]), dtype=array.dtype
        )
        varied._is_batched = True  # as mujoco-warp marks what it indexes by world
        setattr(m, field.name, varied)


class WarpPhysics(Generic[S]):
    """A task's full physics for learning: every array is a tensor on one device, and nothing moves
    to the host in a step.

    Episodes begin at starts from a pool, which the task draws once and C MuJoCo
    places. Which of them, and in which rows, the caller says. All shapes are static.

    Every world keeps its own mass, friction and strength for good, drawn from `seed`. An episode's
    pushes and its latency are drawn when it begins; they depend on `seed`, its world, and how many
    episodes the world has had.

    Attributes:
        pool: how many starts there are.
        diverged: rows in which the last step could not be computed, shape (n,), bool. Their states
            are those before it, and their episodes have to end.
    """

    def __init__(
        self,
        task: SimulatedTask[S],
        count: int,
        *,
        device: torch.device | str,
        disturbances: Disturbances | None = None,
        change: Change | None = None,
        perturbed: bool = False,
        seed: int = 0,
        pool: int = POOL,
        threads: int | None = None,
        deterministic: bool = False,
        contacts: int | None = None,
        rows: int | None = None,
    ) -> None:
        """
        Args:
            task: that is stepped.
            count: of worlds.
            device: "cpu", "cuda" or "cuda:N".
            disturbances: of training.
            change: to the model of all worlds.
            perturbed: whether the starts are the task's perturbed ones.
            seed: of starts and disturbances.
            pool: how many starts to draw.
            threads: that place them, None for all cores.
            deterministic: see the module.
            contacts: see `Worlds`.
            rows: see `Worlds`.
        """
        self.task = task
        self.plant = task.plant
        self.disturbances = disturbances = disturbances or Disturbances()
        self.device = _exact(device)
        self.pool = pool
        self._substeps = self.plant.substeps * (change or Change()).refine
        model = physics_model(task, change)
        rng = np.random.default_rng(seed)
        factors = physics_factors(disturbances, rng, min(count, PHYSICS))
        pushes = math.ceil(task.horizon * task.timestep / disturbances.interval) + 1
        self.worlds = Worlds(
            model,
            count,
            device=self.device,
            pushed=self.plant.pushed,
            timestep=task.timestep,
            substeps=self._substeps,
            pushes=pushes if disturbances.push else 1,
            variants=variants(model, factors),
            deterministic=deterministic,
            contacts=contacts,
            rows=rows,
        )
        self.worlds.interval[:] = disturbances.interval
        self.worlds.duration[:] = disturbances.duration
        self.diverged = self.worlds.diverged
        self._starts, self._fresh = self._placed(rng, perturbed, change, threads)
        self._seed = int(rng.integers(2**31))
        self._episode = torch.zeros(count, dtype=torch.int32, device=self.device)
        self._steps = torch.zeros(
            1, dtype=torch.int64, device=self.device
        )  # of all worlds together
        self._failures = torch.zeros(1, dtype=torch.int64, device=self.device)
        self._latency = torch.zeros(count, dtype=torch.int64, device=self.device)
        late = (count, disturbances.latency + 1, task.action_size)
        self._actions = torch.zeros(late, device=self.device)  # newest first
        # What `_disturb` reads and writes: numbers, and the tensors' memory as warp's arrays.
        axes = [wp.vec3(*axis) for axis in self.plant.push_plane]
        drawn = [float(getattr(disturbances, name)) for name in ("push", "rise", "calm")]
        self._drawn = [*drawn, *axes, disturbances.latency, wp.from_torch(self.worlds.interval)]
        self._drawing = [
            wp.from_torch(self._episode),
            wp.from_torch(self.worlds.first),
            wp.from_torch(self.worlds.force, dtype=wp.vec3),
            wp.from_torch(self._latency),
        ]
        self._count = wp.from_torch(self._steps)
        of_world = factors[np.arange(count) % len(factors)] if len(factors) else np.ones((count, 0))
        self._factors = tuple(tensor(column, self.device) for column in of_world.T)
        # What only computes, as graphs of its own on a GPU.
        self._controlled = Replayed(self.plant.control, self.device)
        self._followed = Replayed(self._follow, self.device)
        self._chosen = Replayed(self._choose, self.device)

    @property
    def substeps(self) -> int:
        """Physics steps done so far, all worlds together. Waits for the device."""
        return int(self._steps) * self._substeps

    def begin(self, which: torch.Tensor, rows: torch.Tensor) -> S:
        """Starts episodes anew.

        Args:
            which: number of a start in the pool for every row, shape (n,), int64.
            rows: in which episodes begin, shape (n,), bool.

        Returns:
            The states that `which` names, of all n rows; they mean something where `rows` holds.
        """
        worlds = self.worlds
        qpos, qvel, fresh = self._chosen(which, rows, worlds.qpos, worlds.qvel)
        worlds.qpos.copy_(qpos)
        worlds.qvel.copy_(qvel)
        worlds.act.masked_fill_(rows[:, None], 0.0)
        if self.disturbances.push or self.disturbances.latency:
            self._disturb(rows)
        if self.disturbances.latency:
            self._actions.masked_fill_(rows[:, None, None], 0.0)
        return fresh

    def _choose(
        self, which: torch.Tensor, rows: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, S]:
        """Positions and velocities with those of the chosen starts in `rows`, and their states."""
        places = [
            torch.where(rows[:, None], starts[which], old)
            for starts, old in zip(self._starts, (qpos, qvel), strict=True)
        ]
        return places[0], places[1], self._fresh.rows(which)

    def advance(self, state: S, action: torch.Tensor) -> S:
        """The states one time step later."""
        worlds = self.worlds
        if self.disturbances.latency:
            self._actions.copy_(torch.cat([action[:, None], self._actions[:, :-1]], dim=1))
            action = self._actions[torch.arange(len(action), device=self.device), self._latency]
        control, memory = self._controlled(state, action)
        worlds.ctrl.copy_(control)
        worlds.time.copy_(state.time)
        self._steps += len(action)
        worlds.step()
        self._failures += self.diverged.sum()
        return self._followed(
            state, memory, worlds.qpos, worlds.qvel, worlds.sensordata, self.diverged
        )

    def _follow(
        self,
        state: S,
        memory: torch.Tensor,
        qpos: torch.Tensor,
        qvel: torch.Tensor,
        sensordata: torch.Tensor,
        diverged: torch.Tensor,
    ) -> S:
        """The states after a step from `state`; where the physics diverged, those before it."""
        following = self.plant.read(
            Readings(
                time=state.time + self.task.timestep,
                # Copies, because the next step overwrites the arrays.
                qpos=qpos.clone(),
                qvel=qvel.clone(),
                sensors=self.worlds.sensors(sensordata.clone()),
                memory=memory,
            )
        )
        return merged(diverged, state, following)

    def unseen(self) -> tuple[torch.Tensor, ...]:
        """As `DisturbedPhysics.unseen`, each of shape (n,), float32."""
        late = (self._latency.float(),) if self.disturbances.latency else ()
        return (*self._factors, *late)

    def check(self) -> None:
        """Waits for the device. To be called once in a while, such as once a rollout.

        Raises:
            TsbenchError: a step since the beginning left out contacts or constraints.
        """
        self.worlds.check()

    def warned(self) -> dict[str, int]:
        """How many steps could not be computed so far. Waits for the device."""
        failures = int(self._failures)
        return {"diverged": failures} if failures else {}

    def snapshot(self) -> dict[str, Any]:
        """All data that is kept between two calls, as arrays on the host."""
        return {name: tensor.cpu().numpy().copy() for name, tensor in self._kept().items()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot of an object that was made alike."""
        for name, array in self._kept().items():
            array.copy_(torch.as_tensor(np.asarray(snapshot[name])))

    def _kept(self) -> dict[str, torch.Tensor]:
        worlds = self.worlds
        return {
            "qpos": worlds.qpos,
            "qvel": worlds.qvel,
            "act": worlds.act,
            "first": worlds.first,
            "force": worlds.force,
            "latency": self._latency,
            "actions": self._actions,
            "episode": self._episode,
            "steps": self._steps,
            "failures": self._failures,
        }

    def _disturb(self, rows: torch.Tensor) -> None:
        inputs = [wp.from_torch(rows), self._seed, self._count, *self._drawn]
        self.worlds.launch(_disturb, inputs, self._drawing)

    def _placed(
        self, rng: Rng, perturbed: bool, change: Change | None, threads: int | None
    ) -> tuple[tuple[torch.Tensor, torch.Tensor], S]:
        """The pool: qpos and qvel, and the states that C MuJoCo computes for them."""
        start = self.task.start(rng, self.pool, perturbed=perturbed)
        size = min(_PLACED, self.pool)
        physics: Physics[S] = Physics(self.task, size, threads=threads, change=change)
        states: list[S] = []
        for first in range(0, self.pool, size):
            block = start.rows(slice(first, first + size))
            states.append(physics.place(np.arange(len(block.time)), block))
        state = type(states[0]).joined(states)
        places = (tensor(start.qpos, self.device), tensor(start.qvel, self.device))
        return places, at_device(state, self.device)


class HostPhysics(Generic[S]):
    """A task's full physics for scores: `Physics` in another engine, with the same face. Arrays on
    the host go in and come out, in float64; between them the numbers have float32.

    Attributes:
        push: the push that disturbs the episodes, or None.
        substeps: physics steps done so far, all episodes together.
        diverged: rows in which the last step could not be computed, sorted.
        seconds: wall-clock time spent in the engine so far.
        side_by_side: how many episodes are best played at once.
    """

    def __init__(
        self,
        task: SimulatedTask[S],
        count: int,
        *,
        threads: int | None = None,
        change: Change | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        """`device` None means a GPU where there is one; `threads` has no effect.

        Raises:
            TsbenchError: there is no such device.
        """
        self.task = task
        self.plant = task.plant
        self.push: Push | None = None
        self.substeps = 0
        self.seconds = 0.0
        self.diverged = np.zeros(0, int)
        self._nstep = self.plant.substeps * (change or Change()).refine
        self.device = _exact(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        self.side_by_side = Physics.side_by_side if self.device.type == "cpu" else 4096
        self.worlds = Worlds(
            physics_model(task, change),
            count,
            device=self.device,
            pushed=self.plant.pushed,
            timestep=task.timestep,
            substeps=self._nstep,
        )

    def begin(self, rng: Rng, rows: np.ndarray) -> S:
        return self.place(rows, self.task.start(rng, len(rows)))

    def place(self, rows: np.ndarray, start: Start) -> S:
        """Puts the simulations in `rows` where `start` says and returns their states."""
        began = perf_counter()
        self.worlds.qpos[rows] = self._tensor(start.qpos)
        self.worlds.qvel[rows] = self._tensor(start.qvel)
        self.worlds.act[rows] = 0.0
        self.worlds.look()
        state = self._read(rows, start.time, start.memory)
        self.seconds += perf_counter() - began
        return state

    def advance(self, state: S, action: Array, rows: np.ndarray | None = None) -> S:
        control, memory = self.plant.control(state, action)
        at = np.arange(len(self.worlds.qpos)) if rows is None else rows
        began = perf_counter()
        worlds = self.worlds
        before = [array.clone() for array in (worlds.qpos, worlds.qvel, worlds.act)]
        worlds.ctrl[at] = self._tensor(control)
        worlds.time[at] = self._tensor(state.time)
        worlds.force.zero_()
        if self.push is not None:
            push = self.push.rows(at)
            worlds.first[at] = self._tensor(np.broadcast_to(push.time, len(at)))
            worlds.duration[at] = self._tensor(np.broadcast_to(push.duration, len(at)))
            worlds.force[at, 0] = self._tensor(np.broadcast_to(push.force, (len(at), 3)))
        worlds.step()
        worlds.check()
        self.diverged = at[worlds.diverged.cpu().numpy()[at]]
        following = self._read(at, state.time + self.task.timestep, memory)
        stays = torch.ones(len(worlds.qpos), dtype=torch.bool, device=self.device)
        stays[at] = False
        for array, old in zip((worlds.qpos, worlds.qvel, worlds.act), before, strict=True):
            array.copy_(torch.where(stays[:, None], old, array))
        self.seconds += perf_counter() - began
        self.substeps += len(control) * self._nstep
        if len(self.diverged):
            failed = np.flatnonzero(np.isin(at, self.diverged))
            following = following.updated(failed, state.rows(failed))
        return following

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """qpos (n, nq) and qvel (n, nv) of all simulations."""
        return _host(self.worlds.qpos), _host(self.worlds.qvel)

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.tensor(np.array(values), dtype=torch.float32, device=self.device)

    def _read(self, rows: np.ndarray, time: np.ndarray, memory: np.ndarray) -> S:
        worlds = self.worlds
        qpos, qvel, sensordata = (
            _host(array)[rows] for array in (worlds.qpos, worlds.qvel, worlds.sensordata)
        )
        sensors = worlds.sensors(sensordata)
        return self.plant.read(
            Readings(time=time, qpos=qpos, qvel=qvel, sensors=sensors, memory=memory)
        )


def _host(tensor: torch.Tensor) -> np.ndarray:
    return tensor.cpu().numpy().astype(float)


def _exact(device: torch.device | str) -> torch.device:
    """With the number of the GPU.

    Raises:
        TsbenchError: there is no such device.
    """
    device = torch.device(device)
    if device.type == "cpu":
        return device
    if device.type != "cuda":
        raise TsbenchError(f"physics on warp runs on cpu or cuda, not on {device.type}")
    number = 0 if device.index is None else device.index
    if number >= torch.cuda.device_count():
        raise TsbenchError(f"there is no {device}: torch finds {torch.cuda.device_count()} GPUs")
    return torch.device("cuda", number)
