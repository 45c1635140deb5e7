"""Tasks under Gymnasium's names, and as Stable-Baselines3 uses them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env

import tsbench
import tsbench.gym
from tsbench import TsbenchError, tasks


@pytest.mark.parametrize("name", tasks.names())
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


def test_the_module_may_stand_in_the_name() -> None:
    program = (
        "import gymnasium\n"
        "print(gymnasium.make('tsbench.gym:tsbench/rocket_navigation-v1').reset()[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "(10,)\n"


def test_arguments_are_those_of_load() -> None:
    identifier = tsbench.gym.identifier("rocket_navigation")
    planning = gymnasium.make(identifier, variant="planning", distance=3.0)
    assert planning.action_space.shape == (3,)
    assert isinstance(planning.unwrapped, tsbench.gym.GymEnvironment)
    assert planning.unwrapped.single.task.mdp.horizon == 15
    with pytest.raises(TsbenchError, match="did you mean 'distance'"):
        gymnasium.make(identifier, distence=3.0)
    with pytest.raises(TsbenchError, match="did you mean 'rocket_navigation'"):
        tsbench.gym.identifier("rocket_navigatoin")


@pytest.mark.filterwarnings("error")
def test_stable_baselines3_learns_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path))
    identifier = tsbench.gym.identifier("laikago_trot")
    check_env(gymnasium.make(identifier).unwrapped)
    vectorised = make_vec_env(identifier, n_envs=2, seed=0)
    learner = PPO("MlpPolicy", vectorised, n_steps=32, batch_size=32, n_epochs=1, seed=0)
    before = learner.policy.state_dict()["action_net.weight"].clone()
    learner.learn(128)
    assert learner.num_timesteps == 128
    assert not before.equal(learner.policy.state_dict()["action_net.weight"])
    assert len(learner.ep_info_buffer or ()) >= 1  # the finished episodes
