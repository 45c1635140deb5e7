"""Tasks under Gymnasium's names, among its own wrappers, and as Stable-Baselines3 uses them."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from gymnasium import wrappers
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector
from stable_baselines3 import PPO
from stable_baselines3.common import env_checker
from stable_baselines3.common.env_util import make_vec_env

import tsbench
import tsbench.gym
from tsbench import TsbenchError, tasks
from tsbench.testing.episodes import values

ROCKET = tsbench.gym.identifier("rocket_navigation")
LAIKAGO = tsbench.gym.identifier("laikago_walk")
MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]

identifiers = pytest.mark.parametrize("name", tasks.names())


@identifiers
def test_every_task_has_a_name(name: str) -> None:
    one = gymnasium.make(f"tsbench/{name}-v{tasks.make(name).version}")
    assert isinstance(one.unwrapped, tsbench.gym.GymEnvironment)
    observation, _ = one.reset(seed=0)
    single = tsbench.load(name, seed=0)
    assert observation.tobytes() == next(iter(single.reset().observation.values())).tobytes()
    many = gymnasium.make_vec(tsbench.gym.identifier(name), num_envs=2, threads=1)
    assert isinstance(many.unwrapped, tsbench.gym.GymVectorEnvironment)
    assert many.num_envs == 2
    np.testing.assert_array_equal(many.reset(seed=0)[0], np.tile(observation, (2, 1)))


@identifiers
def test_gymnasium_finds_no_fault(name: str) -> None:
    """Its checker renders in every mode that the environment names."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Positions and velocities are unbounded.
        warnings.filterwarnings("ignore", message=".*A Box observation space .* value is -?inf")
        check_env(gymnasium.make(tsbench.gym.identifier(name)).unwrapped)


@identifiers
def test_the_registration_keeps_what_the_object_keeps(name: str) -> None:
    identifier, task = tsbench.gym.identifier(name), tasks.make(name)
    registered = gymnasium.spec(identifier)
    assert registered.max_episode_steps == task.horizon
    assert not registered.nondeterministic
    made = gymnasium.make(registered, perturbed=True, render_mode="rgb_array")
    assert made.spec is not None
    assert made.spec.max_episode_steps == task.horizon
    assert made.spec.kwargs["perturbed"] is True
    assert made.render_mode == "rgb_array"
    assert made.metadata == {"render_modes": ["rgb_array"], "render_fps": round(1 / task.timestep)}
    again = gymnasium.make(EnvSpec.from_json(made.spec.to_json()))
    assert again.spec is not None
    assert made.spec is not None
    assert json.loads(again.spec.to_json()) == json.loads(made.spec.to_json())
    assert again.reset(seed=3)[0].tobytes() == made.reset(seed=3)[0].tobytes()
    many = gymnasium.make_vec(identifier, num_envs=2, render_mode="rgb_array", threads=1)
    assert many.spec is not None
    assert many.spec.max_episode_steps == task.horizon
    assert many.render_mode == "rgb_array"
    assert many.metadata["render_fps"] == made.metadata["render_fps"]


