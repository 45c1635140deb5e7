"""Policies that tsbench did not train: functions, ONNX models and stable-baselines3 models.

A foreign policy gets one observation at a time. A network that gets many rows at once rounds
differently, and an action must depend on its own observation alone.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tsbench.core.errors import TsbenchError, quoted, unknown
from tsbench.core.files import read_file
from tsbench.core.policy import Policy
from tsbench.core.task import MDP

ONNX_TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}
MAX_FILE = 256 * 2**20  # bytes; with the state of its optimiser a model is thrice its network
REFUSED_OPERATORS = {
    "Loop", "Scan", "If", "Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike",
    "RandomUniform", "RandomUniformLike",
}  # fmt: skip
SB3_ALGORITHMS = ("A2C", "DDPG", "PPO", "SAC", "TD3")  # the algorithms with continuous actions


@dataclass(frozen=True)
class ForeignPolicy:
    """A policy made from any function of one observation.

    Attributes:
        answer: the function, from an observation (o,) to an action (a,).
        observation_size: o.
        action_size: a.
        sha256: hash of the policy's file, or None for a policy without a file.
        model: the model of stable-baselines3, or None.
    """

    answer: Callable[[np.ndarray], Any]
    observation_size: int
    action_size: int
    sha256: str | None = None
    model: Any = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, a) for observations (n, o).

        Raises:
            TsbenchError: an action has another shape, or values that are not finite.
        """
        return np.stack([self._act(row) for row in observation])

    def _act(self, observation: np.ndarray) -> np.ndarray:
        given = self.answer(observation)
        try:
            action = np.asarray(given, float)
        except (TypeError, ValueError):
            raise TsbenchError(
                f"the policy's action is not made of numbers: {quoted(given)}"
            ) from None
        if action.shape != (self.action_size,):
            raise TsbenchError(
                f"the policy's action has shape {action.shape}, not ({self.action_size},)"
            )
        if not np.all(np.isfinite(action)):
            raise TsbenchError("the policy's action holds values that are not finite")
        return action


def from_function(function: Callable[[np.ndarray], Any], mdp: MDP[Any]) -> ForeignPolicy:
    """A policy from a function of one observation (o,) that returns one action (a,).

    Each component of an action lies in [-1, 1].
    """
    return ForeignPolicy(function, mdp.observation_size, mdp.action_size)


def from_onnx(path: Path | str, mdp: MDP[Any]) -> ForeignPolicy:
    """A policy from an ONNX model with one input, (1, o) or (n, o). Its first output is the action.

    An ONNX file is data; it cannot run code of its own. One whose answers may depend on something
    else than the file and the observation, or which may never answer, is refused.

    Raises:
        TsbenchError: onnxruntime is missing, the file is damaged, or its sizes do not fit the task.
    """
    path = Path(path)
    runtime = extra("onnxruntime", "onnx")
    content = read(path)
    _check_graph(content, path)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1  # more threads would sum in another order
    try:
        session = runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions share no base class
        raise TsbenchError(f"damaged ONNX file {path}: {_line(error)}") from None
    inputs = session.get_inputs()
    size = mdp.observation_size
    # The number of rows is 1 or not fixed. ONNX writes a size that is not fixed as a name or None.
    fitting = [
        one
        for one in inputs
        if one.type in ONNX_TYPES
        and len(one.shape) == 2
        and one.shape[1] == size
        and (one.shape[0] == 1 or not isinstance(one.shape[0], int))
    ]
    if len(inputs) != 1 or not fitting:
        given = ", ".join(f"{one.type} {one.shape}" for one in inputs)
        raise TsbenchError(
            f"{path} takes {given}, not one input of floats (n, {size}) for {mdp.name}"
        )

    kind, name = ONNX_TYPES[fitting[0].type], fitting[0].name

    def answer(observation: np.ndarray) -> Any:
        try:
            first = session.run(None, {name: observation[None].astype(kind)})[0]
        except Exception as error:  # as above
            raise TsbenchError(f"{path} cannot be run: {_line(error)}") from None
        shape = first.shape if isinstance(first, np.ndarray) else None
        if shape is None or len(shape) != 2 or shape[0] != 1:
            given = "no array" if shape is None else f"shape {shape}"
            raise TsbenchError(f"{path} returns {given}, not (1, {mdp.action_size})")
        return first[0]

    return ForeignPolicy(
        answer, mdp.observation_size, mdp.action_size, hashlib.sha256(content).hexdigest()
    )


