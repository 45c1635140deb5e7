"""Tasks and their variants as Gymnasium environments, one at a time or many at once.

Both classes wrap the environments that tsbench itself uses, and return the same floats.
Some tasks end an episode when the robot arrives at the goal. The score credits the remaining steps,
which the arrival spares. When an episode ends, `info["spared"]` gives their number, and
`info["quality"]` what each is worth beside a perfect step. A learner that ignores them treats an
arrival like a fall, and earns more by hovering just outside the goal; one that adds
`MDP.credit(spared, quality, discount)` to the last reward learns by the score's own rule.
Random starts are drawn from `np_random`.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from dm_control.rl.control import FLAT_OBSERVATION_KEY, Environment
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tsbench.core.errors import TsbenchError, unknown
from tsbench.core.task import MDP
from tsbench.sim.batched import BatchedEnvironment

RENDER_MODES = ("rgb_array",)
HEIGHT, WIDTH = 480, 640  # pixels


def spaces(mdp: MDP[Any]) -> tuple[Box, Box]:
    """The spaces of observations (any float64) and of actions (the box [-1, 1]).

    The action space is float32, which learners expect. Environments take float64 actions too.
    """
    observation = Box(-np.inf, np.inf, (mdp.observation_size,), np.float64)
    return observation, Box(-1.0, 1.0, (mdp.action_size,), np.float32)


class GymEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """A dm_control environment of tsbench as a `gymnasium.Env`.

    `truncated` means that the episode ended at its last step, `terminated` that it ended for
    another reason. At the end `info["spared"]` counts the steps that an arrival at the goal spares,
    and `info["quality"]` says what each is worth. After `reset(seed=seed)` the episodes are those
    of `tsbench.load(..., seed=seed)`.

    Attributes:
        single: the wrapped dm_control environment.
    """

    def __init__(self, single: Environment, render_mode: str | None = None) -> None:
        """
        Args:
            single: the environment to wrap.
            render_mode: "rgb_array" lets `render` draw pictures; None does not.

        Raises:
            TsbenchError: the render mode is unknown.
        """
        if render_mode not in (None, *RENDER_MODES):
            raise unknown("render mode", str(render_mode), RENDER_MODES)
        self.single = single
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": list(RENDER_MODES),
            "render_fps": round(1.0 / single.task.mdp.timestep),
        }
        self.observation_space, self.action_space = spaces(single.task.mdp)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.single.task.rng = self.np_random
        return self.single.reset().observation[FLAT_OBSERVATION_KEY], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
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
        if self.render_mode is None:
            return None
        picture: np.ndarray = self.single.physics.render(HEIGHT, WIDTH, camera_id=0)
        return picture

    def close(self) -> None:
        self.single.close()


class GymVectorEnvironment(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A batched environment as a `gymnasium.vector.VectorEnv`.

    Its autoreset mode is *same step*: where an episode ends, `step` returns the first observation
    of the next episode. `infos["final_obs"]` holds the last observation of the ended one, in an
    array of objects with None where no episode ended; `infos["_final_obs"]` marks the ended ones.

    Attributes:
        batched: the wrapped batched environment.
    """

    def __init__(self, batched: BatchedEnvironment[Any]) -> None:
        self.batched = batched
        self.num_envs = batched.count
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space, self.single_action_space = spaces(batched.mdp)
        self.observation_space = batch_space(self.single_observation_space, batched.count)
        self.action_space = batch_space(self.single_action_space, batched.count)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts all episodes; one seed determines them all.

        Raises:
            TsbenchError: `options` were given; none is supported.
        """
        if options:
            raise TsbenchError(f"reset takes no options, not {', '.join(options)}")
        super().reset(seed=seed)
        self.batched.rng = self.np_random
        return self.batched.reset(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        transition = self.batched.step(np.asarray(actions, np.float64))
        infos: dict[str, Any] = {}
        if len(transition.ended):
            final = np.full(self.num_envs, None, object)
            for row, observation in zip(
                transition.ended, self.batched.mdp.observation(transition.final), strict=True
            ):
                final[row] = observation
            ended = transition.terminal | transition.truncated
            infos = {"final_obs": final, "_final_obs": ended}
            arrivals = {"spared": transition.spared, "quality": transition.quality}
            final_info = {**arrivals, **{f"_{name}": ended.copy() for name in arrivals}}
            infos |= {"final_info": final_info, "_final_info": ended.copy()}
        return (
            transition.observation,
            transition.reward,
            transition.terminal,
            transition.truncated,
            infos,
        )
