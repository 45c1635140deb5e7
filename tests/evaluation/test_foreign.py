"""Policies that were not made here, with the real libraries."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from rsl_rl.models import MLPModel, RNNModel
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensordict import TensorDict

import tsbench
from tsbench import TsbenchError, cli, tasks
from tsbench.core.policy import Policy
from tsbench.evaluation import foreign

TASK = tasks.make("rocket_navigation")
RNG = np.random.default_rng(0)
WEIGHT = RNG.normal(size=(10, 2)).astype(np.float32)
OBSERVATIONS = RNG.normal(size=(7, 10))


def write_onnx(
    path: Path, inputs: int = 10, rows: Any = "n", shape: tuple[int, ...] | None = None
) -> Path:
    """tanh(x W), made to have another shape if asked."""
    weight = RNG.normal(size=(inputs, 2)).astype(np.float32) if inputs != 10 else WEIGHT
    nodes = [
        helper.make_node("MatMul", ["x", "w"], ["h"]),
        helper.make_node("Tanh", ["h"], ["y"]),
    ]
    initial = [numpy_helper.from_array(weight, "w")]
    last, sizes = "y", [rows, 2]
    if shape is not None:
        last, sizes = "z", list(shape)
        nodes.append(helper.make_node("Reshape", ["y", "s"], [last]))
        initial.append(numpy_helper.from_array(np.array(shape, np.int64), "s"))
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [rows, inputs])],
        [helper.make_tensor_value_info(last, TensorProto.FLOAT, sizes)],
        initial,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


class Spaces(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment that is nothing but its spaces."""

    def __init__(self, observations: int = 10) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observations,))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        return np.zeros(self.observation_space.shape or (), np.float32), {}


@pytest.fixture(scope="module")
def baseline(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PPO]:
    path = tmp_path_factory.mktemp("sb3") / "model.zip"
    model = PPO("MlpPolicy", Spaces(), seed=0, device="cpu", n_steps=8, batch_size=8)
    model.save(path)
    return path, model


def test_a_function() -> None:
    """Called with one observation at a time."""
    seen: list[tuple[int, ...]] = []

    def act(observation: np.ndarray) -> list[float]:
        seen.append(observation.shape)
        return [float(observation[0]), 0.5]

    policy = foreign.from_function(act, TASK)
    actions = policy(OBSERVATIONS)
    assert seen == [(10,)] * 8  # the first one again at the end
    np.testing.assert_array_equal(actions[:, 0], OBSERVATIONS[:, 0])
    np.testing.assert_array_equal(actions[:, 1], 0.5)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (0.5, r"shape \(\), not \(2,\)"),
        ([0.5], r"shape \(1,\), not \(2,\)"),
        ([[0.5, 0.5]], r"shape \(1, 2\), not \(2,\)"),
        ([0.5, np.nan], "not finite"),
        (["a", "b"], "not made of numbers"),
        (None, r"shape \(\), not"),
        ([0.5, [1.0]], "not made of numbers"),
    ],
)
def test_functions_that_are_no_policies(action: Any, message: str) -> None:
    with pytest.raises(TsbenchError, match=message):
        tsbench.evaluate(lambda _: action, "rocket_navigation", protocol="smoke")


def test_evaluate_takes_a_function() -> None:
    """Nothing is done and the rocket falls, whoever asks."""
    score = tsbench.evaluate(lambda _: [0.0, 0.0], "rocket_navigation", protocol="smoke", threads=1)
    assert score.protocol == "smoke"
    assert score.success == 0.0
    assert score.origin.policy is None
    assert score.nominal.steps < 200
    with pytest.raises(TsbenchError, match="unknown protocol 'v2'; allowed: smoke, v1"):
        tsbench.evaluate(lambda _: [0.0, 0.0], "rocket_navigation", protocol="v2")
    with pytest.raises(TsbenchError, match="no policy nowhere"):
        tsbench.evaluate("nowhere", "rocket_navigation")
    assert tsbench.evaluate("zero", "rocket_navigation", protocol="smoke", threads=1) == score


