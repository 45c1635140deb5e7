"""Calls every function of a task on arrays of another library, data type and device.

On float32 tensors of torch each function returns float32, within 1e-4 of its result on float64
arrays of numpy. Each function also runs on torch's meta device, whose tensors have no values: that
shows that no array moves to the host.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from tsbench import tasks
from tsbench.core.motion import ReferenceMotion
from tsbench.core.state import Batch, Readings
from tsbench.core.task import Plannable, Task
from tsbench.sim.kinematic import Planning
from tsbench.sim.model import sensor_slices
from tsbench.sim.physics import Physics
from tsbench.testing.episodes import reference_of

COUNT = 48
STEPS = 20
Call = tuple[str, Callable[..., Any], tuple[Any, ...]]  # a name, a function, its arguments


def converted(value: Any, convert: Callable[[np.ndarray], Any]) -> Any:
    """A copy of nested states, readings and mappings with every array in them converted."""
    if isinstance(value, np.ndarray):
        return convert(value)
    if isinstance(value, (Batch, Readings)):
        fields = {
            f.name: converted(getattr(value, f.name), convert) for f in dataclasses.fields(value)
        }
        return dataclasses.replace(value, **fields)
    if isinstance(value, Mapping):
        return {name: converted(part, convert) for name, part in value.items()}
    return value


def single(values: np.ndarray) -> np.ndarray:
    """Values rounded to float32, in float64, so that only the arithmetic differs."""
    return values.astype(np.float32).astype(float) if values.dtype.kind == "f" else values


def tensor(values: np.ndarray) -> torch.Tensor:
    kind = torch.float32 if values.dtype.kind == "f" else None
    return torch.tensor(values, dtype=kind)


def meta(values: np.ndarray) -> torch.Tensor:
    return tensor(values).to("meta")


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every array in what a function returned."""
    if isinstance(value, Batch):
        value = vars(value)
    if isinstance(value, Mapping):
        for name, part in value.items():
            yield from leaves(part, f"{path}.{name}")
    elif isinstance(value, tuple):
        for number, part in enumerate(value):
            yield from leaves(part, f"{path}[{number}]")
    else:
        yield path, value


def calls(task: Task[Any], reference: ReferenceMotion | None) -> Iterator[Call]:
    """Every function of a task and its planning variant, with arguments from an episode of random
    actions."""
    rng = np.random.default_rng(0)
    physics: Physics[Any] = Physics(task, COUNT, threads=1, perturbed=True)
    state = physics.begin(rng, np.arange(COUNT))
    for _ in range(STEPS):
        action = single(rng.uniform(-1.2, 1.2, (COUNT, task.action_size)))
        previous, state = state, physics.advance(state, action)
    previous, state = (converted(one, single) for one in (previous, state))
    yield from _mdp_calls("task", task, previous, action, state)
    yield "goal_distance", task.goal_distance, (state,)
    course = converted(task.followed(task.begun(previous), previous, state), single)
    sums = converted(task.measured(previous, action, state), single)
    steps = np.full(COUNT, 10)
    yield "success", task.success, (state, course)
    yield "measured", task.measured, (previous, action, state)
    yield "measured, no action", task.measured, (previous, None, state)
    yield "measures", task.measures, (previous, state, course, sums, steps)
    yield "control", task.control, (state, action)
    yield "memory", task.memory, (state,)
    yield "read", task.read, (_readings(physics, task, state),)
    if not isinstance(task, Plannable):
        return
    planning: Planning[Any] = Planning(task)
    abstraction = planning.abstraction
    sampled = converted(abstraction.sample(rng, COUNT), single)
    move = single(rng.uniform(-1.2, 1.2, (COUNT, abstraction.action_size)))
    following = converted(abstraction.advance(sampled, move), single)
    yield "abstraction.advance", abstraction.advance, (sampled, move)
    yield "abstraction.flatten", abstraction.flatten, (sampled,)
    yield "abstraction.naive", abstraction.naive, (sampled,)
    yield from _mdp_calls("planning", planning, sampled, move, following)
    assert reference is not None
    for form in task.imitation_forms:
        tracker = task.tracker(reference, form)
        yield f"{form}.reward", tracker.reward, (previous, action, state)
        yield f"{form}.terminal", tracker.terminal, (state,)


