"""Policies of other libraries become tsbench's own, entries, and are verified."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from rsl_rl.models import MLPModel, RNNModel
from sb3_contrib import ARS
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensordict import TensorDict

import tsbench.gym
from tsbench import cli, tasks
from tsbench.core.errors import TsbenchError
from tsbench.core.policy import Policy
from tsbench.evaluation import export, foreign
from tsbench.evaluation import protocol as protocols
from tsbench.evaluation.protocol import PROTOCOLS, SMOKE
from tsbench.leaderboard import submission

NAME = "rocket_navigation"
TASK = tasks.make(NAME)
SIZE, ACTIONS = TASK.observation_size, TASK.action_size
RNG = np.random.default_rng(0)
OBSERVATIONS = RNG.normal(size=(50, SIZE)) * 20.0
QUICK = replace(SMOKE, name="quick", ranked=True)


def network(*layers: torch.nn.Module) -> torch.nn.Sequential:
    torch.manual_seed(0)
    first, last = torch.nn.Linear(SIZE, 8), torch.nn.Linear(8, ACTIONS)
    return torch.nn.Sequential(first, torch.nn.ELU(), torch.nn.Sequential(last), *layers)


@pytest.mark.parametrize("last", [(), (torch.nn.Tanh(),)], ids=["clipped", "squashed"])
def test_a_torch_module(last: tuple[torch.nn.Module, ...], tmp_path: Path) -> None:
    module = network(*last)
    policy, difference = export.policy_of(export.from_torch(module, SIZE), TASK, "mine")
    assert difference < 1e-5
    policy.save(tmp_path)
    loaded = Policy.load(tmp_path)
    assert loaded.info.output == ("tanh" if last else "clip")
    with torch.no_grad():
        expected = module(torch.as_tensor(OBSERVATIONS, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(loaded(OBSERVATIONS), np.clip(expected, -1.0, 1.0), atol=1e-5)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: network(torch.nn.Softmax(dim=-1)), "holds a 'Softmax'"),
        (lambda: torch.nn.LSTM(SIZE, ACTIONS), "the module LSTM has a memory"),
        (lambda: torch.nn.Sequential(torch.nn.Tanh()), "begins with tanh"),
        (lambda: torch.nn.Sequential(torch.nn.Linear(SIZE, 3)), "to 3 actions"),
        (lambda: network(torch.nn.ReLU()), "applies relu to its actions"),
        (lambda: network(torch.nn.Linear(ACTIONS, ACTIONS)), "different activations"),
        (lambda: torch.nn.Sequential(torch.nn.ELU(0.5)), "alpha 0.5"),
        (lambda: torch.nn.Sequential(), "no linear layer"),
    ],
)
def test_what_the_file_cannot_express_is_refused(
    make: Callable[[], torch.nn.Module], reason: str
) -> None:
    with pytest.raises(TsbenchError, match=reason) as caught:
        export.policy_of(export.from_torch(make(), SIZE), TASK, "mine")
    assert "\n" not in str(caught.value)


def test_a_policy_that_answers_otherwise_is_refused() -> None:
    """What the comparison is for: a network that was read wrongly."""
    found = export.from_torch(network(), SIZE)
    found.biases[0] = found.biases[0] + 0.1
    with pytest.raises(TsbenchError, match=r"differ by .* from the model's own"):
        export.policy_of(found, TASK, "mine")


def write_onnx(path: Path, *, last: str = "Tanh") -> Path:
    """(x - m) / s, two layers with Relu, one as MatMul and Add, one as Gemm."""
    arrays = {
        "m": RNG.normal(size=SIZE), "s": 1.0 + RNG.random(SIZE), "w": RNG.normal(size=(SIZE, 6)),
        "b": RNG.normal(size=6), "v": RNG.normal(size=(ACTIONS, 6)), "c": RNG.normal(size=ACTIONS),
    }  # fmt: skip
    nodes = [
        helper.make_node("Sub", ["x", "m"], ["1"]),
        helper.make_node("Div", ["1", "s"], ["2"]),
        helper.make_node("MatMul", ["2", "w"], ["3"]),
        helper.make_node("Add", ["3", "b"], ["4"]),
        helper.make_node("Relu", ["4"], ["5"]),
        helper.make_node("Gemm", ["5", "v", "c"], ["6"], transB=1),
        helper.make_node(last, ["6"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["n", SIZE])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["n", ACTIONS])],
        [numpy_helper.from_array(a.astype(np.float32), name) for name, a in arrays.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


def test_an_onnx_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = str(write_onnx(tmp_path / "p.onnx")), str(tmp_path / "out")
    assert cli.main(["export", path, f"task={NAME}", out, "--method", "mine"]) == 0
    assert "actions differ by at most" in capsys.readouterr().out
    expected = foreign.from_onnx(path, TASK)(OBSERVATIONS)
    np.testing.assert_allclose(Policy.load(out)(OBSERVATIONS), expected, atol=1e-4)
    other = str(write_onnx(tmp_path / "q.onnx", last="Softplus"))
    assert cli.main(["export", other, f"task={NAME}", f"{out}2", "--method", "mine"]) == 2
    assert "the operation 'Softplus'" in capsys.readouterr().err
    assert not Path(f"{out}2").exists()


@pytest.mark.parametrize(
    ("form", "refused"),
    [
        ({"value_float": 0.5}, ""),
        ({"value_floats": [0.5] * SIZE}, ""),
        ({"value_string": "x"}, "holds a Constant by value_string; allowed: value, value_float(s)"),
    ],
)
def test_a_constant_of_an_onnx_file(form: dict[str, Any], refused: str, tmp_path: Path) -> None:
    """ONNX gives a constant as a tensor, or as a number or text of its own."""
    path = write_onnx(tmp_path / "p.onnx")
    model = onnx.load(str(path))
    nodes = [helper.make_node("Constant", [], ["half"], **form), *model.graph.node]
    if not refused:
        nodes.insert(1, helper.make_node("Mul", ["x", "half"], ["scaled"]))
        nodes[2].input[list(nodes[2].input).index("x")] = "scaled"
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.save(model, str(path))
    if refused:
        with pytest.raises(TsbenchError, match=re.escape(refused)):
            export.read(path, TASK)
        return
    policy, _ = export.policy_of(export.read(path, TASK), TASK, "mine")
    expected = foreign.from_onnx(path, TASK)(OBSERVATIONS)
    np.testing.assert_allclose(policy(OBSERVATIONS), expected, atol=1e-4)


def test_a_state_dict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    module, path, out = network(), tmp_path / "p.pt", str(tmp_path / "out")
    torch.save(module.state_dict(), path)
    words = ["export", str(path), f"task={NAME}", out, "--method", "mine"]
    assert cli.main(words) == 2
    assert "says no activation: --activation elu|relu|tanh" in capsys.readouterr().err
    assert cli.main([*words, "--activation", "elu"]) == 0
    with torch.no_grad():
        expected = module(torch.as_tensor(OBSERVATIONS, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(
        Policy.load(out)(OBSERVATIONS), np.clip(expected, -1.0, 1.0), atol=1e-4
    )
    torch.save(module, path)  # a pickled module, which would run code
    assert cli.main([*words[:3], f"{out}2", *words[4:], "--activation", "elu"]) == 2
    assert "holds no state dict of plain tensors" in capsys.readouterr().err


def actor(distribution: str = "GaussianDistribution", kind: type[MLPModel] = MLPModel) -> MLPModel:
    """An actor of rsl-rl with a normaliser that has seen something."""
    torch.manual_seed(0)
    seen = TensorDict({"policy": 3.0 + 5.0 * torch.randn(50, SIZE)}, batch_size=[50])
    model = kind(
        seen, {"actor": ["policy"]}, "actor", ACTIONS, [8, 8], "elu", True,
        {"class_name": f"rsl_rl.modules.{distribution}"},
    )  # fmt: skip
    model.update_normalization(seen)
    return model.eval()


def acts(model: MLPModel) -> np.ndarray:
    given = torch.as_tensor(OBSERVATIONS, dtype=torch.float32)
    with torch.no_grad():
        actions = model(TensorDict({"policy": given}, batch_size=[50])).numpy()
    return np.clip(actions, -1.0, 1.0)


def releases(model: MLPModel) -> dict[str, dict[str, Any]]:
    """An actor's checkpoint as releases of rsl-rl keep it."""
    tensors = model.state_dict()
    layers = {
        name.replace("mlp.", "actor."): tensor
        for name, tensor in tensors.items() if name.startswith("mlp.")
    }  # fmt: skip
    layers |= {"critic.0.weight": torch.ones(4, SIZE), "std": torch.ones(ACTIONS)}
    normaliser = {
        name.partition(".")[2]: tensor
        for name, tensor in tensors.items() if name.startswith("obs_normalizer.")
    }  # fmt: skip
    more = {"optimizer_state_dict": {"state": {}, "param_groups": []}, "iter": 3, "infos": None}
    own = {f"actor_obs_normalizer.{name}": tensor for name, tensor in normaliser.items()}
    own |= {f"critic_obs_normalizer.{name}": tensor for name, tensor in normaliser.items()}
    return {
        "2": {"model_state_dict": layers, "obs_norm_state_dict": normaliser, **more},
        "3": {"model_state_dict": {**layers, **own}, **more},
        "5": {"actor_state_dict": tensors, "critic_state_dict": {"x": torch.ones(3)}, **more},
    }


