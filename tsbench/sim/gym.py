"""Tasks and their variants as Gymnasium environments, one at a time or many at once.

Both classes wrap the environments that tsbench itself uses, and return the same floats.
Some tasks end an episode when the robot arrives at the goal. The score credits the remaining steps,
which the arrival spares. When an episode ends, `info["spared"]` gives their number, and
`info["quality"]` what each is worth beside a perfect step. A learner that ignores them treats an
arrival like a fall, and earns more by hovering just outside the goal; one that adds
`MDP.credit(spared, quality, discount)` to the last reward learns by the score's own rule.
Random starts are drawn from `np_random`, which is the generator of the wrapped environment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from dm_control.rl.control import FLAT_OBSERVATION_KEY
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tsbench.core.errors import TsbenchError, quoted, unknown
from tsbench.core.state import Rng
from tsbench.core.task import MDP
from tsbench.sim.batched import BatchedEnvironment
from tsbench.sim.dynamics import as_action
from tsbench.sim.kinematic import Planning
from tsbench.sim.single import Environment, TaskPhysics, environment

# Gymnasium's wrappers make "human" and "rgb_array_list" of it: `gymnasium.make` adds them.
RENDER_MODES = ("rgb_array",)
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES)}
HEIGHT, WIDTH = 480, 640  # pixels


def spaces(mdp: MDP[Any]) -> tuple[Box, Box]:
    """The spaces of observations (any float64) and of actions (the box [-1, 1]).

    The action space is float32, which learners expect. Environments take float64 actions too.
    """
    observation = Box(-np.inf, np.inf, (mdp.observation_size,), np.float64)
    return observation, Box(-1.0, 1.0, (mdp.action_size,), np.float32)


def picture(physics: TaskPhysics) -> np.ndarray:
    """What the model's first camera sees, shape (480, 640, 3), bytes."""
    pixels: np.ndarray = physics.render(HEIGHT, WIDTH, camera_id=0)
    return pixels


class GymEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """A dm_control environment of tsbench as a `gymnasium.Env`.

    `truncated` means that the episode ended at its last step, `terminated` that it ended for
    another reason. At the end `info["spared"]` counts the steps that an arrival at the goal spares,
    and `info["quality"]` says what each is worth. After `reset(seed=seed)` the episodes are those
    of `tsbench.load(..., seed=seed)`.

    Attributes:
        single: the wrapped dm_control environment.
    """

    metadata = METADATA

    def __init__(self, single: Environment, render_mode: str | None = None) -> None:
        """
        Args:
            single: the environment to wrap.
            render_mode: "rgb_array" lets `render` draw pictures; None does not.

        Raises:
            TsbenchError: the render mode is unknown.
        """
        _expect_render_mode(render_mode)
        self.single = single
        self.render_mode = render_mode
        self.metadata = _metadata(single.task.mdp)
        self.observation_space, self.action_space = spaces(single.task.mdp)
        self._np_random_seed = -1  # Gymnasium's word for: not known here

    @property
    def _np_random(self) -> Rng:
        """Where Gymnasium keeps its generator: here it is the task's, its only one."""
        rng: Rng = self.single.task.rng
        return rng

    @_np_random.setter
    def _np_random(self, rng: Rng) -> None:
        self.single.task.rng = rng

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Raises:
            TsbenchError: `options` were given; none is supported.
        """
        _expect_options(options)
        super().reset(seed=seed)
        return self.single.reset().observation[FLAT_OBSERVATION_KEY], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One time step.

        Raises:
            TsbenchError: the action is refused, or no episode has begun since the last one ended.
                Nothing has changed.
        """
        if self.single.over:
            raise TsbenchError(
                "call reset() first: no episode has begun, or the last one has ended"
            )
        time_step = self.single.step(action)
        terminated = time_step.last() and time_step.discount == 0.0
        truncated = time_step.last() and not terminated
        observation = time_step.observation[FLAT_OBSERVATION_KEY]
        info: dict[str, Any] = {}
        if time_step.last():
            info = {"spared": self.single.task.spared(), "quality": self.single.task.quality()}
        return observation, time_step.reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The picture of the model's first camera, shape (480, 640, 3); None without a mode."""
        return None if self.render_mode is None else picture(self.single.physics)

    def close(self) -> None:
        self.single.close()