def test_the_module_may_stand_in_the_name() -> None:
    program = (
        "import gymnasium\n"
        "print(gymnasium.make('tsbench.gym:tsbench/rocket_navigation-v1').reset()[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "(10,)\n"


def test_arguments_are_those_of_load() -> None:
    planning = gymnasium.make(ROCKET, variant="planning", distance=3.0)
    assert planning.action_space.shape == (3,)
    assert isinstance(planning.unwrapped, tsbench.gym.GymEnvironment)
    assert planning.unwrapped.single.task.mdp.horizon == 15
    with pytest.raises(TsbenchError, match="did you mean 'distance'"):
        gymnasium.make(ROCKET, distence=3.0)
    with pytest.raises(TsbenchError, match="did you mean 'distance'"):
        gymnasium.make_vec(ROCKET, distence=3.0)
    with pytest.raises(TsbenchError, match="did you mean 'rocket_navigation'"):
        tsbench.gym.identifier("rocket_navigatoin")


# Episodes are as long as the task says, or shorter.


def length(environment: Any) -> int:
    """Steps until the rocket, which hovers, is truncated."""
    environment.reset(seed=0)
    for step in range(1, 2000):
        _, _, terminated, truncated, _ = environment.step(np.array([0.5 * (step % 2), 0.0]))
        assert not terminated
        if truncated:
            return step
    raise AssertionError("no end")


def test_max_episode_steps() -> None:
    """The horizon to a goal 3 m away is 39 steps."""
    assert length(gymnasium.make(ROCKET, distance=3.0)) == 39
    assert length(gymnasium.make(ROCKET, distance=3.0, max_episode_steps=12)) == 12
    assert length(gymnasium.make(ROCKET, distance=3.0, max_episode_steps=-1)) == 39
    many = gymnasium.make_vec(ROCKET, num_envs=2, distance=3.0, max_episode_steps=12, threads=1)
    many.reset(seed=0)
    for step in range(1, 40):
        *_, truncated, _ = many.step(np.tile([0.5 * (step % 2), 0.0], (2, 1)))
        assert truncated.tolist() == [step % 13 == 12] * 2  # and the next step resets
    with pytest.raises(TsbenchError, match="max_episode_steps must be at least 1, not 0"):
        gymnasium.make_vec(ROCKET, num_envs=2, max_episode_steps=0)


def test_steps_that_nothing_allows() -> None:
    """Also through Gymnasium's own wrappers."""
    environment = gymnasium.make(ROCKET, distance=3.0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(np.zeros(2))
    assert length(environment) == 39
    with pytest.raises(TsbenchError, match=r"call reset\(\) first: .* the last one has ended"):
        environment.step(np.zeros(2))
    with pytest.raises(TsbenchError, match=r"call reset\(\) first"):
        gymnasium.make_vec(ROCKET, num_envs=2).step(np.zeros((2, 2)))


def test_gymnasium_does_not_cut_longer_episodes_in_silence() -> None:
    """Its time limit stands in the registration, and would end them at the standard horizon."""
    horizon = tasks.make("rocket_navigation").horizon
    message = f"gymnasium would cut the episodes of .* steps at {horizon}; tsbench.gym.make"
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(TsbenchError, match=message):
            make(ROCKET, distance=90.0)
    whole = tsbench.gym.make("rocket_navigation", distance=90.0)
    assert whole.single.task.mdp.horizon > horizon
    assert tsbench.gym.make_vec("rocket_navigation", 2, distance=90.0).max_episode_steps is None


def test_time_aware_wrappers_know_the_horizon() -> None:
    """The time that they add to the observation ends at 1."""
    environment = wrappers.TimeAwareObservation(
        gymnasium.make(ROCKET, max_episode_steps=4), normalize_time=True
    )
    assert environment.reset(seed=0)[0][-1] == 0.0
    times = [environment.step(np.zeros(2))[0][-1] for _ in range(4)]
    assert times == [0.25, 0.5, 0.75, 1.0]
    plain = wrappers.TimeAwareObservation(gymnasium.make(LAIKAGO))
    assert plain.max_timesteps == tasks.make("laikago_walk").horizon


# Seeds


def test_a_seed_means_what_it_says() -> None:
    """Given to `make`, or later to `reset`."""
    single = tsbench.load("laikago_walk", perturbed=True, seed=5)
    first, second = (values(single.reset()) for _ in range(2))
    for seed in (5, np.int64(5)):
        given = gymnasium.make(LAIKAGO, perturbed=True, seed=seed)
        np.testing.assert_array_equal(given.reset()[0], first)
        np.testing.assert_array_equal(given.reset()[0], second)
        np.testing.assert_array_equal(given.reset(seed=5)[0], first)
    fresh = gymnasium.make(LAIKAGO, perturbed=True)
    assert not np.any(fresh.reset()[0][:12] == first[:12])
    with pytest.raises(TsbenchError, match="seed must not be negative, not -1"):
        gymnasium.make(LAIKAGO, seed=-1)


def test_seeds_of_many() -> None:
    """One for all, or a list of one each; to `make_vec` or to `reset`, batched or not."""

    def starts(seed: Any, first: Any = None, **arguments: Any) -> np.ndarray:
        if first is not None:
            arguments["seed"] = first
        many = gymnasium.make_vec(LAIKAGO, num_envs=3, perturbed=True, **arguments)
        return many.reset(seed=seed)[0]

    assert starts(4).tobytes() == starts(None, 4).tobytes()
    expected = starts([4, 5, 4], vectorization_mode="sync")
    assert starts([4, 5, 4]).tobytes() == expected.tobytes()
    assert starts(None, [4, 5, 4]).tobytes() == expected.tobytes()
    assert not np.any(starts(None)[:, :12] == starts(None)[:, :12])
    with pytest.raises(TsbenchError, match="a list of seeds must have one for each of 3, not 2"):
        starts(None, [4, 5])


# Pictures


def test_render_modes() -> None:
    """Gymnasium's wrapper collects the pictures of the steps."""
    collected = gymnasium.make(ROCKET, render_mode="rgb_array_list")
    assert collected.render_mode == "rgb_array_list"
    collected.reset(seed=0)
    for _ in range(2):
        collected.step(np.ones(2))
    pictures: Any = collected.render()
    assert [picture.shape for picture in pictures] == [(480, 640, 3)] * 3
    message = "unknown render mode 'ansi'; allowed: rgb_array"
    with pytest.raises(TsbenchError, match=message), pytest.warns(match="'ansi'"):
        gymnasium.make(ROCKET, render_mode="ansi")
    with pytest.raises(TsbenchError, match=message):
        gymnasium.make_vec(ROCKET, render_mode="ansi")


def test_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gymnasium's wrapper shows each step, at the task's pace, in a window of pygame."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # a window that nobody sees
    with pytest.warns(UserWarning, match="The HumanRendering wrapper is being applied"):
        shown = gymnasium.make(ROCKET, render_mode="human")
    assert shown.render_mode == "human"
    shown.reset(seed=0)
    shown.step(np.ones(2))
    assert isinstance(shown, wrappers.HumanRendering)
    window: Any = shown.window
    assert window.get_size() == (640, 480)
    shown.close()


# Gymnasium's own arguments of make_vec


@pytest.mark.parametrize(("mode", "kind"), [("sync", SyncVectorEnv), ("async", AsyncVectorEnv)])
def test_vectorization_modes(mode: str, kind: type) -> None:
    """Separate environments, each with a wrapper, see what the batched ones see."""
    separate = gymnasium.make_vec(
        LAIKAGO,
        num_envs=2,
        vectorization_mode=mode,
        wrappers=(wrappers.RecordEpisodeStatistics,),
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        perturbed=True,
    )
    assert isinstance(separate, kind)
    together = gymnasium.make_vec(
        LAIKAGO, num_envs=2, perturbed=True, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert together.reset(seed=[3, 4])[0].tobytes() == separate.reset(seed=[3, 4])[0].tobytes()  # type: ignore[arg-type]
    for _ in range(3):
        found, expected = (many.step(np.full((2, 12), -0.4)) for many in (together, separate))
        for array, other in zip(found[:4], expected[:4], strict=True):
            assert array.tobytes() == other.tobytes()
    separate.close()


def test_make_vec_makes_one_by_default() -> None:
    many = gymnasium.make_vec(ROCKET)
    assert many.num_envs == 1
    assert many.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP  # Gymnasium's default


# Gymnasium's wrappers of many environments


def made(mode: AutoresetMode = AutoresetMode.NEXT_STEP, **arguments: Any) -> Any:
    """Two rockets that hover and then fall, in episodes of 5 steps."""
    arguments = {"max_episode_steps": 5, "threads": 1, **arguments}
    return gymnasium.make_vec(ROCKET, num_envs=2, autoreset_mode=mode, **arguments)


def played(many: Any, steps: int = 14) -> tuple[list[np.ndarray], list[Any]]:
    """Observations (the first included) and what the steps return."""
    observations, results = [many.reset(seed=0)[0]], []
    for step in range(steps):
        results.append(many.step(np.full((2, 2), 0.5 * (step % 3))))
        observations.append(results[-1][0])
    return observations, results


def test_normalize_observation() -> None:
    """Which needs the mode next step."""
    plain, _ = played(made())
    many = vector.NormalizeObservation(made())
    normalized, _ = played(many)
    np.testing.assert_allclose(many.obs_rms.mean, np.concatenate(plain).mean(axis=0), atol=1e-3)
    spread = np.sqrt(many.obs_rms.var + many.epsilon)
    np.testing.assert_allclose(
        normalized[-1], (plain[-1] - many.obs_rms.mean) / spread, rtol=1e-4, atol=1e-4
    )
    with pytest.raises(ValueError, match="NEXT_STEP"):
        vector.NormalizeObservation(made(AutoresetMode.SAME_STEP))


@pytest.mark.parametrize("mode", MODES)
def test_normalize_reward(mode: AutoresetMode) -> None:
    plain, scaled = played(made(mode))[1], played(vector.NormalizeReward(made(mode)))[1]
    for one, other in zip(plain, scaled, strict=True):
        np.testing.assert_array_equal(one[1] == 0.0, other[1] == 0.0)
    assert scaled[0][1] != pytest.approx(plain[0][1])


@pytest.mark.parametrize("mode", MODES)
def test_record_episode_statistics(mode: AutoresetMode) -> None:
    """Returns and lengths of the episodes: 5 steps each."""
    results = played(made(mode), 17)[1]
    many = vector.RecordEpisodeStatistics(made(mode))
    told = [infos["episode"] for *_, infos in played(many, 17)[1] if "episode" in infos]
    every = 6 if mode is AutoresetMode.NEXT_STEP else 5  # the step between is no step of an episode
    assert len(told) == 3
    for episode, last in zip(told, (5, 5 + every, 5 + 2 * every), strict=True):
        assert episode["l"].tolist() == [5, 5]
        rewards = [reward for _, reward, *_ in results[last - 5 : last]]
        np.testing.assert_allclose(episode["r"], np.sum(rewards, axis=0), rtol=1e-12)
    assert list(many.length_queue) == [5] * 6


# Wrappers that look at observations refuse the mode same step, also of Gymnasium's SyncVectorEnv.


def test_rescale_and_transform_observation() -> None:
    """The observations are unbounded, so something bounds them before they are rescaled."""
    bounded = vector.VectorizeTransformObservation(
        made(),
        wrappers.TransformObservation,
        func=np.tanh,
        observation_space=Box(-1.0, 1.0, (10,), np.float64),
    )
    many = vector.RescaleObservation(bounded, np.float64(0.0), np.float64(4.0))
    for one, other in zip(played(made())[0], played(many)[0], strict=True):
        np.testing.assert_allclose(other, 2.0 * np.tanh(one) + 2.0, atol=1e-12)
        assert many.observation_space.contains(other)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda many: vector.DtypeObservation(many, np.float32),
        vector.FlattenObservation,
        lambda many: vector.ReshapeObservation(many, (5, 2)),
    ],
)
@pytest.mark.filterwarnings("ignore:.*precision lowered:UserWarning")
def test_further_wrappers_of_observations(wrap: Callable[[Any], Any]) -> None:
    for one, other in zip(played(made())[0], played(wrap(made()))[0], strict=True):
        np.testing.assert_allclose(np.reshape(other, (2, 10)), one, rtol=1e-6)


def test_numpy_to_torch() -> None:
    """Tensors go in and come out."""
    many = vector.NumpyToTorch(made())
    plain, results = played(made(), 7)
    observation, _ = many.reset(seed=0)
    for step, expected in enumerate(results):
        assert isinstance(observation, torch.Tensor)
        np.testing.assert_array_equal(observation.numpy(), plain[step])
        observation, reward, _, truncated, infos = many.step(torch.full((2, 2), 0.5 * (step % 3)))
        np.testing.assert_array_equal(reward.numpy(), expected[1])
        np.testing.assert_array_equal(truncated.numpy(), expected[3])
        assert set(infos) == set(expected[4])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.filterwarnings("ignore:.*precision lowered:UserWarning")
def test_rescale_and_clip_action(mode: AutoresetMode) -> None:
    given = np.array([[5.0, 2.0], [10.0, 7.5]])
    rescaled = vector.RescaleAction(made(mode), 0.0, 10.0)
    clipped = vector.ClipAction(made(mode))
    plain = made(mode)
    for many in (rescaled, clipped, plain):
        many.reset(seed=0)
    expected = plain.step(given / 5.0 - 1.0)[0]
    np.testing.assert_allclose(rescaled.step(given)[0], expected, atol=1e-12)
    np.testing.assert_array_equal(clipped.step(given)[0], made_step(mode, np.ones((2, 2))))


def made_step(mode: AutoresetMode, actions: np.ndarray) -> np.ndarray:
    many = made(mode)
    many.reset(seed=0)
    observation: np.ndarray = many.step(actions)[0]
    return observation


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.filterwarnings("ignore:.*same-step:UserWarning")
def test_record_video(mode: AutoresetMode, tmp_path: Path) -> None:
    """A film of both environments side by side, of each episode one."""
    many = vector.RecordVideo(
        made(mode, render_mode="rgb_array", max_episode_steps=3),
        str(tmp_path / "films"),
        episode_trigger=lambda _: True,
        video_aspect_ratio=(2, 1),
    )
    played(many, 5)
    many.close()
    films = sorted((tmp_path / "films").glob("*.mp4"))
    assert [film.name for film in films] == ["rl-video-episode-0.mp4", "rl-video-episode-1.mp4"]
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(films[0]))
    assert count == (4 if mode is AutoresetMode.NEXT_STEP else 3)  # which lacks the last one
    assert seconds == pytest.approx(count / 50, abs=0.02)
    assert imageio_ffmpeg.read_frames(str(films[0])).__next__()["source_size"] == (1280, 480)


