"""Stable-Baselines3's PPO, which the paper used, against tsbench's PPO: time to the same score.

tsbench trains in two stages with budget=fast, to the end. Stable-Baselines3 then imitates the same
reference motion, until its deterministic policy reaches tsbench's score from the task's own start.
Two points favour Stable-Baselines3: it stops as soon as it reaches the score, and its plan costs no
time. Both use the same networks, environments, rollout length, held actions, epochs, minibatches,
discounts, clipping, entropy, initial standard deviation and falling learning rate. Observations are
encoded alike; VecNormalize normalises those of Stable-Baselines3. Stable-Baselines3 has no bound
for the standard deviation. Where tsbench adapts the learning rate to a KL divergence,
Stable-Baselines3 keeps its default of 3e-4. Its environments are those of `tsbench.sim.gym` in one
process, its default, which is faster on two cores than one process each (the `loop` and `async`
figures). Torch has one thread in both. The time to score policies is not counted.
"""

from __future__ import annotations

import importlib
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import TransformObservation
from rich.console import Console

from tsbench import methods
from tsbench.bench import Findings, comparison
from tsbench.bench.turns import Effort, Range
from tsbench.core.method import Problem
from tsbench.core.motion import ReferenceMotion
from tsbench.core.policy import ENCODINGS
from tsbench.core.task import Task
from tsbench.rl.settings import PPOSettings
from tsbench.rl.stages import settings
from tsbench.rl.threads import one_thread
from tsbench.runs.config import compose
from tsbench.runs.directory import RunDirectory
from tsbench.runs.execute import prepare
from tsbench.runs.workspace import RunWorkspace
from tsbench.sim.episodes import PolicyFunction, play
from tsbench.sim.gym import GymEnvironment
from tsbench.sim.physics import Physics
from tsbench.sim.single import environment
from tsbench.sim.tracking import Imitation

LEARNING_RATE = 3e-4  # Stable-Baselines3's own
PATIENCE = 6.0  # times tsbench's time, after which Stable-Baselines3 is stopped
MODULES = {"elu": "ELU", "relu": "ReLU", "tanh": "Tanh"}  # activations in torch.nn
CHECKS = 40  # scores of its policy within tsbench's number of steps


@comparison("sb3", requires=("stable_baselines3",), named=True)
def rocket(effort: Effort) -> Findings:
    return compare("rocket_navigation", effort)


@comparison("sb3_laikago", requires=("stable_baselines3",), named=True)
def laikago(effort: Effort) -> Findings:
    return compare("laikago_trot", effort)


@dataclass(frozen=True)
class Outcome:
    """The outcome of a training.

    Attributes:
        score: normalized reward of the deterministic policy from the task's own start.
        solved: whether that episode counts as a success.
        seconds: wall-clock time of the imitation stage.
        steps: environment steps of the imitation stage.
    """

    score: float
    solved: bool
    seconds: float
    steps: int

    def __str__(self) -> str:
        return (
            f"normalized reward {self.score:.4g}, {'solved' if self.solved else 'not solved'}, "
            f"{self.steps:,} steps in {self.seconds:.0f} s"
        )


@one_thread()
def compare(name: str, effort: Effort) -> Findings:
    problem = prepare(compose([f"task={name}", f"budget={effort.budget}"]))
    with tempfile.TemporaryDirectory() as folder:
        ours = train(problem, Path(folder))
        reference = ReferenceMotion.load(RunDirectory(Path(folder)).reference_file)
    imitation = Imitation(problem.task, reference)
    theirs = Rival(imitation, settings(problem, "imitate"), problem.seed, ours.steps)
    outcome = theirs.learn(ours, judge(problem.task))
    arrived = "" if outcome.score >= ours.score else " (at least: it did not get there)"
    ratio = outcome.seconds / ours.seconds
    speed = (ours.steps / ours.seconds) / (outcome.steps / outcome.seconds)
    return Findings(
        figures={
            f"{name}.ours": Range.of([ours.seconds], "s"),
            f"{name}.sb3": Range.of([outcome.seconds], "s"),
        },
        ratios={
            f"{name}.sb3/ours": Range.of([ratio]),
            f"{name}.ours/sb3.steps_per_second": Range.of([speed]),
        },
        notes=[
            f"{name}: ours: {ours}",
            f"{name}: Stable-Baselines3: {outcome}; {ratio:.3g} times as long{arrived}",
        ],
    )


Judge = Callable[[PolicyFunction], tuple[float, bool]]


