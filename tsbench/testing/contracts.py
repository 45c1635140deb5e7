"""Contract tests: the promises that every task, every variant and every method keeps."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import dm_env
import numpy as np
import pytest

import tsbench
from tsbench import methods, tasks
from tsbench.core.method import Budget, Problem, Snapshot
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.policy import Policy
from tsbench.core.task import Plannable, roadmap_space
from tsbench.evaluation.evaluate import check_fit, evaluate
from tsbench.evaluation.oracle import best_return
from tsbench.evaluation.protocol import SMOKE
from tsbench.evaluation.references import zero
from tsbench.planning.roadmap import find_route
from tsbench.runs import config, execute, schema
from tsbench.sim.kinematic import Planning, plan_along, rolled_out
from tsbench.sim.model import fingerprint
from tsbench.sim.promises import check_promises
from tsbench.sim.tracking import Imitation
from tsbench.testing.episodes import (
    Case,
    at_random,
    compare,
    ending,
    episode,
    mdp,
    plan_of,
    reference_of,
    values,
)

Regime = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
REGIMES: dict[str, Regime] = {
    "uniform": lambda rng, shape: rng.uniform(-1.0, 1.0, shape),
    "small": lambda rng, shape: 0.1 * rng.normal(size=shape),
    # Smooth, and at times outside the box [-1, 1].
    "wandering": lambda rng, shape: np.cumsum(0.3 * rng.normal(size=shape), axis=0),
    "zero": lambda rng, shape: np.zeros(shape),
}


@cache
def played(case: Case) -> tuple[dm_env.Environment, list[list[dm_env.TimeStep]]]:
    """An environment, and four episodes in it under random actions."""
    environment = case.load()
    policy = at_random(environment, 7)
    return environment, [list(episode(environment, policy)) for _ in range(4)]


class Contract:
    """Tests of the environment of a task or of its variants.

    Attributes:
        names: the tasks to test.
        variants: the variants to test; None is the task itself.
        least_reward: the least reward that a step of any of them can have.
    """

    names: ClassVar[Sequence[str]] = ()
    variants: ClassVar[Sequence[tsbench.Variant | None]] = ()
    least_reward: ClassVar[float] = 0.0

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Runs each test for each task, or for each variant of each."""
        if "name" in metafunc.fixturenames:
            metafunc.parametrize("name", self.names)
        if "case" in metafunc.fixturenames:
            cases = [Case(name, variant) for name in self.names for variant in self.variants]
            metafunc.parametrize("case", cases, ids=str)

    def test_identity(self, case: Case) -> None:
        subject, task = mdp(case.load()), tasks.make(case.name)
        assert (subject.name, subject.version) == (case.name, task.version)
        assert type(subject.version) is int
        assert subject.version >= 1
        assert subject.horizon >= 1
        assert subject.max_reward > 0.0

    def test_specs(self, case: Case) -> None:
        environment, episodes = played(case)
        (spec,) = environment.observation_spec().values()
        assert spec.shape == (mdp(environment).observation_size,)
        assert spec.dtype == np.float64
        actions = environment.action_spec()
        assert actions.shape == (mdp(environment).action_size,)
        np.testing.assert_array_equal(actions.minimum, -1.0)
        np.testing.assert_array_equal(actions.maximum, 1.0)
        for time_steps in episodes:
            for time_step in time_steps:
                assert time_step.observation.keys() == environment.observation_spec().keys()
                spec.validate(values(time_step))
                assert np.all(np.isfinite(values(time_step)))

    def test_time_passes_as_it_says(self, case: Case) -> None:
        environment = case.load(perturbed=False)
        timestep = mdp(environment).timestep
        assert environment.control_timestep() == pytest.approx(timestep, rel=1e-12)

    def test_episodes(self, case: Case) -> None:
        """A first step, rewards within their bounds, and a last step with discount 0 or 1."""
        environment, episodes = played(case)
        most = mdp(environment).max_reward
        for time_steps in episodes:
            assert time_steps[0].first()
            assert time_steps[0].reward is None
            assert time_steps[-1].last()
            for time_step in time_steps[1:]:
                assert type(time_step.reward) is float
                assert self.least_reward <= time_step.reward <= most
            between = time_steps[1:-1]
            assert all(time_step.mid() and time_step.discount == 1.0 for time_step in between)
            assert time_steps[-1].discount in (0.0, 1.0)

    @pytest.mark.parametrize("action", [-1.0, 0.0, 1.0, None])
    def test_discount_tells_endings_apart(self, case: Case, action: float | None) -> None:
        """The discount is 0 at a terminal state and 1 at the horizon's last step."""
        environment = case.load(seed=3, perturbed=False)
        steady = np.full(mdp(environment).action_size, action or 0.0)
        policy = at_random(environment, 3) if action is None else lambda: steady
        for _ in range(2):
            ending(environment, policy)

    def test_the_same_seed_gives_the_same_episodes(self, case: Case) -> None:
        runs = []
        for _ in range(2):
            environment = case.load(seed=5)
            policy = at_random(environment, 5)
            runs.append([step for _ in range(2) for step in episode(environment, policy)])
        assert len(runs[0]) == len(runs[1])
        for first, second in zip(*runs, strict=True):
            assert (first.step_type, first.reward, first.discount) == (
                second.step_type, second.reward, second.discount,
            )  # fmt: skip
            np.testing.assert_array_equal(values(first), values(second))

    def test_other_seeds_and_episodes_start_elsewhere(self, case: Case) -> None:
        environment = case.load(seed=1)
        starts = [values(environment.reset()) for _ in range(6)]
        starts += [values(case.load(seed=seed).reset()) for seed in (2, 3)]
        distinct = {start.tobytes() for start in starts}
        if case.variant == "planning":
            assert len(distinct) == 1
        else:
            # Some imitation episodes may begin at the task's own start.
            assert len(distinct) >= 6, f"{len(distinct)} of {len(starts)} starts differ, not 6"
        if case.variant is None:
            fixed = [values(case.load(seed=seed, perturbed=False).reset()) for seed in (1, 2)]
            np.testing.assert_array_equal(fixed[0], fixed[1])

    def test_observations_are_not_shared(self, case: Case) -> None:
        """Each observation belongs to the caller, who may change it without effect on the next."""
        environment, untouched = case.load(seed=2), case.load(seed=2)
        policy, same = at_random(environment, 2), at_random(environment, 2)
        seen: list[np.ndarray] = []
        environment.reset(), untouched.reset()
        for _ in range(10):
            time_step, expected = environment.step(policy()), untouched.step(same())
            np.testing.assert_array_equal(values(time_step), values(expected))
            assert time_step.reward == expected.reward
            assert not any(np.shares_memory(values(time_step), other) for other in seen)
            seen.append(values(time_step))
            values(time_step)[:] = np.nan

    def test_no_observation_is_constant(self, case: Case) -> None:
        episodes = played(case)[1]
        observations = np.array([values(step) for time_steps in episodes for step in time_steps])
        still = np.flatnonzero(np.ptp(observations, axis=0) == 0.0).tolist()
        assert not still, f"the same in every state of all episodes: entries {still}"

    def test_actions_are_clipped(self, case: Case) -> None:
        wild, tame = case.load(seed=4), case.load(seed=4)
        wild.reset(), tame.reset()
        rng = np.random.default_rng(0)
        beyond = 0
        for _ in range(15):
            action = rng.uniform(-4.0, 4.0, wild.action_spec().shape)
            beyond += int(np.sum(np.abs(action) > 1.0))
            one, other = wild.step(action), tame.step(np.clip(action, -1.0, 1.0))
            np.testing.assert_array_equal(values(one), values(other))
            assert (one.reward, one.discount) == (other.reward, other.discount)
        assert beyond > 7 * len(action)  # about half of all entries lay outside the box

    def test_the_next_episode_begins_by_itself(self, case: Case) -> None:
        environment = case.load()
        policy = at_random(environment, 1)
        list(episode(environment, policy))
        time_step = environment.step(policy())
        assert time_step.first()
        assert environment.step(policy()).mid()

    def test_batched(self, case: Case) -> None:
        """Shapes and data types of the batched environment of the same case."""
        environment = tsbench.load_batched(
            case.name, case.variant, count=3, reference=case.reference, threads=1, seed=0
        )
        size = environment.mdp.observation_size
        assert environment.reset().shape == (3, size)
        rng = np.random.default_rng(0)
        for _ in range(5):
            transition = environment.step(rng.uniform(-1.0, 1.0, (3, environment.mdp.action_size)))
            assert transition.observation.shape == (3, size)
            assert transition.observation.dtype == np.float64
            assert transition.reward.shape == (3,)
            assert transition.terminal.dtype == transition.truncated.dtype == bool