def test_evaluate_takes_a_model_that_is_there(baseline: tuple[Path, PPO]) -> None:
    score = tsbench.evaluate(baseline[1], "rocket_navigation", protocol="smoke", threads=1)
    loaded = foreign.from_sb3(baseline[0], "PPO", TASK)
    same = tsbench.evaluate(loaded, "rocket_navigation", protocol="smoke", threads=1)
    assert score.nominal == same.nominal
    with pytest.raises(TsbenchError, match="a model, a file or a function, not int"):
        tsbench.evaluate(3, "rocket_navigation", protocol="smoke")


def network(*more: torch.nn.Module) -> torch.nn.Sequential:
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(10, 8), *more, torch.nn.Linear(8, 2))


def by_torch(module: torch.nn.Module) -> np.ndarray:
    with torch.no_grad():
        return np.asarray(module(torch.as_tensor(OBSERVATIONS, dtype=torch.float32)).numpy())


def test_a_torch_module() -> None:
    """It is asked with tensors, acts in evaluation mode, and is left as it was."""
    module = network(torch.nn.Dropout(), torch.nn.Tanh())
    policy = foreign.made(module, TASK)
    actions = policy(OBSERVATIONS)
    assert module.training
    np.testing.assert_allclose(actions, by_torch(module.eval()), atol=1e-6)
    with torch.no_grad():
        last = module[-1]
        assert isinstance(last, torch.nn.Linear)
        last.bias.add_(1.0)  # it is trained further
    np.testing.assert_array_equal(policy(OBSERVATIONS), actions)
    np.testing.assert_allclose(foreign.made(module.double(), TASK)(OBSERVATIONS), actions + 1.0)


def test_a_function_that_returns_tensors() -> None:
    """Also with a gradient, and in half precision."""
    module = network()

    def act(observation: np.ndarray) -> torch.Tensor:
        return module(torch.as_tensor(observation, dtype=torch.float32))

    np.testing.assert_allclose(foreign.made(act, TASK)(OBSERVATIONS), by_torch(module), atol=1e-6)
    halved = foreign.made(lambda observation: act(observation).bfloat16(), TASK)
    np.testing.assert_allclose(halved(OBSERVATIONS), by_torch(module), atol=0.05)


class Window(torch.nn.Module):
    """Acts by the last two observations."""

    before: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("before", torch.ones(1, 2))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        given, self.before = observation[:, :2] + self.before, observation[:, :2].clone()
        return given


class Noise(torch.nn.Module):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.rand(1, 2)


class Pair(torch.nn.Module):
    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return observation[:, :2], observation[:, :1]


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (torch.nn.LSTM(10, 2), "the module LSTM has a memory, a policy has none"),
        (torch.nn.Sequential(torch.nn.GRUCell(10, 2)), "has a memory"),
        (Window(), "has a memory or draws random numbers"),
        (Noise(), "has a memory or draws random numbers"),
        (Pair(), r"returns a tuple, not \(1, 2\)"),
        (torch.nn.Linear(11, 2), r"does not take \(1, 10\): "),
        (torch.nn.Linear(10, 3), r"shape \(3,\), not \(2,\)"),
        (torch.nn.Linear, "not a class"),
        (3, "a model, a file or a function, not int"),
    ],
)
def test_what_is_no_policy(policy: Any, message: str) -> None:
    with pytest.raises(TsbenchError, match=message) as caught:
        foreign.made(policy, TASK)
    assert "\n" not in str(caught.value)


def test_a_function_with_a_memory_is_refused() -> None:
    """Its one memory would mix what it saw in episodes that are played side by side."""
    steps = iter(range(1000))
    with pytest.raises(TsbenchError, match="has a memory or draws random numbers"):
        tsbench.evaluate(
            lambda _: [next(steps) / 1000.0, 0.0], "rocket_navigation", protocol="smoke", threads=1
        )


