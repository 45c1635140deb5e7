"""Tasks without the optional parts: a planning variant, a distance constant, feet to track.

The cart is a minimal task: a mass on a rail that has to stop at a mark.
"""

from __future__ import annotations

import io
import re
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from rich.console import Console

from tsbench import TsbenchError, methods, tasks
from tsbench.cli import describe
from tsbench.core import plugins
from tsbench.core.arrays import Array, array_namespace
from tsbench.core.method import Budget, Problem
from tsbench.core.motion import Audit, AuditItem, Plan, ReferenceMotion
from tsbench.core.state import Course, Readings, Rng, Start, State
from tsbench.core.task import Abstraction, Plannable, Task, Tracker
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.protocol import SMOKE
from tsbench.methods.twostage import extract
from tsbench.runs import schema
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.kinematic import Planning, naive_plan
from tsbench.sim.physics import Physics
from tsbench.sim.single import environment
from tsbench.sim.tracking import Imitation
from tsbench.viewer.recording import record_episode

RAIL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" damping="1"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="rail" gear="5"/></actuator>
</mujoco>
"""


@dataclass(frozen=True)
class CartState(State):
    x: Array
    v: Array


@dataclass(frozen=True)
class Cart(Task[CartState]):
    mark: float = 1.0
    name = "cart"
    version = 1
    horizon = 20
    timestep = 0.05
    substeps = 5
    observation_size = 2
    action_size = 1
    max_reward = 1.0
    pushed = "cart"
    push_plane = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    push_steps = (4, 8)

    def constants(self) -> dict[str, Any]:
        return asdict(self)

    def observation(self, state: CartState) -> Array:
        return array_namespace(state.x).stack([self.mark - state.x, state.v], axis=-1)

    def reward(self, previous: CartState, action: Array, state: CartState) -> Array:
        return array_namespace(state.x).exp(-self.goal_distance(state))

    def terminal(self, state: CartState) -> Array:
        return state.x < -1.0

    def success(self, state: CartState, course: Course) -> Array:
        return self.goal_distance(state) < 0.1

    def goal_distance(self, state: CartState) -> Array:
        return abs(self.mark - state.x)

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(RAIL)

    def start(self, rng: Rng, count: int, *, perturbed: bool = False) -> Start:
        x = rng.uniform(-0.1, 0.1, (count, 1)) if perturbed else np.zeros((count, 1))
        return Start(np.zeros(count), x, np.zeros((count, 1)), np.zeros((count, 0)))

    def read(self, readings: Readings) -> CartState:
        return CartState(readings.time, readings.qpos[..., 0], readings.qvel[..., 0])

    def ideal(self) -> CartState:
        time = np.arange(self.horizon + 1) * self.timestep
        return CartState(time, np.minimum(2.0 * time, self.mark), 0.0 * time)


class Rails(Abstraction[CartState]):
    """The cart's planning variant: it is moved by at most 0.1 m."""

    timestep = 0.05
    horizon = 20
    action_size = observation_size = 1
    coordinates = ("x",)

    def __init__(self, task: Cart) -> None:
        self.task = task

    def start(self, count: int) -> CartState:
        return CartState(*np.zeros((3, count)))

    def sample(self, rng: Rng, count: int) -> CartState:
        return replace(self.start(count), x=rng.uniform(0.0, 1.0, count))

    def advance(self, state: CartState, action: Array) -> CartState:
        return replace(state, time=state.time + 0.05, x=state.x + 0.1 * action[..., 0])

    def observation(self, state: CartState) -> Array:
        return self.task.mark - state.x[..., None]

    def flatten(self, state: CartState) -> Array:
        return state.x[..., None]

    def naive(self, state: CartState) -> Array:
        return np.clip(10.0 * self.observation(state), -1.0, 1.0)

    def poses(self, coordinates: np.ndarray) -> np.ndarray:
        return coordinates


class FollowTip(Tracker[CartState]):
    """A tracking reward on an array that Laikago's reference motions do not have."""

    max_reward = 1.0

    def __init__(self, task: Cart, reference: ReferenceMotion) -> None:
        self.task, self.reference, self.horizon = task, reference, reference.steps

    def reward(self, previous: CartState, action: Array, state: CartState) -> Array:
        tip = self.reference.tracked["tip"][self.reference.frame(state.time)]
        return np.exp(-abs(tip[..., 0] - state.x - 0.1))

    def terminal(self, state: CartState) -> Array:
        return self.task.terminal(state)

    def start(self, rng: Rng, count: int) -> Start:
        return self.task.start(rng, count)


