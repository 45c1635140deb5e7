"""The policy artefact: the weights of a network as data, and its forward pass in numpy.

`policy.safetensors` holds the weights, `policy.json` describes them. Loading them executes no code
from the files, and running the policy needs no torch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from tsbench.core.arrays import Array, array_namespace
from tsbench.core.errors import TsbenchError, quoted, unknown
from tsbench.core.files import read_file, read_json, write_whole
from tsbench.core.typed import typed

FORMAT = 1

# Limits of the files. The largest kept network takes 184 KB.
MAX_INFO = 16 * 2**10  # bytes
MAX_FILE = 8 * 2**20  # bytes: two million weights
MAX_HEADER = 16 * 2**10  # bytes of the safetensors file's header
MAX_LAYERS = 16


def _elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))


def _relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0.0)


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "elu": _elu,
    "relu": _relu,
    "tanh": np.tanh,
}


def _plain(x: Array) -> Array:
    return x


def _symlog(x: Array) -> Array:
    xp = array_namespace(x)
    return xp.sign(x) * xp.log1p(xp.abs(x))


# Applied to observations before they are normalised. `symlog` (Hafner et al. 2023, DreamerV3)
# compresses large values and keeps small ones apart. This helps where an observation ranges over
# tens of metres but decimetres matter, such as a rocket's offset from its goal.
ENCODINGS: dict[str, Callable[[Array], Array]] = {"plain": _plain, "symlog": _symlog}


def _symexp(x: np.ndarray) -> np.ndarray:
    return np.sign(x) * np.expm1(np.abs(x))


# The inverses of the encodings.
DECODINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"plain": _plain, "symlog": _symexp}


# Applied to what the last layer returns, before it is clipped to [-1, 1].
OUTPUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"clip": _plain, "tanh": np.tanh}


@dataclass(frozen=True)
class PolicyInfo:
    """The content of `policy.json`.

    Attributes:
        task: name of the task that the policy was trained for.
        task_version: version of that task.
        physics: fingerprint of the task's MJCF (`sim.model.fingerprint`).
        method: name of the method that trained the policy.
        activation: activation of the hidden layers, a name in `ACTIVATIONS`.
        layers: sizes of the layers from observation to action.
        sha256: hash of `policy.safetensors`.
        encoding: encoding of observations before normalisation, a name in `ENCODINGS`.
        format: version of the file format.
        output: what is applied to the last layer, a name in `OUTPUTS`.
        bound: normalised observations are clipped to [-bound, bound]; None for no bound.
    """

    task: str
    task_version: int
    physics: str
    method: str
    activation: str
    layers: tuple[int, ...]
    sha256: str = ""
    encoding: str = "plain"
    format: int = FORMAT
    output: str = "clip"
    bound: float | None = None


@dataclass(frozen=True)
class Policy:
    """A multilayer perceptron with its observation normaliser: observation -> action.

    Attributes:
        info: origin of the policy and layout of the network.
        mean: mean of the encoded observations in training, shape (n,), float32.
        scale: divisor of deviations from the mean, shape (n,), float32.
        weights: one array for each layer, shape (outputs, inputs), float32.
        biases: one array for each layer, shape (outputs,), float32.
    """

    info: PolicyInfo
    mean: np.ndarray
    scale: np.ndarray
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]

    def __repr__(self) -> str:
        layers = " to ".join(map(str, self.info.layers))
        return f"<Policy of {self.info.method} for {self.info.task}: {layers}>"

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Deterministic actions (..., m) in [-1, 1], float64, for observations (..., n).

        Each row is computed on its own: matrix products over several rows round differently, and
        an action must not depend on the other rows of the batch.
        """
        activation = ACTIVATIONS[self.info.activation]
        # Numbers that overflow end an episode (`sim.dynamics.expect_finite`), without a warning.
        with np.errstate(over="ignore", invalid="ignore"):
            encoded = ENCODINGS[self.info.encoding](np.asarray(observation, np.float32))
            x = (encoded - self.mean) / self.scale
            if self.info.bound is not None:
                x = np.clip(x, -self.info.bound, self.info.bound)
            last = len(self.weights) - 1
            for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
                x = (weight @ x[..., None])[..., 0] + bias  # one matrix-vector product per row
                if i < last:
                    x = activation(x)
            x = OUTPUTS[self.info.output](x)
        return np.clip(x, -1.0, 1.0).astype(np.float64)

    def _content(self) -> bytes:
        """The bytes of `policy.safetensors`."""
        tensors = {"mean": self.mean, "scale": self.scale}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            tensors[f"weight_{i}"] = np.ascontiguousarray(weight)
            tensors[f"bias_{i}"] = np.ascontiguousarray(bias)
        return save(tensors)

    @property
    def sha256(self) -> str:
        """Hash of `policy.safetensors`, whether saved or not."""
        return hashlib.sha256(self._content()).hexdigest()

    def save(self, directory: Path | str) -> None:
        """Writes policy.safetensors and policy.json into the directory.

        Raises:
            OSError: a file cannot be written.
            TsbenchError: an array is not of type float32, so `load` would refuse it.
        """
        for array in (self.mean, self.scale, *self.weights, *self.biases):
            if array.dtype != np.float32:
                raise TsbenchError(f"the arrays of a policy are float32, not {array.dtype}")
        directory = Path(directory)
        content = self._content()
        info = asdict(self.info) | {"sha256": hashlib.sha256(content).hexdigest()}
        write_whole(directory / "policy.safetensors", content)
        write_whole(directory / "policy.json", encode_info(info))

    @classmethod
    def load(cls, directory: Path | str) -> Policy:
        """Reads a policy that `save` has written.

        Raises:
            TsbenchError: a file is missing or damaged, or the files do not belong together.
        """
        directory = Path(directory)
        info = _read_info(directory / "policy.json")
        path = directory / "policy.safetensors"
        content = read_file(path, MAX_FILE, "policy file")
        if hashlib.sha256(content).hexdigest() != info.sha256:
            raise TsbenchError(f"{path} is not the file that policy.json describes (hash differs)")
        try:
            if int.from_bytes(content[:8], "little") > MAX_HEADER:
                raise ValueError(f"its header is larger than {MAX_HEADER:,} bytes")
            tensors = load(content)
            count = len(info.layers) - 1
            expected_names = {"mean", "scale"}
            expected_names |= {f"{kind}_{i}" for kind in ("weight", "bias") for i in range(count)}
            if differing := sorted(set(tensors) ^ expected_names):
                raise ValueError(f"missing or unknown tensors: {', '.join(differing)}")
            for name, tensor in tensors.items():
                if tensor.dtype != np.float32:
                    raise ValueError(f"{name} is of type {tensor.dtype}, not float32")
            policy = cls(
                info=info,
                mean=tensors["mean"],
                scale=tensors["scale"],
                weights=tuple(tensors[f"weight_{i}"] for i in range(count)),
                biases=tuple(tensors[f"bias_{i}"] for i in range(count)),
            )
        except (SafetensorError, KeyError, ValueError) as error:
            raise TsbenchError(f"damaged policy file {path}: {error}") from None
        shapes = [policy.mean.shape, policy.scale.shape]
        shapes += [weight.shape for weight in policy.weights]
        shapes += [bias.shape for bias in policy.biases]
        sizes = info.layers
        expected: list[tuple[int, ...]] = [(sizes[0],), (sizes[0],)]
        expected += list(zip(sizes[1:], sizes[:-1], strict=True))
        expected += [(size,) for size in sizes[1:]]
        if shapes != expected:
            raise TsbenchError(f"damaged policy file {path}: shapes do not fit the layers {sizes}")
        if not all(np.all(np.isfinite(tensor)) for tensor in tensors.values()):
            raise TsbenchError(f"damaged policy file {path}: values that are not finite")
        if np.any(policy.scale <= 0.0):
            raise TsbenchError(f"damaged policy file {path}: the scale must be positive")
        return policy