def _mdp_calls(kind: str, mdp: Any, previous: Any, action: Any, state: Any) -> Iterator[Call]:
    course = mdp.begun(previous).replace(violated=np.arange(COUNT) % 2 == 0)
    yield f"{kind}.observation", mdp.observation, (state,)
    yield f"{kind}.value_observation", mdp.value_observation, (state,)
    yield f"{kind}.reward", mdp.reward, (previous, action, state)
    yield f"{kind}.reward_terms", mdp.reward_terms, (previous, action, state)
    yield f"{kind}.terminal", mdp.terminal, (state,)
    yield f"{kind}.reached", mdp.reached, (state,)
    yield f"{kind}.violated", mdp.violated, (state,)
    yield f"{kind}.begun", mdp.begun, (previous,)
    yield f"{kind}.followed", mdp.followed, (course, previous, state)
    yield f"{kind}.spared", mdp.spared, (state, course)
    yield f"{kind}.quality", mdp.quality, (mdp.followed(course, previous, state),)
    yield f"{kind}.credit", mdp.credit, (state.time, 0.5 * state.time)
    yield f"{kind}.credit, discounted", mdp.credit, (state.time, 0.5 * state.time, 0.99)


def _readings(physics: Physics[Any], task: Task[Any], state: Any) -> Readings:
    bound = {name: np.array(physics.batch.bind(name)) for name in ("qpos", "qvel", "sensordata")}
    slices = sensor_slices(task.spec().compile())
    readings = Readings(
        time=state.time,
        qpos=bound["qpos"],
        qvel=bound["qvel"],
        sensors={name: bound["sensordata"][:, part] for name, part in slices.items()},
        memory=task.memory(state),
    )
    found: Readings = converted(readings, single)
    return found


@cache
def all_calls(name: str) -> list[Call]:
    task = tasks.make(name)
    return list(calls(task, reference_of(name) if isinstance(task, Plannable) else None))


class ArrayContract:
    """Tests that a task's functions keep the library, data type and device of their arrays.

    Attributes:
        names: the tasks to test.
    """

    names: ClassVar[Sequence[str]] = ()

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Runs each test for each task."""
        metafunc.parametrize("name", self.names)

    def test_torch_in_single_precision_agrees(self, name: str) -> None:
        for call, function, arguments in all_calls(name):
            expected = dict(leaves(function(*arguments)))
            found = dict(leaves(function(*(converted(argument, tensor) for argument in arguments))))
            assert found.keys() == expected.keys(), call
            for path, values in found.items():
                wanted = np.asarray(expected[path])
                assert isinstance(values, torch.Tensor), (call, path)
                kinds = {torch.float32} if wanted.dtype.kind == "f" else {torch.bool, torch.int64}
                assert values.dtype in kinds, (call, path)
                assert tuple(values.shape) == wanted.shape, (call, path)
                np.testing.assert_allclose(
                    values.numpy(), wanted, rtol=1e-4, atol=1e-4, err_msg=f"{call}{path}"
                )

    def test_nothing_moves_to_the_host(self, name: str) -> None:
        for call, function, arguments in all_calls(name):
            found = dict(leaves(function(*(converted(argument, meta) for argument in arguments))))
            for path, values in found.items():
                assert values.device.type == "meta", (call, path)

    def test_states_are_merged_and_taken_apart(self, name: str) -> None:
        state = next(args[0] for call, _, args in all_calls(name) if call == "task.observation")
        rows = np.array([1, 4])
        other = state.rows(rows).replace(time=np.array([7.0, 8.0]))
        for convert in (single, tensor):
            at = convert(rows)
            merged = converted(state, convert).updated(at, converted(other, convert))
            assert merged.time.tolist()[:5] == [state.time[0], 7.0, *state.time[2:4], 8.0]
            assert merged.rows(at).time.tolist() == [7.0, 8.0]
