"""Policies written for robots act as the policy itself, in other programs."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from tsbench import TsbenchError, cli, tasks
from tsbench.core.policy import Policy, PolicyInfo
from tsbench.evaluation import deploy, foreign, on_robot
from tsbench.sim.model import fingerprint

TASK = tasks.make("rocket_navigation")
OBSERVATIONS = np.random.default_rng(0).normal(size=(7, 10)) * 20.0
KINDS: list[dict[str, Any]] = [
    {"activation": "elu", "encoding": "symlog"},
    {"activation": "relu", "output": "tanh", "bound": 1.5},
    {"activation": "tanh"},
]


def made(kind: dict[str, Any], seed: int = 0) -> Policy:
    sizes, rng = (10, 16, 8, 2), np.random.default_rng(seed)
    info = PolicyInfo(
        task=TASK.name, task_version=TASK.version, physics=fingerprint(TASK.spec()),
        method="mine", layers=sizes, **kind,
    )  # fmt: skip
    arrays = {"mean": rng.normal(size=10), "scale": 0.5 + rng.random(10)}
    pairs = list(zip(sizes[1:], sizes[:-1], strict=True))
    return Policy(
        info=info,
        weights=tuple(rng.normal(size=pair).astype(np.float32) / 3.0 for pair in pairs),
        biases=tuple(rng.normal(size=pair[0]).astype(np.float32) / 10.0 for pair in pairs),
        **{name: array.astype(np.float32) for name, array in arrays.items()},
    )


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind["activation"])
def test_every_file_acts_as_the_policy(kind: dict[str, Any], tmp_path: Path) -> None:
    policy, out = made(kind), tmp_path / "deep" / "out"
    differences = deploy.write(policy, TASK, out)
    assert sorted(path.name for path in out.iterdir()) == [
        "policy.json", "policy.onnx", "policy.py", "policy.safetensors",
    ]  # fmt: skip
    assert differences["policy.safetensors"] == 0.0
    assert all(difference < 1e-5 for difference in differences.values())
    expected = policy(OBSERVATIONS)
    assert np.abs(expected).max() > 0.1
    assert np.ptp(expected, axis=0).min() > 0.1  # it matters what is observed
    given = OBSERVATIONS.astype(np.float32)
    session = onnxruntime.InferenceSession(str(out / "policy.onnx"))
    for rows in (given, given[:1]):  # any number of them
        (actions,) = session.run(["action"], {"observation": rows})
        np.testing.assert_allclose(actions, expected[: len(rows)], atol=1e-5)
    module = on_robot.load(out)
    np.testing.assert_allclose(module(torch.as_tensor(given)), expected, atol=1e-5)
    np.testing.assert_allclose(module(torch.as_tensor(given[3])), expected[3], atol=1e-5)
    assert Policy.load(out).sha256 == policy.sha256


def test_the_onnx_file_says_what_it_is(tmp_path: Path) -> None:
    policy = made(KINDS[0])
    model = onnx.load_from_string(deploy.as_onnx(policy, TASK))
    assert [(one.domain, one.version) for one in model.opset_import] == [("", 17)]
    told = {one.key: one.value for one in model.metadata_props}
    assert told == {
        "task": TASK.name, "task_version": str(TASK.version), "method": "mine",
        "timestep": str(TASK.timestep), "sha256": policy.sha256,
    }  # fmt: skip
    (tmp_path / "p.onnx").write_bytes(model.SerializeToString())
    scored = foreign.load(tmp_path / "p.onnx", TASK)  # as tsbench evaluate takes it
    np.testing.assert_allclose(scored(OBSERVATIONS), policy(OBSERVATIONS), atol=1e-5)


def test_the_torch_code_runs_without_tsbench(tmp_path: Path) -> None:
    policy, out = made(KINDS[1]), tmp_path / "out"
    deploy.write(policy, TASK, out)
    code = (
        "import sys; sys.modules['tsbench'] = None\n"
        "import torch; from policy import load\n"
        "print(load('.')(torch.tensor(eval(sys.argv[1]))).tolist())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(OBSERVATIONS.tolist())],
        cwd=out, env={"PYTHONDONTWRITEBYTECODE": "1"}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    np.testing.assert_allclose(json.loads(done.stdout), policy(OBSERVATIONS), atol=1e-5)


def test_the_torch_code_can_be_exported_further() -> None:
    """Without TorchScript: as torch.export traces it, for any number of rows."""
    policy = made(KINDS[2])
    tensors = {"mean": policy.mean, "scale": policy.scale}
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        tensors |= {f"weight_{i}": weight, f"bias_{i}": bias}
    module = on_robot.Policy(
        vars(policy.info), {name: torch.as_tensor(array) for name, array in tensors.items()}
    ).eval()
    rows = {0: torch.export.Dim("rows", min=2)}
    program = torch.export.export(module, (torch.zeros(3, 10),), dynamic_shapes=(rows,))
    given = torch.as_tensor(OBSERVATIONS, dtype=torch.float32)
    np.testing.assert_allclose(program.module()(given), policy(OBSERVATIONS), atol=1e-5)


def test_files_that_do_not_belong_together(tmp_path: Path) -> None:
    deploy.write(made(KINDS[0]), TASK, tmp_path / "out")
    made(KINDS[0], seed=1).save(tmp_path)
    (tmp_path / "policy.safetensors").replace(tmp_path / "out" / "policy.safetensors")
    with pytest.raises(ValueError, match=r"is not what policy\.json describes"):
        on_robot.load(tmp_path / "out")


def test_a_file_that_acts_otherwise_is_not_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = made(KINDS[0])
    other = replace(policy, biases=tuple(bias + np.float32(0.01) for bias in policy.biases))
    content = deploy.as_onnx(other, TASK)
    monkeypatch.setattr(deploy, "as_onnx", lambda *_: content)
    with pytest.raises(TsbenchError, match=r"the actions of policy\.onnx differ by 0\.0"):
        deploy.write(policy, TASK, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    run.mkdir()
    made(KINDS[0]).save(run)
    assert cli.main(["export", str(run), str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == [
        f"{out}/policy.safetensors", f"{out}/policy.onnx (opset 17, any number of rows)",
        f"{out}/policy.py",
    ]  # fmt: skip
    assert cli.main(["export", "rocket_navigation/prm", f"{out}1"]) == 0  # a kept entry
    assert (Path(f"{out}1") / "policy.onnx").is_file()
    (tmp_path / "p.onnx").touch()
    exported, other = str(out / "policy.onnx"), [f"task={TASK.name}", f"{out}2", "--method", "mine"]
    for words, line in (
        ([str(run), str(out)], "exists"),
        ([str(run), f"{out}2", "--method", "mine"], "--method is for a policy of another library"),
        ([str(run), f"{out}2", "--activation", "elu"], "--activation is for a .pt file"),
        ([str(run), f"{out}2", "--vecnormalize", "v"], "--vecnormalize is for a stable-baselines3"),
        ([str(run), "task=laikago_trot", f"{out}2"], "for rocket_navigation, not for laikago_trot"),
        ([str(tmp_path / "p.onnx"), f"{out}2"], "task=NAME is missing"),
        ([str(tmp_path / "p.onnx"), f"task={TASK.name}", f"{out}2"], "--method NAME is missing"),
        ([exported, *other], f"{exported} is an export of tsbench: give the directory of the"),
    ):
        assert cli.main(["export", *words]) == 2
        (error,) = capsys.readouterr().err.splitlines()
        assert line in error
    assert not Path(f"{out}2").exists()