@pytest.mark.parametrize(
    "wrap",
    [
        vector.DictInfoToList,
        lambda many: vector.ClipReward(many, 0.0, 0.5),
        lambda many: vector.TransformReward(many, lambda reward: 2.0 * reward),
    ],
)
@pytest.mark.parametrize("mode", MODES)
def test_further_wrappers_of_many(mode: AutoresetMode, wrap: Callable[[Any], Any]) -> None:
    plain, seen = played(made(mode))[0], played(wrap(made(mode)))[0]
    np.testing.assert_array_equal(seen, plain)


def test_wrappers_of_one() -> None:
    """One around the other."""
    environment: Any = gymnasium.make(LAIKAGO, perturbed=True)
    for wrap in (
        lambda one: wrappers.RescaleAction(one, np.float32(-2.0), np.float32(2.0)),
        wrappers.ClipAction,
        wrappers.RecordEpisodeStatistics,
        wrappers.NormalizeObservation,
        wrappers.NormalizeReward,
        lambda one: wrappers.FrameStackObservation(one, 2),
        lambda one: wrappers.TransformReward(one, float),
        wrappers.Autoreset,
    ):
        environment = wrap(environment)
    environment.reset(seed=1)
    lengths = []
    for _ in range(150):
        *_, info = environment.step(np.full(12, -1.0))
        if "episode" in info:
            lengths.append(info["episode"]["l"])
    assert len(lengths) >= 2


@pytest.mark.filterwarnings("error")
def test_stable_baselines3_learns_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))
    identifier = tsbench.gym.identifier("laikago_trot")
    env_checker.check_env(gymnasium.make(identifier).unwrapped)
    vectorised = make_vec_env(identifier, n_envs=2, seed=0)
    learner = PPO("MlpPolicy", vectorised, n_steps=32, batch_size=32, n_epochs=1, seed=0)
    before = learner.policy.state_dict()["action_net.weight"].clone()
    learner.learn(128)
    assert learner.num_timesteps == 128
    assert not before.equal(learner.policy.state_dict()["action_net.weight"])
    assert len(learner.ep_info_buffer or ()) >= 1  # the finished episodes