def actor(kind: type[MLPModel]) -> MLPModel:
    """An actor of rsl-rl with a normaliser that has seen something."""
    torch.manual_seed(0)
    seen = TensorDict({"policy": 3.0 + torch.randn(50, 10)}, batch_size=[50])
    model = kind(
        seen, {"actor": ["policy"]}, "actor", 2, [8, 8], "elu", True,
        {"class_name": "rsl_rl.modules.GaussianDistribution"},
    )  # fmt: skip
    model.update_normalization(seen)
    return model


def test_an_actor_of_rsl_rl() -> None:
    model = actor(MLPModel)
    given = torch.as_tensor(OBSERVATIONS, dtype=torch.float32)
    with torch.no_grad():
        expected = model(TensorDict({"policy": given}, batch_size=[7])).numpy()
    np.testing.assert_allclose(foreign.made(model, TASK)(OBSERVATIONS), expected, atol=1e-6)
    with pytest.raises(TsbenchError, match="the module RNNModel has a memory"):
        foreign.made(actor(RNNModel), TASK)
    script = torch.jit.script(actor(RNNModel).as_jit())
    with pytest.raises(TsbenchError, match="has a memory"):
        foreign.made(script, TASK)(OBSERVATIONS)


@pytest.mark.parametrize("rows", [1, "n"])
def test_onnx(rows: Any, tmp_path: Path) -> None:
    policy = foreign.load(write_onnx(tmp_path / "p.onnx", rows=rows), TASK)
    actions = policy(OBSERVATIONS)
    expected = np.tanh(OBSERVATIONS.astype(np.float32) @ WEIGHT)
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    for row in range(7):  # to the last bit, whatever else is asked
        np.testing.assert_array_equal(policy(OBSERVATIONS[row : row + 1])[0], actions[row])
    assert not isinstance(policy, Policy)
    assert len(policy.sha256 or "") == 64


def apart(path: Path, location: str) -> Path:
    """An ONNX model whose weights lie in another file."""
    model = onnx.load(write_onnx(path))
    onnx.save(
        model, str(path), save_as_external_data=True, size_threshold=0, location=location
    )  # fmt: skip
    return path


