"""Many episodes of one MDP on one torch device, which begin anew as they end.

The semantics are those of `BatchedEnvironment`, in float32. Nothing moves to the host in a step:
rows are chosen by masks, shapes never change, and errors are kept on the device until `check` reads
them. On a GPU the functions of the MDP are recorded as CUDA graphs when they are first called, and
replayed afterwards: they consist of some hundred small kernels, and launching those one by one
would take longer than running them.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from time import perf_counter
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from tsbench.core.arrays import step_of
from tsbench.core.errors import NotFiniteError
from tsbench.core.state import Batch, Course, S
from tsbench.core.task import MDP
from tsbench.sim.dynamics import expect_shape
from tsbench.sim.kinematic import Planning

POOL = 2**16  # starts that are drawn in advance
WARM_UP = 3  # calls of a function before it is recorded, in which torch picks and loads its kernels

B = TypeVar("B", bound=Batch)
T = TypeVar("T")


class DeviceDynamics(Protocol[S]):
    """Dynamics of n episodes on one torch device. Arrays are tensors there, floats are float32.

    Neither `begin` nor `advance` waits for the device, moves data to the host or changes a shape.
    Tensors that they return may be overwritten by the next call of the same function.

    Attributes:
        pool: number of starts to choose from.
        diverged: whether the last step of a row could not be computed, shape (n,). Such a row
            keeps the state before that step, and its episode has to end.
    """

    pool: int
    diverged: Tensor

    @property
    def substeps(self) -> int:
        """Physics steps done so far, all episodes together; may wait for the device."""

    def begin(self, which: Tensor, rows: Tensor) -> S:
        """Starts new episodes.

        Args:
            which: number of the start of each row, integers in [0, pool), shape (n,).
            rows: whether an episode begins in a row, shape (n,).

        Returns:
            The states of all n rows; only those of `rows` have a meaning.
        """

    def advance(self, state: S, action: Tensor) -> S:
        """The states one time step later."""

    def unseen(self) -> tuple[Tensor, ...]:
        """As `Dynamics.unseen`, each of shape (n,), float32."""

    def check(self) -> None:
        """Called after each rollout; may wait for the device.

        Raises:
            TsbenchError: the physics since the last call cannot be relied on, for instance because
                contacts did not fit into memory.
        """

    def warned(self) -> dict[str, int]:
        """Number of the engine's warnings so far, by name; may wait for the device."""

    def snapshot(self) -> dict[str, Any]:
        """All data that is kept between two calls: plain values and numpy arrays."""

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot."""


def at_device(batch: B, device: torch.device) -> B:
    """The batch, made of numpy arrays, as tensors: floats as float32, the rest as it is."""
    changes = {name: tensor(array, device) for name, array in vars(batch).items()}
    return batch.replace(**changes)


def tensor(array: np.ndarray, device: torch.device) -> Tensor:
    """A numpy array on a device; floats become float32."""
    kind = torch.float32 if np.asarray(array).dtype.kind == "f" else None
    return torch.as_tensor(np.array(array), dtype=kind, device=device)


def merged(rows: Tensor, first: B, second: B) -> B:
    """The batch with the members of `first` where `rows` (n,) is true, else those of `second`."""

    def choose(one: Tensor, other: Tensor) -> Tensor:
        return torch.where(rows.reshape(-1, *[1] * (one.ndim - 1)), one, other)

    names = [field.name for field in fields(first)]
    return first.replace(**{n: choose(getattr(first, n), getattr(second, n)) for n in names})


class Replayed(Generic[T]):
    """A function of tensors that, on a GPU, is recorded as a CUDA graph and replayed.

    The function must be pure, and its result may depend on nothing but its arguments: whatever
    Python does in it happens only while it is recorded. On a CPU it is called as it is.

    The results are overwritten by the next call.
    """

    def __init__(self, function: Callable[..., T], device: torch.device) -> None:
        """The arguments and the result are tensors, batches of them, or tuples of those."""
        self._function = function
        self._device = device
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: list[Tensor] = []
        self._result: T

    def __call__(self, *arguments: Any) -> T:
        if self._device.type != "cuda":
            return self._function(*arguments)
        if self._graph is None:
            self._graph = self._record(arguments)
        else:
            self._fill(_leaves(arguments))
        self._graph.replay()
        return self._result

    def _fill(self, given: list[Tensor]) -> None:
        """Copies arguments to where the graph reads them, in one kernel where that is possible."""
        pairs = list(zip(self._inputs, given, strict=True))
        plain = [
            pair for pair in pairs
            if pair[1].dtype == torch.float32 and pair[1].stride() == pair[0].stride()
        ]  # fmt: skip
        if plain:
            torch._foreach_copy_([to for to, _ in plain], [of for _, of in plain])
        together = {id(to) for to, _ in plain}
        for to, of in pairs:
            if id(to) not in together:
                to.copy_(of)

    def _record(self, arguments: tuple[Any, ...]) -> torch.cuda.CUDAGraph:
        copies = _copied(arguments)
        self._inputs = _leaves(copies)
        aside = torch.cuda.Stream(self._device)
        aside.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(aside):
            for _ in range(WARM_UP):
                self._function(*copies)
        torch.cuda.current_stream(self._device).wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with no_garbage_collection(), torch.cuda.graph(graph, stream=aside):
            self._result = self._function(*copies)
        return graph


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """A collection while a GPU records could free device memory, which the recording forbids."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _leaves(value: Any) -> list[Tensor]:
    """The tensors in nested tuples and batches."""
    if isinstance(value, Tensor):
        return [value]
    parts = vars(value).values() if isinstance(value, Batch) else value
    return [leaf for part in parts for leaf in _leaves(part)]