class PlannableCart(Cart, Plannable[CartState]):
    imitation_forms = ("tip",)
    tracked = MappingProxyType({"tip": (2,)})

    def abstraction(self) -> Rails:
        return Rails(self)

    def reference(self, plan: Plan) -> ReferenceMotion:
        tip = np.concatenate([plan.states + 0.1, 0.0 * plan.states], axis=1)
        moved = np.gradient(plan.states, self.timestep, axis=0)
        return ReferenceMotion(self.name, 1, self.timestep, plan.states, moved, {"tip": tip})

    def audit(self, plan: Plan, reference: ReferenceMotion) -> Audit:
        return Audit(
            (AuditItem("end from the mark", abs(float(plan.states[-1, 0]) - 1), 0.1, "m"),)
        )

    def tracker(self, reference: ReferenceMotion, form: str | None = None) -> FollowTip:
        self.imitation_form(form)
        return FollowTip(self, reference)


def problem(task: Task[Any], tmp_path: Path) -> tuple[Problem, Any]:
    """A problem with a minimal budget, and a workspace in `tmp_path`."""
    monitor = SimpleNamespace(saved=None, update=lambda *_: None)
    desk = SimpleNamespace(
        directory=tmp_path, stage=lambda name, steps: nullcontext(monitor), note=lambda line: None
    )
    settings = {"environments": 4, "rollout": 8, "minibatches": 2, "hidden": [8]}
    training = dict.fromkeys(("plan", "imitate", "task"), settings)
    return Problem(task, Budget(64, 64, audit="warn"), training, {}, seed=0, threads=1), desk


def test_a_task_without_a_planning_variant_can_be_learned_scored_and_seen(tmp_path: Path) -> None:
    given, desk = problem(Cart(), tmp_path)
    policy = methods.find("monolithic").train(given, desk)
    score = evaluate(policy, Cart(), protocol=SMOKE, threads=1)
    assert 0.0 < score.perturbed.normalized_reward < 1.0
    assert evaluate(policy, Cart(), protocol=SMOKE, threads=1) == score
    assert record_episode(Cart(), policy).solved is not None
    time_step = environment(Cart(), seed=0).reset()
    np.testing.assert_array_equal(next(iter(time_step.observation.values())), [1.0, 0.0])


def test_what_needs_a_planning_variant_says_so(tmp_path: Path) -> None:
    words = "^cart has no planning variant, which this needs$"
    given, desk = problem(Cart(), tmp_path)
    for method in ("twostage", "prm", "prm_rl"):
        lacks = (
            f"^the method {method} needs a planning variant, which cart lacks; method=monolithic"
        )
        with pytest.raises(TsbenchError, match=lacks):
            methods.find(method).train(given, desk)
    with pytest.raises(TsbenchError, match=words):
        Planning(Cart())
    with pytest.raises(TsbenchError, match=words):
        Imitation(Cart(), PlannableCart().reference(naive_plan(PlannableCart())))


def test_the_card_of_a_task_without_a_plan_suggests_a_method_that_can_learn_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tasks, "_factories", {})
    monkeypatch.setattr(tasks, "provider", lambda name: plugins.own())
    tasks.register("cart")(Cart)
    monkeypatch.setattr(schema, "budgets", lambda name: {})  # it has no configuration
    console = Console(file=io.StringIO(), record=True)
    describe.show(console, "cart")
    words = "Try it: tsbench run task=cart method=monolithic budget=smoke"
    shown = console.export_text()
    assert shown.splitlines()[-1] == words
    assert re.search(r" action +1 number in \[-1, 1\]", shown)
    assert re.search(r" observation +2 numbers", shown)


def test_a_task_with_other_tracking_data(tmp_path: Path) -> None:
    task = PlannableCart()
    given, desk = problem(task, tmp_path)
    policy = methods.find("twostage").train(given, desk)
    assert policy.info.method == "twostage"
    kept = ReferenceMotion.load(tmp_path / "reference.npz")
    assert kept.tracked["tip"].shape == (kept.steps + 1, 2)
    plan = naive_plan(task)
    reference = task.reference(plan)
    assert task.audit(plan, reference).passed
    imitation = Imitation(task, reference)
    env = BatchedEnvironment(imitation, Physics(imitation, 3, threads=1), 3, seed=0)
    env.reset()
    reward = env.step(np.zeros((3, 1))).reward
    np.testing.assert_allclose(reward, np.exp(-0.1))  # the reference has gone 0.1 m, the cart 0
    with pytest.raises(TsbenchError, match=r"^the reference motion lacks tip$"):
        Imitation(task, replace(reference, tracked={}))
    flat = {"tip": reference.tracked["tip"][:, :1]}
    with pytest.raises(TsbenchError, match=r"^the reference motion has 1 tip a step, not 2$"):
        Imitation(task, replace(reference, tracked=flat))
    assert extract(Planning(task), lambda o: np.ones((len(o), 1))).states[-1, 0] == pytest.approx(2)
