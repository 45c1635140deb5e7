"""Policies that were not made here, with the real libraries."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from stable_baselines3 import PPO

import tsbench
from tsbench import TsbenchError, tasks
from tsbench.cli import verbs
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
    assert seen == [(10,)] * 7
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


def test_an_onnx_file_whose_weights_lie_elsewhere_is_refused(tmp_path: Path) -> None:
    """onnxruntime would take them from the current directory."""
    model = onnx.load(write_onnx(tmp_path / "p.onnx"))
    onnx.save(
        model, str(tmp_path / "q.onnx"), save_as_external_data=True, size_threshold=0,
        location="weights",
    )  # fmt: skip
    with pytest.raises(TsbenchError, match="keeps weights in another file"):
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


def test_stable_baselines3_files_are_not_loaded_unasked(baseline: tuple[Path, PPO]) -> None:
    with pytest.raises(TsbenchError, match="can run any code when it is loaded"):
        foreign.load(baseline[0], TASK)
    with pytest.raises(TsbenchError, match="unknown stable-baselines3 algorithm 'PPPO'"):
        foreign.load(baseline[0], TASK, "PPPO")
    with pytest.raises(TsbenchError, match=r"not \(43,\) to \(12,\) as laikago_walk does"):
        foreign.load(baseline[0], tasks.make("laikago_walk"), "PPO")


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
    assert verbs.main(words) == 0
    shown = capsys.readouterr().out
    assert "protocol smoke" in shown
    assert "not ranked: protocol smoke plays too few episodes" in shown
    for wrong, message in (
        ([path], f"task=NAME is missing; allowed: {', '.join(tasks.names())}"),
        ([path, "task=rocket"], "unknown task 'rocket'"),
        ([path, "rocket_navigation"], "expected task=NAME, not 'rocket_navigation'"),
        (["zero"], "task=NAME is missing"),
        ([str(baseline[0]), "task=rocket_navigation"], "if you trust it: --trust-sb3 A2C|"),
        (["nothing.onnx", "task=rocket_navigation"], "no policy nothing.onnx"),
        (["zero", "task=rocket_navigation", "--protocol", "v0"], "unknown protocol 'v0'"),
        (["zero", "task=rocket_navigation", "--threads", "0"], "--threads: must be a whole number"),
    ):
        assert verbs.main(["evaluate", *wrong]) == 2
        assert message in capsys.readouterr().err