def _copied(value: Any) -> Any:
    """Nested tuples and batches with copies of their tensors."""
    if isinstance(value, Tensor):
        return value.clone(memory_format=torch.contiguous_format)
    if isinstance(value, Batch):
        return value.replace(**{name: _copied(part) for name, part in vars(value).items()})
    return tuple(_copied(part) for part in value)


class Stopwatch:
    """Adds up the seconds that a device spends in a context.

    On a GPU, whose work goes on after the call that asks for it, events mark both ends.
    """

    def __init__(self, device: torch.device) -> None:
        self._on_gpu = device.type == "cuda"
        self._marks: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []
        self._seconds = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        if self._on_gpu:
            first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            first.record()
            yield
            last.record()
            self._marks.append((first, last))
        else:
            began = perf_counter()
            yield
            self._seconds += perf_counter() - began

    def seconds(self) -> float:
        """So far; waits for the device."""
        if self._marks:
            self._marks[-1][1].synchronize()
            self._seconds += sum(first.elapsed_time(last) for first, last in self._marks) / 1e3
            self._marks.clear()
        return self._seconds


@dataclass(frozen=True)
class DeviceTransition(Generic[S]):
    """The result of a step of n episodes. The next step overwrites its tensors.

    Attributes:
        observation: of the next state, shape (n, observation_size); where an episode ended, of the
            start of the next episode.
        value_observation: the same for the critic, shape (n, any).
        reward: reward of the step, shape (n,); zero where the physics diverged.
        terminal: whether the episode ended for a reason other than its last step. Divergence of
            the physics is such a reason.
        truncated: whether the episode ended with its last step.
        following: the states that the step led to; where an episode ended, its last.
        spared: steps that an episode which arrived at its goal did not need (`MDP.spared`).
        quality: what each of those is worth beside a perfect one, in [0, 1].
    """

    observation: Tensor
    value_observation: Tensor
    reward: Tensor
    terminal: Tensor
    truncated: Tensor
    following: S
    spared: Tensor
    quality: Tensor


@dataclass(frozen=True)
class _Judged(Batch):
    """What a step was worth and whether it ended an episode. As in `DeviceTransition`, and:

    Attributes:
        steps: steps taken in each episode.
        ended: whether the episode ended.
        wrong: whether a number was not finite so far, shape (n, quantities).
        course: of each episode.
    """

    reward: Tensor
    terminal: Tensor
    truncated: Tensor
    ended: Tensor
    spared: Tensor
    quality: Tensor
    steps: Tensor
    wrong: Tensor
    course: Course