@pytest.mark.parametrize("release", ["2", "3", "5"])
def test_a_checkpoint_of_rsl_rl(release: str, tmp_path: Path) -> None:
    """The actor with its normaliser, without the critic."""
    model, path = actor(), tmp_path / "model_3.pt"
    torch.save(releases(model)[release], path)
    found = export.read(path, TASK, activation="elu")
    policy, difference = export.policy_of(found, TASK, "mine")
    assert difference < 1e-5
    np.testing.assert_allclose(policy(OBSERVATIONS), acts(model), atol=1e-5)


def test_an_actor_and_the_exports_of_rsl_rl(tmp_path: Path) -> None:
    model = actor()
    policy, _ = export.policy_of(export.from_torch(model, SIZE), TASK, "mine")
    np.testing.assert_allclose(policy(OBSERVATIONS), acts(model), atol=1e-5)
    network, path = model.as_onnx(verbose=False), tmp_path / "policy.onnx"
    torch.onnx.export(
        network, network.get_dummy_inputs(), str(path), opset_version=18, dynamo=True,
        input_names=network.input_names, output_names=network.output_names,
    )  # fmt: skip
    policy, _ = export.policy_of(export.read(path, TASK), TASK, "mine")
    np.testing.assert_allclose(policy(OBSERVATIONS), acts(model), atol=1e-5)