class TaskContract(Contract):
    """Tests of a task in full physics."""

    variants = (None,)

    def test_it_is_found_by_name(self, name: str) -> None:
        assert name in tasks.names()
        task = tasks.make(name)
        assert task.name == name
        assert task == tasks.make(name)
        assert tasks.standard(task)
        assert fingerprint(task.spec()) == fingerprint(tasks.make(name).spec())
        json.dumps(dict(task.constants()))  # their hash goes into scores

    def test_it_keeps_its_promises(self, name: str) -> None:
        """Attributes, model, and shapes and types of what its functions return."""
        check_promises(name, tasks.make(name))

    def test_changed_constants_are_not_standard(self, name: str) -> None:
        task = tasks.make(name)
        for constant, value in tasks.defaults(name).items():
            if isinstance(value, float) and value:
                changed = tasks.make(name, **{constant: 0.9 * value})
                assert not tasks.standard(changed)
                assert changed != task

    def test_its_configuration_can_be_run(self, name: str) -> None:
        """It has the budget `smoke` and the default budget, and every budget can be prepared."""
        chosen = config.compose([f"task={name}"])
        assert chosen.task.name == name
        assert {"smoke", chosen.budget} <= set(chosen.task.budgets)
        assert chosen.task.constants == {}
        assert schema.budgets(name) == chosen.task.budgets
        for budget in chosen.task.budgets:
            execute.prepare(config.compose([f"task={name}", f"budget={budget}"]))

    def test_it_can_be_pushed(self, name: str) -> None:
        """In directions at right angles; its promises tell where and when."""
        axes = np.array(tasks.make(name).push_plane)
        np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)

    def test_the_best_motion_known(self, name: str) -> None:
        task = tasks.make(name)
        assert 0.0 < best_return(task) <= task.max_reward * task.horizon * (1.0 + 1e-12)

    def test_it_can_be_scored(self, name: str) -> None:
        """Two evaluations of zero actions give the same finite figures."""
        task = tasks.make(name)
        scores = [evaluate(zero(task), task, protocol=SMOKE, threads=1) for _ in range(2)]
        assert scores[0] == scores[1]
        json.dumps(scores[0].as_dict(), allow_nan=False)
        assert scores[0].normalized_reward <= 1.0

    @pytest.mark.parametrize("regime", REGIMES)
    def test_both_simulations_agree_to_the_last_bit(self, name: str, regime: str) -> None:
        """dm_control and the batched simulation, over whole episodes from perturbed starts."""
        task, rng = tasks.make(name), np.random.default_rng(11)
        starts = task.start(rng, 3, perturbed=True)
        compare(task, starts, REGIMES[regime](rng, (task.horizon, 3, task.action_size)))