class DeviceEnvironment(Generic[S]):
    """Episodes of an MDP on one torch device that are stepped together and begin anew as they end.

    Attributes:
        state: of all episodes.
        steps: steps taken in each episode since its start, shape (n,). An episode that starts
            along a reference motion starts with the steps that lie before.
        course: of all episodes so far.
    """

    def __init__(
        self,
        mdp: MDP[S],
        dynamics: DeviceDynamics[S],
        count: int,
        seed: int,
        device: torch.device,
    ) -> None:
        self.mdp = mdp
        self.dynamics = dynamics
        self.count = count
        self.device = device
        self.state: S
        self.steps: Tensor
        self.course: Course
        self._generator = torch.Generator(device)
        self._generator.manual_seed(seed)
        self._which = torch.zeros(count, dtype=torch.int64, device=device)
        self._wrong: Tensor
        self._quantities: list[str] = []
        self._judged = Replayed(self._judge, device)
        self._settled = Replayed(self._settle, device)
        self._whole, self._physics = Stopwatch(device), Stopwatch(device)

    @property
    def seconds(self) -> float:
        """Seconds spent in `step` so far; waits for the device."""
        return self._whole.seconds()

    @property
    def physics_seconds(self) -> float:
        """Seconds of those spent in the dynamics; waits for the device."""
        return self._physics.seconds()

    @torch.inference_mode()
    def reset(self) -> tuple[Tensor, Tensor]:
        """Starts all episodes; returns the observations and those of the critic."""
        everyone = torch.ones(self.count, dtype=torch.bool, device=self.device)
        state = self.dynamics.begin(self._draw(), everyone)
        self.state = _copied(state)
        self.steps = step_of(state.time, self.mdp.timestep)
        self.course = self.mdp.begun(self.state)
        self._quantities = ["action", *vars(state), "reward"]
        self._wrong = torch.zeros(
            (self.count, len(self._quantities)), dtype=torch.bool, device=self.device
        )
        value = self._with_unseen(self.mdp.value_observation(self.state))
        return self.mdp.observation(self.state), value

    @torch.inference_mode()
    def step(self, action: Tensor) -> DeviceTransition[S]:
        """One time step of all episodes; `action` has shape (n, action_size), float32.

        Raises:
            TsbenchError: the action has another shape.
        """
        expect_shape(action, (self.count, self.mdp.action_size))
        with self._whole.running():
            with self._physics.running():
                following = self.dynamics.advance(self.state, action)
            judged = self._judged(
                self.state, action, following, self.dynamics.diverged, self.steps, self.course,
                self._wrong,
            )  # fmt: skip
            with self._physics.running():
                fresh = self.dynamics.begin(self._draw(), judged.ended)
            self.state, self.steps, self.course, observation, value = self._settled(
                following, fresh, judged.ended, judged.steps, judged.course
            )
            self._wrong = judged.wrong
        return DeviceTransition(
            observation=observation,
            value_observation=self._with_unseen(value),
            reward=judged.reward,
            terminal=judged.terminal,
            truncated=judged.truncated,
            following=following,
            spared=judged.spared,
            quality=judged.quality,
        )

    def _with_unseen(self, value: Tensor) -> Tensor:
        unseen = self.dynamics.unseen()
        return torch.column_stack([value, *unseen]) if unseen else value

    def _draw(self) -> Tensor:
        """The number of the start that each row takes if an episode begins in it."""
        return self._which.random_(0, self.dynamics.pool, generator=self._generator)

    def _judge(
        self, previous: S, action: Tensor, following: S, diverged: Tensor, steps: Tensor,
        course: Course, wrong: Tensor,
    ) -> _Judged:  # fmt: skip
        mdp = self.mdp
        steps = steps + 1
        reward = mdp.reward(previous, action, following)
        looked_at = [action, *vars(following).values(), reward]
        finite = [torch.isfinite(one).reshape(self.count, -1).all(dim=1) for one in looked_at]
        reward = torch.where(diverged, torch.zeros_like(reward), reward)
        terminal = mdp.terminal(following) | diverged
        course = mdp.followed(course, previous, following)
        course = course.replace(violated=course.violated | diverged)
        truncated = (steps >= mdp.horizon) & ~terminal
        ended = terminal | truncated
        quality = mdp.quality(course)
        return _Judged(
            reward=reward,
            terminal=terminal,
            truncated=truncated,
            ended=ended,
            spared=torch.where(terminal, mdp.spared(following, course), 0),
            quality=torch.where(ended, quality, torch.zeros_like(quality)),
            steps=steps,
            wrong=wrong | ~torch.stack(finite, dim=1),
            course=course,
        )

    def _settle(
        self, following: S, fresh: S, ended: Tensor, steps: Tensor, course: Course
    ) -> tuple[S, Tensor, Course, Tensor, Tensor]:
        mdp = self.mdp
        state = merged(ended, fresh, following)
        steps = torch.where(ended, step_of(fresh.time, mdp.timestep), steps)
        course = merged(ended, mdp.begun(fresh), course)
        return state, steps, course, mdp.observation(state), mdp.value_observation(state)

    def check(self) -> None:
        """Called after each rollout; waits for the device.

        Raises:
            NotFiniteError: a number in action, state or reward was not finite.
            TsbenchError: the physics cannot be relied on (`DeviceDynamics.check`).
        """
        if bool(self._wrong.any()):
            row, quantity = (int(index) for index in self._wrong.nonzero()[0])
            raise NotFiniteError(
                f"{self._quantities[quantity]} of environment {row} was not finite in a step of"
                " the last rollout",
                {"steps": _array(self.steps), "wrong": _array(self._wrong), **_arrays(self.state)},
            )
        self.dynamics.check()

    def snapshot(self) -> dict[str, Any]:
        """Everything that the next step depends on besides the action: plain values and arrays."""
        return {
            "rng": self._generator.get_state().numpy(),
            "steps": _array(self.steps),
            "course": _arrays(self.course),
            "state": _arrays(self.state),
            "dynamics": self.dynamics.snapshot(),
        }

    @torch.inference_mode()
    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restores the state of a snapshot; `reset` must have been called before."""
        self._generator.set_state(torch.from_numpy(snapshot["rng"]))
        self.steps = tensor(snapshot["steps"], self.device)
        self.course = at_device(self.course.replace(**snapshot["course"]), self.device)
        self.state = at_device(self.state.replace(**snapshot["state"]), self.device)
        self.dynamics.restore(snapshot["dynamics"])


class DeviceKinematics(Generic[S]):
    """The dynamics of a planning variant on a torch device. They are `DeviceDynamics`.

    Attributes:
        planning: the variant. Its `explore` may be changed at any time.
    """

    substeps = 0  # of a physics engine, which planning does not use

    def __init__(
        self, planning: Planning[S], count: int, seed: int, device: torch.device, pool: int = POOL
    ) -> None:
        """`pool` states are sampled from `seed`, for the episodes that begin at one."""
        self.planning = planning
        self.pool = pool
        self.diverged = torch.zeros(count, dtype=torch.bool, device=device)  # never
        abstraction = planning.abstraction
        sampled = abstraction.sample(np.random.default_rng(seed), pool)
        self._sampled = at_device(sampled, device)
        self._start = at_device(abstraction.start(count), device)
        self._limit = torch.zeros((), dtype=torch.int64, device=device)
        self._explore = 0.0
        self._advance = Replayed(abstraction.advance, device)
        self._begin = Replayed(self._choose, device)

    def begin(self, which: Tensor, rows: Tensor) -> S:
        """As `DeviceDynamics.begin`. A row whose number lies in the first share `explore` of the
        numbers begins at the sampled state of that number, the others at the task's start."""
        if self._explore != self.planning.explore:
            self._explore = self.planning.explore
            self._limit.fill_(round(self._explore * self.pool))
        return self._begin(which, self._limit)

    def _choose(self, which: Tensor, limit: Tensor) -> S:
        return merged(which < limit, self._sampled.rows(which), self._start)

    def advance(self, state: S, action: Tensor) -> S:
        return self._advance(state, action)

    def unseen(self) -> tuple[Tensor, ...]:
        return ()

    def check(self) -> None:
        """Kinematics cannot fail."""

    def warned(self) -> dict[str, int]:
        return {}

    def snapshot(self) -> dict[str, Any]:
        return {"explore": self.planning.explore}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.planning.explore = snapshot["explore"]


def _array(values: Tensor) -> np.ndarray:
    array: np.ndarray = values.numpy(force=True)
    return array


def _arrays(batch: Batch) -> dict[str, np.ndarray]:
    return {name: _array(values) for name, values in vars(batch).items()}