@pytest.mark.parametrize(
    ("saved", "reason"),
    [
        (lambda: releases(actor("BetaDistribution"))["5"], "to 4 actions"),
        (lambda: releases(actor(kind=RNNModel))["5"], "holds an actor with a memory"),
        (lambda: {"actor_state_dict": {"cnn.kernel": torch.ones(3)}}, "'cnn.kernel', which is no"),
        (lambda: {"actor_state_dict": {"obs_normalizer.x": torch.ones(3)}}, "of another kind"),
    ],
)
def test_checkpoints_that_are_refused(
    saved: Callable[[], dict[str, Any]], reason: str, tmp_path: Path
) -> None:
    torch.save(saved(), tmp_path / "model_3.pt")
    with pytest.raises(TsbenchError, match=reason) as caught:
        export.policy_of(export.read(tmp_path / "model_3.pt", TASK, activation="elu"), TASK, "mine")
    assert "\n" not in str(caught.value)


def test_torchscript_is_refused(tmp_path: Path) -> None:
    torch.jit.script(actor().as_jit()).save(str(tmp_path / "policy.pt"))
    with pytest.raises(TsbenchError, match="is TorchScript, which is code"):
        export.read(tmp_path / "policy.pt", TASK, activation="elu")


def environment() -> gymnasium.Env[Any, Any]:
    return gymnasium.make(tsbench.gym.identifier(NAME))