def test_onnx_weights_beside_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime itself takes them from the current directory, where others may lie."""
    (tmp_path / "there").mkdir()
    path = apart(tmp_path / "there" / "q.onnx", "weights")
    (tmp_path / "weights").write_bytes(bytes(80))
    monkeypatch.chdir(tmp_path)
    policy = foreign.load(Path("there/q.onnx"), TASK)
    whole = foreign.load(write_onnx(tmp_path / "p.onnx"), TASK)
    np.testing.assert_array_equal(policy(OBSERVATIONS), whole(OBSERVATIONS))
    (tmp_path / "there" / "weights").write_bytes(bytes(80))
    other = foreign.load(path, TASK)
    np.testing.assert_array_equal(other(OBSERVATIONS), 0.0)
    assert len({one.sha256 for one in (policy, whole, other)}) == 3


def test_onnx_weights_as_torch_writes_them(tmp_path: Path) -> None:
    """The default of torch.onnx.export: `policy.onnx` and `policy.onnx.data`."""
    module = torch.nn.Sequential(torch.nn.Linear(10, 64), torch.nn.ELU(), torch.nn.Linear(64, 2))
    path = tmp_path / "policy.onnx"
    torch.onnx.export(module, (torch.zeros(1, 10),), str(path), dynamo=True, external_data=True)
    assert (tmp_path / "policy.onnx.data").is_file()
    expected = foreign.made(module, TASK)(OBSERVATIONS)
    np.testing.assert_allclose(foreign.load(path, TASK)(OBSERVATIONS), expected, atol=1e-5)


def test_onnx_weights_that_are_not_read(tmp_path: Path) -> None:
    path = apart(tmp_path / "q.onnx", "weights")
    weights = tmp_path / "weights"
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(TsbenchError, match=r"damaged ONNX file .*'weights' lacks some"):
        foreign.load(path, TASK)
    weights.rename(tmp_path / "elsewhere")
    with pytest.raises(TsbenchError, match=r"no policy file .*weights"):
        foreign.load(path, TASK)
    weights.symlink_to("elsewhere")
    with pytest.raises(TsbenchError, match="is a link"):
        foreign.load(path, TASK)
    model = onnx.load(path, load_external_data=False)
    for entry in model.graph.initializer[0].external_data:
        entry.value = "../weights" if entry.key == "location" else entry.value
    path.write_bytes(model.SerializeToString())
    with pytest.raises(
        TsbenchError, match=r"keeps weights in '\.\./weights': only files beside it"
    ):
        foreign.load(path, TASK)


@pytest.mark.parametrize("kind", ["LSTM", "GRU", "RNN", "Scan", "Loop", "If"])
def test_an_onnx_file_with_a_memory_is_refused(kind: str, tmp_path: Path) -> None:
    """One step of it, from an empty memory, would act otherwise than the model did. A loop may also
    never end."""
    model = onnx.load(write_onnx(tmp_path / "p.onnx"))
    model.graph.node.append(helper.make_node(kind, ["y"], ["z"]))
    onnx.save(model, str(tmp_path / "q.onnx"))
    with pytest.raises(TsbenchError, match=f"the operator {kind}: memory"):
        foreign.load(tmp_path / "q.onnx", TASK)


def test_an_onnx_file_with_random_numbers_is_refused(tmp_path: Path) -> None:
    model = onnx.load(write_onnx(tmp_path / "p.onnx"))
    model.graph.node.append(helper.make_node("RandomNormalLike", ["y"], ["noise"]))
    onnx.save(model, str(tmp_path / "q.onnx"))
    with pytest.raises(TsbenchError, match="the operator RandomNormalLike"):
        foreign.load(tmp_path / "q.onnx", TASK)


def test_onnx_files_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(TsbenchError, match=r"not one input of floats \(n, 10\) for rocket_nav"):
        foreign.load(write_onnx(tmp_path / "p.onnx", inputs=11), TASK)
    with pytest.raises(TsbenchError, match=r"takes tensor\(float\) \[4, 10\], not one input"):
        foreign.load(write_onnx(tmp_path / "r.onnx", rows=4), TASK)
    (tmp_path / "q.onnx").write_bytes(b"nonsense")
    with pytest.raises(TsbenchError, match="damaged ONNX file"):
        foreign.load(tmp_path / "q.onnx", TASK)
    (tmp_path / "q.txt").write_bytes(b"nonsense")
    with pytest.raises(TsbenchError, match=r"neither a run directory nor an \.onnx or \.zip"):
        foreign.load(tmp_path / "q.txt", TASK)


def test_onnx_files_whose_answers_do_not_fit(tmp_path: Path) -> None:
    flat = foreign.load(write_onnx(tmp_path / "flat.onnx", shape=(2,)), TASK)
    with pytest.raises(TsbenchError, match=r"flat\.onnx returns shape \(2,\), not \(1, 2\)"):
        flat(OBSERVATIONS)
    broken = foreign.load(write_onnx(tmp_path / "broken.onnx", shape=(1, 3)), TASK)
    with pytest.raises(TsbenchError, match=r"broken\.onnx cannot be run: "):
        broken(OBSERVATIONS)


def test_stable_baselines3(baseline: tuple[Path, PPO]) -> None:
    path, model = baseline
    policy = foreign.load(path, TASK, "PPO")
    actions = policy(OBSERVATIONS)
    expected = model.predict(OBSERVATIONS.astype(np.float32), deterministic=True)[0]
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    np.testing.assert_array_equal(policy(OBSERVATIONS[3:4])[0], actions[3])


def normalised(bound: float = 10.0) -> VecNormalize:
    """Statistics that are far from those of no normalisation."""
    venv = VecNormalize(DummyVecEnv([Spaces]), clip_obs=bound)
    seen = statistics_of(venv)
    seen.mean, seen.var = RNG.normal(size=10), 1.0 + 3.0 * RNG.random(10)
    return venv


def statistics_of(venv: VecNormalize) -> RunningMeanStd:
    found: Any = venv.obs_rms  # or a mapping, where observations are dictionaries
    assert isinstance(found, RunningMeanStd)
    return found


@pytest.mark.parametrize(("kind", "bound"), [(PPO, 10.0), (SAC, 0.5), (TQC, 10.0)])
def test_the_statistics_of_vecnormalize_belong_to_the_model(
    kind: Any, bound: float, tmp_path: Path
) -> None:
    """They are applied to a model in memory, and a model's file without theirs is refused."""
    venv = normalised(bound)
    model = kind("MlpPolicy", venv, seed=0, device="cpu", **({"n_steps": 8} if kind is PPO else {}))
    model._setup_learn(8)  # what `learn` begins with
    seen = venv.normalize_obs(OBSERVATIONS)
    assert isinstance(seen, np.ndarray)
    expected = model.predict(seen.astype(np.float32), None, None, True)
    policy = foreign.made(model, TASK)
    np.testing.assert_allclose(policy(OBSERVATIONS), expected[0], atol=1e-6)
    plain = model.predict(OBSERVATIONS.astype(np.float32), deterministic=True)[0]
    assert np.abs(plain - expected[0]).max() > 1e-3
    path, statistics = tmp_path / "m.zip", tmp_path / "v.pkl"
    model.save(path)
    venv.save(str(statistics))
    with pytest.raises(TsbenchError, match="trained with VecNormalize, whose statistics are miss"):
        foreign.load(path, TASK, kind.__name__)
    loaded = foreign.load(path, TASK, kind.__name__, statistics)
    np.testing.assert_allclose(loaded(OBSERVATIONS), expected[0], atol=1e-6)
    statistics_of(venv).mean += 1.0
    venv.save(str(statistics))
    other = foreign.load(path, TASK, kind.__name__, statistics)
    assert other.sha256 != loaded.sha256  # the file of the model is the same
    np.testing.assert_allclose(policy(OBSERVATIONS), expected[0], atol=1e-6)