class GymVectorEnvironment(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A batched environment as a `gymnasium.vector.VectorEnv`.

    What `step` does where an episode ends is the autoreset mode, as in Gymnasium's SyncVectorEnv:

    - next step: it returns the last observation. The next step ignores the action there, begins the
      next episode, and returns its first observation and a reward of zero.
    - same step: it returns the first observation of the next episode. `infos["final_obs"]` holds
      the last one of the ended episode, in an array of objects with None where no episode ended,
      and `infos["final_info"]` its info.
    - disabled: it returns the last observation, and `reset(options={"reset_mask": rows})` begins
      the next episode.

    Attributes:
        batched: the wrapped batched environment.
        autoreset_mode: one of the above.
        max_episode_steps: the most steps in an episode. Longer ones are truncated.
    """

    def __init__(
        self,
        batched: BatchedEnvironment[Any],
        render_mode: str | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
    ) -> None:
        """
        Args:
            batched: the environment to wrap.
            render_mode: "rgb_array" lets `render` draw pictures; None does not.
            autoreset_mode: a member of `AutoresetMode`, or its value, such as "SameStep".
            max_episode_steps: None for the task's own horizon.

        Raises:
            TsbenchError: a mode is unknown, or `max_episode_steps` is not positive.
        """
        _expect_render_mode(render_mode)
        modes = {mode.value: mode for mode in AutoresetMode}
        if autoreset_mode not in modes and not isinstance(autoreset_mode, AutoresetMode):
            raise unknown("autoreset mode", str(autoreset_mode), modes)
        if max_episode_steps is not None and max_episode_steps < 1:
            raise TsbenchError(f"max_episode_steps must be at least 1, not {max_episode_steps}")
        self.batched = batched
        self.num_envs = batched.count
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.max_episode_steps = max_episode_steps
        self.metadata = {**_metadata(batched.mdp), "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = spaces(batched.mdp)
        self.observation_space = batch_space(self.single_observation_space, batched.count)
        self.action_space = batch_space(self.single_action_space, batched.count)
        self._np_random_seed = -1  # Gymnasium's word for: not known here
        self._length = np.zeros(batched.count, int)  # steps of each episode so far
        self._over = np.ones(batched.count, bool)  # no episode goes on
        self._physics: TaskPhysics | None = None  # for pictures

    @property
    def _np_random(self) -> Any:
        """Where Gymnasium keeps its generator: here it is that of the batched environment, or a
        list of one for each environment."""
        return self.batched.rng

    @_np_random.setter
    def _np_random(self, rng: Any) -> None:
        self.batched.rng = rng

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: determines all starts, or is a list of one for each environment, whose episodes
                are then those of a `GymEnvironment` reset with it.
            options: `reset_mask`, shape (num_envs,): the environments to start, by default all.

        Raises:
            TsbenchError: the seeds or options are refused. Nothing has changed.
        """
        mask = np.ones(self.num_envs, bool)
        if options and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
                raise TsbenchError(
                    f"reset_mask must be an array of {self.num_envs} truth values, at least one of "
                    f"them true, not {quoted(options['reset_mask'])}"
                )
        _expect_options(options, "reset_mask")
        if isinstance(seed, Sequence):
            self._seed_each(seed, mask)
        else:
            super().reset(seed=seed)
        if mask.all():
            observation = self.batched.reset()
        else:
            self.batched.begin(np.flatnonzero(mask))
            observation = self.batched.observation()
        self._length[mask], self._over[mask] = 0, False
        return observation.copy(), {}

    def _seed_each(self, seeds: Sequence[int | None], mask: np.ndarray) -> None:
        """One generator for each environment. Those that are not reset, or whose seed is None, keep
        theirs if they had one of their own."""
        if len(seeds) != self.num_envs:
            raise TsbenchError(
                f"a list of seeds must have one for each of the {self.num_envs} environments, "
                f"not {len(seeds)}"
            )
        made = [seeding.np_random(seed) for seed in seeds]
        old = self.batched.rng if isinstance(self.batched.rng, list) else [None] * self.num_envs
        fresh = [bool(reset and seed is not None) for reset, seed in zip(mask, seeds, strict=True)]
        self._np_random = [
            rng if anew or kept is None else kept
            for (rng, _), kept, anew in zip(made, old, fresh, strict=True)
        ]
        self._np_random_seed = -1

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One time step of all environments.

        Raises:
            TsbenchError: the actions are refused, or no episode goes on in an environment that does
                not begin one by itself. Nothing has changed.
        """
        actions = as_action(actions, (self.num_envs, self.batched.mdp.action_size))
        waiting = np.flatnonzero(self._over)
        if len(waiting) and self.autoreset_mode is not AutoresetMode.NEXT_STEP:
            raise TsbenchError(
                f"call reset() first: no episode goes on in environment {waiting[0]}"
            )
        going = np.flatnonzero(~self._over)
        reward = np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), bool)
        infos: dict[str, Any] = {}
        if len(going):
            transition = self.batched.advance(actions, going if len(waiting) else None)
            reward, terminated, truncated = (
                transition.reward,
                transition.terminal,
                transition.truncated,
            )
            infos = self._info(terminated | truncated, transition.spared, transition.quality)
            self._length[going] += 1
            if self.max_episode_steps is not None:
                truncated |= ~terminated & (self._length >= self.max_episode_steps) & ~self._over
        if len(waiting):
            self.batched.begin(waiting)
        self._over = terminated | truncated
        self._length[waiting] = 0
        observation = self.batched.observation()
        ended = np.flatnonzero(self._over)
        if len(ended) and self.autoreset_mode is AutoresetMode.SAME_STEP:
            final = np.full(self.num_envs, None, object)
            for row in ended:
                final[row] = observation[row].copy()
            infos = {
                "final_obs": final,
                "_final_obs": self._over.copy(),
                "final_info": infos,
                "_final_info": self._over.copy(),
            }
            self.batched.begin(ended)
            self._length[ended] = 0
            self._over = np.zeros(self.num_envs, bool)
            observation = self.batched.observation()
        return observation.copy(), reward, terminated, truncated, infos

    def _info(self, ended: np.ndarray, *values: np.ndarray) -> dict[str, Any]:
        """What `GymEnvironment.step` says of ended episodes, each value with a mask of its rows."""
        if not ended.any():
            return {}
        named = dict(zip(("spared", "quality"), values, strict=True))
        return {**named, **{f"_{name}": ended.copy() for name in named}}

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The picture of each environment, shape (480, 640, 3); None without a mode.

        Raises:
            TsbenchError: no episode has begun.
        """
        if self.render_mode is None:
            return None
        self.batched.expect_ready()
        mdp: Any = self.batched.mdp
        if self._physics is None:
            self._physics = environment(mdp).physics
        if isinstance(mdp, Planning):
            poses = mdp.abstraction.poses(mdp.abstraction.flatten(self.batched.state))
        else:
            dynamics: Any = self.batched.dynamics
            poses, _ = dynamics.pose()
        pictures = []
        for pose in poses:
            self._physics.data.qpos[:] = pose
            self._physics.forward()
            pictures.append(picture(self._physics))
        return tuple(pictures)


def _metadata(mdp: MDP[Any]) -> dict[str, Any]:
    return {**METADATA, "render_fps": round(1.0 / mdp.timestep)}


def _expect_render_mode(mode: str | None) -> None:
    if mode not in (None, *RENDER_MODES):
        raise unknown("render mode", str(mode), RENDER_MODES)


def _expect_options(options: Mapping[str, Any] | None, *allowed: str) -> None:
    for name in options or {}:
        if name not in allowed:
            raise unknown("option of reset", str(name), allowed)