@pytest.mark.parametrize("kind", [PPO, SAC, TD3, ARS])
def test_models_of_stable_baselines3(kind: Any) -> None:
    """Squashed or clipped, tanh or relu: as the model answers."""
    buffers = {PPO: {"n_steps": 8, "batch_size": 8}, ARS: {}}
    more = buffers.get(kind, {"buffer_size": 8})
    sizes = {"net_arch": [16, 16]}
    model = kind("MlpPolicy", environment(), seed=0, device="cpu", policy_kwargs=sizes, **more)
    given = foreign.from_sb3_model(model, TASK)
    policy, difference = export.policy_of(export.from_sb3(given), TASK, "mine")
    assert difference < export.SAME
    np.testing.assert_allclose(policy(OBSERVATIONS), given(OBSERVATIONS), atol=1e-4)


def test_a_model_with_memory_or_another_extractor_is_refused() -> None:
    model = PPO("MlpPolicy", environment(), seed=0, device="cpu", use_sde=True, n_steps=8)
    with pytest.raises(TsbenchError, match="state-dependent exploration"):
        export.from_sb3(foreign.from_sb3_model(model, TASK))


def test_somebody_elses_method_is_submitted_and_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """PPO of stable-baselines3, trained a little through Gymnasium with normalised observations,
    exported with its statistics, submitted and verified."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PROTOCOLS, "quick", QUICK)
    monkeypatch.setattr(protocols, "V1", QUICK)
    normalised = VecNormalize(DummyVecEnv([environment]), norm_reward=False)
    model = PPO("MlpPolicy", normalised, seed=0, device="cpu", n_steps=256, batch_size=64)
    model.learn(1024)
    model.save("model.zip")
    normalised.save("statistics.pkl")
    words = ["export", "model.zip", f"task={NAME}", "exported", "--method", "sb3_ppo"]
    assert cli.main(words) == 2
    assert "can run any code when it is loaded" in capsys.readouterr().err
    trust = ["--trust-sb3", "PPO", "--vecnormalize", "statistics.pkl"]
    assert cli.main([*words, *trust]) == 0
    policy = Policy.load("exported")
    assert policy.info.bound == 10.0
    expected = model.predict(normalised.normalize_obs(OBSERVATIONS), deterministic=True)[0]
    np.testing.assert_allclose(policy(OBSERVATIONS), expected, atol=1e-4)

    submit = [
        "submit",
        "exported",
        "--name",
        "sb3-ppo",
        "--author",
        "A. Person",
        "--licence",
        "MIT",
    ]
    assert cli.main(submit) == 2
    assert "say --seeds, --steps, --seconds and --command" in capsys.readouterr().err
    told = ["--seeds", "0", "--steps", "1024", "--seconds", "1.5", "--command", "python train.py"]
    assert cli.main([*submit, *told, "--hardware", "a PC", "--tuning-trials", "0"]) == 0
    entry = Path("leaderboards/quick", NAME, "sb3-ppo")
    assert cli.main(["verify", str(entry)]) == 0
    assert "re-scored: seed0 was compared bit for bit: equal" in capsys.readouterr().out
    training = submission.read_entry(entry).kept[0].training
    assert (training.steps, training.seconds, training.command) == (1024, 1.5, "python train.py")
    assert cli.main(["verify", str(entry), "--retrain"]) == 1
    assert "was not trained by tsbench" in capsys.readouterr().out