def test_rewards_that_were_normalised_change_no_action(
    tmp_path: Path, baseline: tuple[Path, PPO]
) -> None:
    VecNormalize(DummyVecEnv([Spaces]), norm_obs=False).save(str(tmp_path / "v.pkl"))
    policy = foreign.load(baseline[0], TASK, "PPO", tmp_path / "v.pkl")
    expected = foreign.load(baseline[0], TASK, "PPO")(OBSERVATIONS)
    np.testing.assert_array_equal(policy(OBSERVATIONS), expected)


def test_models_with_a_memory_are_refused(tmp_path: Path) -> None:
    sizes = {"lstm_hidden_size": 8}
    model = RecurrentPPO(
        "MlpLstmPolicy", DummyVecEnv([Spaces]), n_steps=8, device="cpu", policy_kwargs=sizes
    )
    for one in (model, model.policy):
        with pytest.raises(TsbenchError, match="the model has a memory, a policy has none"):
            foreign.made(one, TASK)
    model.save(tmp_path / "m.zip")
    with pytest.raises(TsbenchError, match=r"m\.zip has a memory"):
        foreign.load(tmp_path / "m.zip", TASK, "RecurrentPPO")


def test_the_policy_of_a_model(baseline: tuple[Path, PPO]) -> None:
    """A torch module that has its own way of being asked."""
    policy = foreign.made(baseline[1].policy, TASK)
    expected = foreign.made(baseline[1], TASK)(OBSERVATIONS)
    np.testing.assert_array_equal(policy(OBSERVATIONS), expected)


def test_a_model_with_other_actions_is_refused() -> None:
    class Wide(Spaces):
        def __init__(self) -> None:
            super().__init__()
            self.action_space = gymnasium.spaces.Box(-2.0, 2.0, (2,))

    model = PPO("MlpPolicy", Wide(), device="cpu", n_steps=8, batch_size=8)
    with pytest.raises(TsbenchError, match=r"lie in \[-2, 2\], not in \[-1, 1\]"):
        foreign.made(model, TASK)