class PlanningContract(Contract):
    """Tests of a task's planning variant and imitation variant."""

    variants = tsbench.VARIANTS

    def test_the_sizes_are_the_tasks(self, case: Case) -> None:
        subject, task = mdp(case.load()), tasks.make(case.name)
        if case.variant == "planning":  # as long as the task's episodes, in whole planning steps
            left = task.horizon * task.timestep - subject.horizon * subject.timestep
            assert -1e-9 <= left < subject.timestep - 1e-9, f"{left} s without a planning step"
        else:  # same observations, actions and physics
            assert subject.observation_size == task.observation_size
            assert subject.action_size == task.action_size
            assert (subject.timestep, subject.plant) == (task.timestep, task)

    def test_states_can_be_sampled(self, name: str) -> None:
        """Sampled planning states, their observations and coordinates have the right shapes."""
        planning = Planning(tasks.make(name))
        abstraction = planning.abstraction
        state = abstraction.sample(np.random.default_rng(0), 20)
        width = len(abstraction.coordinates)
        for found, size in (
            (planning.observation(state), planning.observation_size),
            (abstraction.flatten(state), width),
            (abstraction.naive(state), planning.action_size),
        ):
            assert found.shape == (20, size)
            assert np.all(np.isfinite(found))
        assert np.all(np.abs(abstraction.naive(state)) <= 1.0)
        assert len(np.unique(abstraction.flatten(state), axis=0)) == 20
        model = planning.task.spec().compile()
        poses = abstraction.poses(abstraction.flatten(abstraction.start(2)))
        assert poses.shape == (2, model.nq)

    def test_the_hand_made_plan_becomes_a_motion(self, name: str, tmp_path: Path) -> None:
        task, plan, reference = tasks.make(name), plan_of(name), reference_of(name)
        assert isinstance(task, Plannable)
        plan.save(tmp_path / "plan.npz")
        reference.save(tmp_path / "reference.npz")
        for motion in (
            Plan.load(tmp_path / "plan.npz"),
            ReferenceMotion.load(tmp_path / "reference.npz"),
        ):
            task.check_fit(motion)
        assert reference.timestep == task.timestep
        assert reference.steps <= task.horizon  # it may go on where the plan has arrived
        assert np.all(np.isfinite(reference.qpos))
        assert task.audit(plan, reference).items
        for form in task.imitation_forms:
            assert Imitation(task, reference, form).horizon >= 1

    def test_a_roadmap_gives_legal_plans(self, name: str) -> None:
        """Where there is a roadmap space, a way through it is followed by legal actions, and the
        plan's states and rewards are those of the planning variant."""
        planning = Planning(tasks.make(name))
        space = planning.abstraction.roadmap_space()
        if space is None:
            with pytest.raises(tsbench.TsbenchError, match=f"the method any cannot do {name}: "):
                roadmap_space(planning.task, "any")
            return
        ends = np.stack([space.start, space.goal])
        assert np.all((space.low <= ends) & (ends <= space.high))
        assert space.free(ends, ends).all()
        assert space.places(ends).shape == (2, 3)
        one_step = space.start + np.diag(space.scale)
        np.testing.assert_allclose(space.steps(space.start, one_step), 1.0)
        points = find_route(space, 500, 16, seed=0).points
        actions: list[np.ndarray] = []
        distance: list[float] = []

        def act(state: Any, step: int) -> np.ndarray:
            actions.append(space.action(state, points[min(step + 1, len(points) - 1)]))
            distance.append(float(planning.task.goal_distance(state)[0]))
            return actions[-1]

        plan = rolled_out(planning.task, act)
        check_replay(planning, plan, actions)
        np.testing.assert_array_equal(plan_along(planning.task, space, points).states, plan.states)
        assert distance[-1] < 0.2 * distance[0]

    def test_a_lattice_gives_legal_plans(self, name: str) -> None:
        """Where there is a lattice, any moves from its start are legal actions, and their rewards
        are those that it says."""
        planning = Planning(tasks.make(name))
        lattice = planning.abstraction.lattice()
        if lattice is None:
            return
        moves = [lattice.moves(layer) for layer in range(lattice.layers)]
        worth = [lattice.worth(layer) for layer in range(lattice.layers)]
        rng, node, growth = np.random.default_rng(0), np.array(lattice.start), 1.0
        actions, rewards = [], []
        for step in range(2 * lattice.layers):
            layer = step % lattice.layers
            inside = [
                move
                for move in moves[layer]
                if np.all((node + move.shift >= 0) & (node + move.shift < lattice.shape))
            ]
            move = inside[rng.integers(len(inside))]
            node = node + move.shift
            following = worth[(layer + 1) % lattice.layers]
            rewards.append(growth * move.reward * following[tuple(node)])
            growth *= move.growth
            actions.append(move.action[None])
        taken = iter(actions)
        idle = np.zeros((1, planning.action_size))
        plan = rolled_out(planning.task, lambda *_: next(taken, idle))
        check_replay(planning, plan, actions)
        np.testing.assert_allclose(plan.rewards[: len(rewards)], rewards, rtol=1e-6)

    @pytest.mark.parametrize("regime", ["uniform", "small"])
    def test_both_simulations_of_the_imitation_agree(self, name: str, regime: str) -> None:
        task, rng = Imitation(tasks.make(name), reference_of(name)), np.random.default_rng(5)
        starts = task.start(rng, 3)
        compare(task, starts, REGIMES[regime](rng, (task.horizon, 3, task.action_size)))