def judge(task: Task[Any]) -> Judge:
    """A function that scores a policy by one episode from the task's own start: its normalized
    reward, and whether it solved the task."""

    def score(policy: PolicyFunction) -> tuple[float, bool]:
        episode = play(task, Physics(task, 1), policy, 1, seed=0)
        solved = task.success(episode.final, episode.course)
        return float(episode.normalized[0]), bool(solved[0])

    return score


def train(problem: Problem, folder: Path) -> Outcome:
    """Trains tsbench's two stages, and leaves the reference motion in the folder."""
    workspace = RunWorkspace(folder, Console(quiet=True))
    policy = methods.find("twostage").train(problem, workspace)
    workspace.close()
    imitate = workspace.stages[-1]
    return Outcome(*judge(problem.task)(policy), imitate.seconds, imitate.steps)


class Held(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Holds every action for `repeat` steps, or until the episode ends.

    As in `rl.vec_env`, the reward is the sum of the steps' rewards divided by `repeat`.
    """

    def __init__(self, environment: gymnasium.Env[np.ndarray, np.ndarray], repeat: int) -> None:
        super().__init__(environment)
        self.repeat = repeat

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        total = 0.0
        for _ in range(self.repeat):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return observation, total / self.repeat, terminated, truncated, info


class Rival:
    """Stable-Baselines3's PPO in an imitation variant.

    Attributes:
        model: Stable-Baselines3's learner.
    """

    def __init__(
        self, imitation: Imitation[Any], chosen: PPOSettings, seed: int, steps: int
    ) -> None:
        """
        Args:
            imitation: the imitation variant to learn.
            chosen: tsbench's settings.
            seed: seed of the training.
            steps: environment steps over which the learning rate falls.
        """
        # The package is optional, so it is imported when it is needed.
        vectors: Any = importlib.import_module("stable_baselines3.common.vec_env")
        torch_nn: Any = importlib.import_module("torch.nn")
        self._encode = ENCODINGS[chosen.encoding]
        self._repeat = chosen.repeat

        def make() -> gymnasium.Env[Any, Any]:
            plain = Held(GymEnvironment(environment(imitation)), chosen.repeat)
            return TransformObservation(plain, self._encode, plain.observation_space)

        def rate(_: float) -> float:
            if chosen.desired_kl is not None:
                return LEARNING_RATE
            final = chosen.final_learning_rate or chosen.learning_rate
            share = min(self.steps / steps, 1.0)
            return float(chosen.learning_rate * (final / chosen.learning_rate) ** share)

        environments = [make] * chosen.environments
        self._vector = vectors.VecNormalize(vectors.DummyVecEnv(environments), norm_reward=False)
        self.model = importlib.import_module("stable_baselines3").PPO(
            "MlpPolicy",
            self._vector,
            learning_rate=chosen.learning_rate,
            n_steps=chosen.rollout,
            batch_size=chosen.environments * chosen.rollout // chosen.minibatches,
            n_epochs=chosen.epochs,
            gamma=chosen.discount**chosen.repeat,
            gae_lambda=chosen.gae_lambda,
            clip_range=chosen.clip,
            ent_coef=chosen.entropy,
            vf_coef=chosen.value_weight,
            max_grad_norm=chosen.gradient_norm,
            policy_kwargs={
                "net_arch": list(chosen.hidden),
                "activation_fn": getattr(torch_nn, MODULES[chosen.activation]),
                "log_std_init": math.log(chosen.initial_std),
            },
            seed=seed,
            device="cpu",
        )
        self.model.lr_schedule = rate
        # Its default logger would leave an empty folder in the system's temporary folder.
        logging: Any = importlib.import_module("stable_baselines3.common.logger")
        self.model.set_logger(logging.Logger(folder=None, output_formats=[]))

    @property
    def steps(self) -> int:
        """Environment steps so far. Stable-Baselines3 counts actions, and each counts as `repeat`
        steps here, even where the episode ended within it."""
        return int(self.model.num_timesteps) * self._repeat

    def learn(self, ours: Outcome, score: Judge) -> Outcome:
        """Trains until it reaches tsbench's score or has taken `PATIENCE` times as long."""
        seconds = 0.0
        while True:
            began = time.perf_counter()
            self.model.learn(ours.steps // CHECKS // self._repeat, reset_num_timesteps=False)
            seconds += time.perf_counter() - began
            reached, solved = score(self)
            if reached >= ours.score or seconds > PATIENCE * ours.seconds:
                self._vector.close()
                return Outcome(reached, solved, seconds, self.steps)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        normalised = self._vector.normalize_obs(self._encode(observation))
        action: np.ndarray = self.model.predict(normalised, deterministic=True)[0]
        return action