def test_statistics_that_do_not_fit(tmp_path: Path, baseline: tuple[Path, PPO]) -> None:
    (tmp_path / "v.pkl").write_bytes(b"nonsense")
    with pytest.raises(TsbenchError, match=r"v\.pkl is no VecNormalize file: "):
        foreign.load(baseline[0], TASK, "PPO", tmp_path / "v.pkl")
    venv = VecNormalize(DummyVecEnv([lambda: Spaces(11)]))
    venv.save(str(tmp_path / "v.pkl"))
    with pytest.raises(TsbenchError, match="of VecNormalize are of other sizes"):
        foreign.load(baseline[0], TASK, "PPO", tmp_path / "v.pkl")
    with pytest.raises(TsbenchError, match="--vecnormalize belongs to a stable-baselines3"):
        foreign.load(baseline[0], TASK, None, tmp_path / "v.pkl")


def test_stable_baselines3_files_are_not_loaded_unasked(baseline: tuple[Path, PPO]) -> None:
    with pytest.raises(TsbenchError, match="can run any code when it is loaded"):
        foreign.load(baseline[0], TASK)
    with pytest.raises(TsbenchError, match="unknown stable-baselines3 algorithm 'PPPO'"):
        foreign.load(baseline[0], TASK, "PPPO")
    with pytest.raises(TsbenchError, match=r"not \(43,\) to \(12,\) as laikago_walk does"):
        foreign.load(baseline[0], tasks.make("laikago_walk"), "PPO")


def test_a_stable_baselines3_file_of_another_algorithm(baseline: tuple[Path, PPO]) -> None:
    words = r"model\.zip, or not one that SAC saved: 'ActorCriticPolicy' object has no attribute"
    with pytest.raises(TsbenchError, match=words):
        foreign.load(baseline[0], TASK, "SAC")


def test_a_damaged_stable_baselines3_file(tmp_path: Path) -> None:
    (tmp_path / "m.zip").write_bytes(b"nonsense")
    with pytest.raises(TsbenchError, match="damaged stable-baselines3 file"):
        foreign.load(tmp_path / "m.zip", TASK, "PPO")


@pytest.mark.parametrize(("name", "extra"), [("onnxruntime", "onnx"), ("stable_baselines3", "sb3")])
def test_a_missing_extra(
    name: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "p.onnx").touch()
    with pytest.raises(TsbenchError, match=rf"{name} is missing: pip install 'tsbench\[{extra}\]'"):
        foreign.load(tmp_path / "p.onnx", TASK, "PPO" if extra == "sb3" else None)


def test_the_command_line(
    tmp_path: Path, baseline: tuple[Path, PPO], capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(write_onnx(tmp_path / "p.onnx"))
    words = ["evaluate", path, "task=rocket_navigation", "--protocol", "smoke"]
    assert cli.main(words) == 0
    shown = capsys.readouterr().out
    assert "protocol smoke" in shown
    assert "not ranked: protocol smoke plays too few episodes" in shown
    for wrong, message in (
        ([path], f"task=NAME is missing; allowed: {', '.join(tasks.names())}"),
        ([path, "task=rocket"], "unknown task 'rocket'"),
        ([path, "rocket_navigation"], "expected task=NAME, not 'rocket_navigation'"),
        (["zero"], "task=NAME is missing"),
        ([str(baseline[0]), "task=rocket_navigation"], "if you trust it: --trust-sb3 A2C|"),
        (["zero", "task=rocket_navigation", "--vecnormalize", "v"], "--vecnormalize is for a st"),
        (["model.pt", "task=rocket_navigation"], "no policy model.pt"),
        (["nothing.onnx", "task=rocket_navigation"], "no policy nothing.onnx"),
        (["zero", "task=rocket_navigation", "--protocol", "v0"], "unknown protocol 'v0'"),
        (["zero", "task=rocket_navigation", "--threads", "0"], "--threads: must be a whole number"),
    ):
        assert cli.main(["evaluate", *wrong]) == 2
        assert message in capsys.readouterr().err
