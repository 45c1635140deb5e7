"""The policy artefact: numpy against torch, files in and out, damage found."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rsl_rl.models import MLPModel
from safetensors.numpy import load, save
from tensordict import TensorDict

from tsbench import TsbenchError
from tsbench.core.policy import ACTIVATIONS, Policy, PolicyInfo


def policy(
    layers: tuple[int, ...] = (5, 16, 8, 2), activation: str = "elu", seed: int = 0
) -> Policy:
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    return Policy(
        info=PolicyInfo("walk", 1, "physics", "twostage", activation, layers),
        mean=draw(layers[0]),
        scale=np.abs(draw(layers[0])) + np.float32(0.1),
        weights=tuple(draw(n, m) / np.float32(m**0.5) for m, n in pairwise(layers)),
        biases=tuple(draw(n) for n in layers[1:]),
    )


# The forward pass


def test_forward_by_hand() -> None:
    """Two inputs, two hidden units, one output."""
    f = np.float32
    tiny = Policy(
        info=PolicyInfo("walk", 1, "", "", "elu", (2, 2, 1)),
        mean=np.array([1.0, -1.0], f),
        scale=np.array([2.0, 0.5], f),
        weights=(np.array([[1.0, 0.0], [0.0, 1.0]], f), np.array([[0.25, 0.5]], f)),
        biases=(np.array([0.0, 0.5], f), np.array([0.125], f)),
    )
    # (2 - 1) / 2 = 0.5 and (-2 + 1) / 0.5 = -2, less 2 by the bias: elu(-1.5) = exp(-1.5) - 1,
    # 0.25 x 0.5 + 0.5 x -0.7768698 + 0.125
    np.testing.assert_allclose(tiny(np.array([2.0, -2.0])), [-0.1384349], atol=1e-6)
    relu = replace(tiny, info=replace(tiny.info, activation="relu"))
    np.testing.assert_allclose(relu(np.array([2.0, -2.0])), [0.25])
    tanh = replace(tiny, info=replace(tiny.info, activation="tanh"))
    # 0.25 x 0.4621172 + 0.5 x -0.9051483 + 0.125
    np.testing.assert_allclose(tanh(np.array([2.0, -2.0])), [-0.2120449], atol=1e-6)
    # Actions stay in the box.
    assert tiny(np.array([100.0, 100.0])).tolist() == [1.0]
    assert relu(np.array([1.0, -1.0])).tolist() == [0.375]
    # symlog(e^2 - 1) = 2 and symlog(1 - e^2) = -2
    symlog = replace(tiny, info=replace(tiny.info, encoding="symlog"))
    observation = np.array([math.e**2 - 1.0, 1.0 - math.e**2])
    np.testing.assert_allclose(symlog(observation), [-0.1384349], atol=1e-6)


def actor(layers: tuple[int, ...], activation: str, seed: int) -> MLPModel:
    """rsl-rl's own actor, with a normaliser that has been updated from observations."""
    torch.manual_seed(seed)
    observation = TensorDict({"policy": torch.zeros(1, layers[0])}, batch_size=[1])
    model = MLPModel(
        observation, {"actor": ["policy"]}, "actor", layers[-1], list(layers[1:-1]), activation,
        True, {"class_name": "GaussianDistribution", "init_std": 1.0},
    )  # fmt: skip
    model.train()
    for _ in range(5):
        seen = 3.0 * torch.randn(64, layers[0]) + torch.arange(layers[0])
        model.update_normalization(TensorDict({"policy": seen}, batch_size=[64]))
    return model.eval()


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("layers", [(43, 256, 128, 12), (10, 64, 64, 2), (7, 4, 3)])
def test_numpy_equals_torch(activation: str, layers: tuple[int, ...]) -> None:
    model = actor(layers, activation, 0)
    linear = [module for module in model.mlp if isinstance(module, torch.nn.Linear)]
    normaliser = model.obs_normalizer
    ours = Policy(
        info=PolicyInfo("walk", 1, "", "", activation, layers),
        mean=normaliser.mean.numpy(),
        scale=(normaliser.std + normaliser.eps).numpy(),
        weights=tuple(layer.weight.detach().numpy() for layer in linear),
        biases=tuple(layer.bias.detach().numpy() for layer in linear),
    )
    rng = np.random.default_rng(0)
    observation = rng.normal(np.arange(layers[0]), 4.0, (200, layers[0]))
    tensors = TensorDict({"policy": torch.from_numpy(observation).float()}, batch_size=[200])
    with torch.inference_mode():
        expected = model(tensors).clamp(-1.0, 1.0).numpy()
    actions = ours(observation)
    assert actions.dtype == np.float64
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    assert np.abs(expected).max() > 0.05