def check_replay(planning: Planning[Any], plan: Plan, actions: Sequence[np.ndarray]) -> None:
    """The actions are legal, and lead to the plan's states and rewards again."""
    assert np.abs(np.concatenate(actions)).max() <= 1.0 + 1e-9
    abstraction = planning.abstraction
    state = abstraction.start(1)
    np.testing.assert_array_equal(plan.states[0], abstraction.flatten(state)[0])
    for action, coordinates, reward in zip(actions, plan.states[1:], plan.rewards, strict=False):
        before, state = state, abstraction.advance(state, np.clip(action, -1.0, 1.0))
        np.testing.assert_allclose(coordinates, abstraction.flatten(state)[0], atol=1e-9)
        assert reward == pytest.approx(float(planning.reward(before, action, state)[0]), abs=1e-9)


@dataclass
class Desk:
    """A workspace that records what a method reports.

    Attributes:
        directory: the folder for the method's files.
        stages: name and budget of each stage.
        reports: the steps at each report, by stage.
        substeps: physics substeps, by stage.
        notes: the lines for the user.
    """

    directory: Path
    stages: list[tuple[str, int]] = field(default_factory=list)
    reports: dict[str, list[int]] = field(default_factory=dict)
    substeps: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str, steps: int) -> Iterator[Any]:
        self.stages.append((name, steps))
        monitor = Scribe(self.reports.setdefault(name, []))
        yield monitor
        self.substeps[name] = monitor.physics_substeps

    def note(self, line: str) -> None:
        self.notes.append(line)