def _check_graph(content: bytes, path: Path) -> None:
    """
    Raises:
        TsbenchError: the file keeps weights in another file, which onnxruntime would look for in
            the current directory; or it holds loops or random numbers.
    """
    onnx = extra("onnx", "onnx")
    try:
        model = onnx.load_from_string(content)
    except Exception as error:  # protobuf's own
        raise TsbenchError(f"damaged ONNX file {path}: {_line(error)}") from None
    nodes, tensors = [], list(model.graph.initializer)
    for graph in (model.graph, *model.functions):
        nodes += graph.node
    for node in nodes:
        if node.op_type in REFUSED_OPERATORS:
            raise TsbenchError(f"{path} holds the operator {node.op_type}, which is not allowed")
        tensors += [one.t for one in node.attribute if one.HasField("t")]
    for tensor in tensors:
        if tensor.data_location == onnx.TensorProto.EXTERNAL:
            raise TsbenchError(f"{path} keeps weights in another file: save it as one file")


def from_sb3(path: Path | str, algorithm: str, mdp: MDP[Any]) -> ForeignPolicy:
    """A policy from a file that stable-baselines3 saved. It acts deterministically.

    Such a file can run any code when it is loaded. Load only files of people you trust.

    Raises:
        TsbenchError: stable-baselines3 is missing or has no such algorithm, the file is damaged,
            or its sizes do not fit the task.
    """
    path = Path(path)
    if algorithm not in SB3_ALGORITHMS:
        raise unknown("stable-baselines3 algorithm", algorithm, SB3_ALGORITHMS)
    baselines = extra("stable_baselines3", "sb3")
    content = read(path)
    try:
        model = getattr(baselines, algorithm).load(path, device="cpu")
    except Exception as error:  # pickle, zipfile and torch raise anything
        raise TsbenchError(f"damaged stable-baselines3 file {path}: {_line(error)}") from None
    return from_sb3_model(model, mdp, str(path), hashlib.sha256(content).hexdigest())


def from_sb3_model(
    model: Any, mdp: MDP[Any], name: str = "the model", sha256: str | None = None
) -> ForeignPolicy:
    """A policy from a loaded stable-baselines3 model. It acts deterministically.

    Raises:
        TsbenchError: the model's sizes do not fit the task.
    """
    sizes = (model.observation_space.shape, model.action_space.shape)
    if sizes != ((mdp.observation_size,), (mdp.action_size,)):
        raise TsbenchError(
            f"{name} maps observations {sizes[0]} to actions {sizes[1]}, not "
            f"({mdp.observation_size},) to ({mdp.action_size},) as {mdp.name} does"
        )

    def answer(observation: np.ndarray) -> Any:
        return model.predict(observation.astype(np.float32), deterministic=True)[0]

    return ForeignPolicy(answer, mdp.observation_size, mdp.action_size, sha256, model)


def load(path: Path, mdp: MDP[Any], sb3: str | None = None) -> Policy | ForeignPolicy:
    """Loads a policy from its directory, an ONNX file or a stable-baselines3 file.

    Args:
        path: the directory or file.
        mdp: the task in which the policy will act.
        sb3: the algorithm that saved a stable-baselines3 file. Naming it means that the caller
            trusts the file.

    Raises:
        TsbenchError: the policy does not exist, is damaged, or does not fit the task.
    """
    if path.is_dir():
        return Policy.load(path)
    if not path.exists():
        raise TsbenchError(f"no policy {path}")
    if sb3 is not None:
        return from_sb3(path, sb3, mdp)
    if path.suffix == ".onnx":
        return from_onnx(path, mdp)
    if path.suffix == ".zip":
        raise TsbenchError(
            f"{path}: a stable-baselines3 file can run any code when it is loaded; "
            f"if you trust it: --trust-sb3 {'|'.join(SB3_ALGORITHMS)}"
        )
    raise TsbenchError(f"{path} is neither a run directory nor an .onnx or .zip file")


def extra(package: str, extra: str) -> Any:
    """A package that an extra of tsbench brings.

    Raises:
        TsbenchError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError:
        raise TsbenchError(f"{package} is missing: pip install 'tsbench[{extra}]'") from None


def read(path: Path) -> bytes:
    """The content of a policy's file.

    Raises:
        TsbenchError: as `read_file`.
    """
    return read_file(path, MAX_FILE, "policy file")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