def test_rows_do_not_know_each_other() -> None:
    subject = policy((43, 256, 128, 12))
    observation = np.random.default_rng(0).normal(size=(37, 43))
    together = subject(observation)
    assert together.shape == (37, 12)
    for row in range(37):
        assert subject(observation[row]).tobytes() == together[row].tobytes()
        assert subject(observation[row : row + 1]).tobytes() == together[row].tobytes()
    order = np.random.default_rng(1).permutation(37)
    assert subject(observation[order]).tobytes() == together[order].tobytes()
    stacked = subject(observation[:36].reshape(3, 12, 43))
    assert stacked.shape == (3, 12, 12)
    assert stacked.tobytes() == together[:36].tobytes()


# Round trip


def equal(first: Policy, second: Policy) -> bool:
    mine = (first.mean, first.scale, *first.weights, *first.biases)
    its = (second.mean, second.scale, *second.weights, *second.biases)
    return len(mine) == len(its) and all(
        (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
        for a, b in zip(mine, its, strict=True)
    )


@pytest.mark.parametrize("layers", [(5, 16, 8, 2), (1, 1), (43, 256, 128, 12), (3, 1, 1, 1, 2)])
def test_round_trip(tmp_path: Path, layers: tuple[int, ...]) -> None:
    original = policy(layers, "tanh")
    original.save(tmp_path)
    loaded = Policy.load(str(tmp_path))
    assert equal(loaded, original)
    digest = hashlib.sha256((tmp_path / "policy.safetensors").read_bytes()).hexdigest()
    assert loaded.info == replace(original.info, sha256=digest)
    observation = np.random.default_rng(0).normal(size=(9, layers[0]))
    assert loaded(observation).tobytes() == original(observation).tobytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["policy.json", "policy.safetensors"]
    # Saving again gives the same files.
    before = [file.read_bytes() for file in sorted(tmp_path.iterdir())]
    loaded.save(tmp_path)
    assert [file.read_bytes() for file in sorted(tmp_path.iterdir())] == before


# Damage


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    policy().save(tmp_path)
    return tmp_path


def refused(directory: Path, *words: str) -> None:
    """Loading fails with one line that names a file."""
    with pytest.raises(TsbenchError) as caught:
        Policy.load(directory)
    message = str(caught.value)
    assert "\n" not in message
    assert str(directory / "policy.") in message
    assert len(message) < 400 + len(str(directory))
    for word in words:
        assert word in message


def test_arrays_in_double_precision_are_not_saved(saved: Path, tmp_path: Path) -> None:
    loaded = Policy.load(saved)
    double = replace(loaded, mean=loaded.mean.astype(np.float64))
    with pytest.raises(TsbenchError, match=r"^the arrays of a policy are float32, not float64$"):
        double.save(tmp_path / "double")


@pytest.mark.parametrize("name", ["policy.json", "policy.safetensors"])
def test_a_missing_file(saved: Path, name: str) -> None:
    (saved / name).unlink()
    refused(saved, "no policy file", name)
    (saved / name).mkdir()
    refused(saved, "not a regular file", name)


def test_files_that_do_not_belong_together(saved: Path, tmp_path_factory: Any) -> None:
    other = tmp_path_factory.mktemp("other")
    policy(seed=1).save(other)
    (other / "policy.safetensors").replace(saved / "policy.safetensors")
    refused(saved, "policy.safetensors", "hash differs")


def test_any_damage_to_the_weights(saved: Path) -> None:
    path = saved / "policy.safetensors"
    content = path.read_bytes()
    for length in (0, 1, 8, 100, len(content) - 1):
        path.write_bytes(content[:length])
        refused(saved, "hash differs")
    flipped = bytearray(content)
    flipped[len(flipped) // 2] ^= 1
    path.write_bytes(flipped)
    refused(saved, "hash differs")


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"[]", b"3", b"null", b'"policy"', b"\xff\xfe\x00", b"{}", b"{\"layers\": [1]}",
        b"[" * 10_000, b"NaN",
    ],
)  # fmt: skip
def test_what_is_no_description(saved: Path, content: bytes) -> None:
    (saved / "policy.json").write_bytes(content)
    refused(saved, "damaged policy file", "policy.json")


def test_a_huge_description(saved: Path) -> None:
    (saved / "policy.json").write_bytes(b" " * 20_000)
    refused(saved, "larger than the 16,384 bytes", "policy.json")