@dataclass
class Scribe:
    """The monitor of a `Desk`."""

    steps: list[int]
    physics_substeps: int = 0
    warnings: dict[str, int] = field(default_factory=dict)
    saved: Snapshot | None = None

    def update(
        self,
        steps: int,
        metrics: Mapping[str, float],
        snapshot: Callable[[], Snapshot] | None = None,
    ) -> None:
        assert all(np.isfinite(value) for value in metrics.values())
        self.steps.append(steps)


def bits(policy: Policy) -> bytes:
    """The bytes of all arrays that a policy's actions depend on."""
    arrays = (policy.mean, policy.scale, *policy.weights, *policy.biases)
    return b"".join(array.tobytes() for array in arrays)


def required(item: Field[Any]) -> bool:
    """Whether a field of a dataclass has no default."""
    return item.default is MISSING and item.default_factory is MISSING


class MethodContract:
    """Tests of a method.

    Attributes:
        names: the methods to test.
        task: the task that they train on.
        constants: changed constants of that task.
        budget: the budget that they get.
        training: changes to the PPO settings, by kind of stage.
    """

    names: ClassVar[Sequence[str]] = ()
    task: ClassVar[str]
    constants: ClassVar[Mapping[str, Any]] = {}
    budget: ClassVar[Budget] = Budget(192, 128, 8, audit="warn")
    training: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        kind: {"rollout": 8, "epochs": 1, "minibatches": 2, "hidden": [16]}
        for kind in ("plan", "imitate", "task", "finetune")
    }

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Runs each test for each method."""
        if "name" in metafunc.fixturenames:
            metafunc.parametrize("name", self.names)

    def problem(self, seed: int, **options: Any) -> Problem:
        """The problem to train on, which takes a second or two."""
        task = tasks.make(self.task, **self.constants)
        return Problem(task, self.budget, self.training, options, seed, threads=1)

    def test_it_says_what_it_is(self, name: str) -> None:
        assert name in methods.names()
        summary = methods.summary(name)
        assert 20 < len(summary) < 100
        assert "\n" not in summary

    def test_its_options_are_in_its_configuration(self, name: str) -> None:
        """`key=value` words and `--cfg job` find a method's options in its configuration file."""
        options = methods.find(name).Options
        without = [item.name for item in fields(options) if required(item)]
        assert not without, f"fields of Options without a default: {without}"
        chosen = config.compose([f"task={self.task}", f"method={name}"]).method
        assert chosen == {**vars(options()), "name": name}

    def test_unknown_options_are_refused(self, name: str, tmp_path: Path) -> None:
        with pytest.raises(tsbench.TsbenchError, match="unknown key in method 'no_such_option'"):
            methods.find(name).train(self.problem(0, no_such_option=1), Desk(tmp_path))

    def test_its_policy_fits_and_repeats(self, name: str, tmp_path: Path) -> None:
        """One seed gives one policy, to the bit and after saving and loading. All stages together
        exceed the budget by no more than a rollout of each."""
        policies = []
        for attempt in ("first", "second"):
            desk, given = Desk(tmp_path / attempt), self.problem(1, name=name)
            desk.directory.mkdir()
            policy = methods.find(name).train(given, desk)
            check_fit(policy, given.task)
            assert policy.info.method == name
            policy.save(desk.directory)
            policies += [bits(policy), bits(Policy.load(desk.directory))]
            spent = sum(steps[-1] for steps in desk.reports.values() if steps)
            assert spent <= self.budget.plan + self.budget.act + 64 * len(desk.reports)
        assert len(set(policies)) == 1