def encode_info(info: Mapping[str, Any]) -> bytes:
    """The bytes of a `policy.json`."""
    return (json.dumps(info, indent=2) + "\n").encode()


def _read_info(path: Path) -> PolicyInfo:
    try:
        info: PolicyInfo = typed(PolicyInfo, read_json(path, MAX_INFO, "policy file"), "")
    except TsbenchError as error:
        if str(path) in str(error):
            raise
        raise TsbenchError(f"damaged policy file {path}: {error}") from None
    if info.format != FORMAT:
        raise TsbenchError(f"{path} has format {info.format}; this tsbench reads {FORMAT}")
    if info.activation not in ACTIVATIONS:
        raise unknown(f"activation in {path}", str(info.activation), ACTIVATIONS)
    if info.encoding not in ENCODINGS:
        raise unknown(f"encoding in {path}", str(info.encoding), ENCODINGS)
    if info.output not in OUTPUTS:
        raise unknown(f"output in {path}", str(info.output), OUTPUTS)
    if info.bound is not None and info.bound <= 0.0:
        raise TsbenchError(f"damaged policy file {path}: the bound must be positive")
    if not 2 <= len(info.layers) <= MAX_LAYERS + 1 or min(info.layers) < 1:
        layers = f"{quoted(info.layers)}, {MAX_LAYERS} layers at most"
        raise TsbenchError(f"damaged policy file {path}: layers {layers}")
    return info