def test_a_truncated_description(saved: Path) -> None:
    path = saved / "policy.json"
    content = path.read_bytes().rstrip()
    for length in range(0, len(content), 23):
        path.write_bytes(content[:length])
        refused(saved, "policy.json")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 2}, ["has format 2; this tsbench reads 1"]),
        ({"format": "1"}, ["format"]),
        ({"activation": "eluu"}, ["unknown activation", "did you mean 'elu'?"]),
        ({"activation": ["elu"]}, ["activation"]),
        ({"activation": None}, ["activation"]),
        ({"encoding": "simlog"}, ["unknown encoding", "did you mean 'symlog'?"]),
        ({"layers": [5, 16, 8]}, ["policy.safetensors", "weight_2"]),
        ({"layers": [5, 16, 8, 2, 2]}, ["weight_3"]),
        ({"layers": [6, 16, 8, 2]}, ["shapes do not fit"]),
        ({"layers": [5]}, ["layers"]),
        ({"layers": []}, ["layers"]),
        ({"layers": [5, 0, 2]}, ["layers"]),
        ({"layers": [5, -16, 2]}, ["layers"]),
        ({"layers": [5.5, 2]}, ["layers"]),
        ({"layers": "52"}, ["layers"]),
        ({"layers": [[5], 2]}, ["layers"]),
        ({"layers": [float("inf"), 2]}, ["no finite number"]),
        ({"layers": [5] * 18}, ["layers", "16 layers at most"]),
        ({"output": "softmax"}, ["unknown output"]),
        ({"bound": 0.0}, ["bound must be positive"]),
        ({"layers": None}, ["layers"]),
        ({"task": 5}, ["task"]),
        ({"task": None}, ["task"]),
        ({"task_version": "1"}, ["task_version"]),
        ({"physics": {}}, ["physics"]),
        ({"sha256": "0" * 64}, ["hash differs"]),
        ({"sha256": 5}, ["sha256"]),
        ({"colour": "red"}, ["colour"]),
    ],
)
def test_descriptions_that_make_no_policy(
    saved: Path, changes: dict[str, Any], words: list[str]
) -> None:
    path = saved / "policy.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    refused(saved, *words)


def test_a_description_with_a_part_missing(saved: Path) -> None:
    path = saved / "policy.json"
    complete = json.loads(path.read_text())
    for name in ("task", "task_version", "physics", "method", "activation", "layers"):
        path.write_text(json.dumps({key: complete[key] for key in complete if key != name}))
        refused(saved, name)


def rewrite(directory: Path, change: Callable[[dict[str, np.ndarray]], None]) -> None:
    """Replaces the weights, and updates the hash in the description."""
    path = directory / "policy.safetensors"
    tensors = load(path.read_bytes())
    change(tensors)
    content = save(tensors)
    path.write_bytes(content)
    info = json.loads((directory / "policy.json").read_text())
    info["sha256"] = hashlib.sha256(content).hexdigest()
    (directory / "policy.json").write_text(json.dumps(info))


def spoil(name: str, value: float) -> Callable[[dict[str, np.ndarray]], None]:
    def change(tensors: dict[str, np.ndarray]) -> None:
        tensors[name] = tensors[name].copy()
        tensors[name].flat[-1] = value

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (spoil("weight_1", np.nan), "not finite"),
        (spoil("bias_2", np.inf), "not finite"),
        (spoil("mean", -np.inf), "not finite"),
        (spoil("scale", 0.0), "the scale must be positive"),
        (spoil("scale", -1.0), "the scale must be positive"),
        (lambda t: t.pop("weight_2"), "weight_2"),
        (lambda t: t.pop("mean"), "mean"),
        (lambda t: t.update(weight_1=t["weight_1"].T.copy()), "shapes do not fit"),
        (lambda t: t.update(bias_0=t["bias_0"][:-1]), "shapes do not fit"),
        (lambda t: t.update(scale=t["scale"][None]), "shapes do not fit"),
        (lambda t: t.update(mean=t["mean"].astype(np.float64)), "mean"),
        (lambda t: t.update(weight_0=t["weight_0"].astype(np.int32)), "weight_0"),
    ],
)
def test_weights_that_make_no_policy(
    saved: Path, change: Callable[[dict[str, np.ndarray]], None], words: str
) -> None:
    rewrite(saved, lambda _: None)
    assert equal(Policy.load(saved), policy())
    rewrite(saved, change)
    refused(saved, "policy.safetensors", words)


def test_weights_that_are_no_safetensors(saved: Path) -> None:
    content = b'\x08\x00\x00\x00\x00\x00\x00\x00{"a": 1}'
    info = json.loads((saved / "policy.json").read_text())
    info["sha256"] = hashlib.sha256(content).hexdigest()
    (saved / "policy.json").write_text(json.dumps(info))
    (saved / "policy.safetensors").write_bytes(content)
    refused(saved, "damaged policy file", "policy.safetensors")
