"""Policies that tsbench did not train: functions, torch modules, ONNX and stable-baselines3 models.

A foreign policy gets one observation at a time. A network that gets many rows at once rounds
differently, and an action must depend on its own observation alone: what has a memory or draws
random numbers is refused. What belongs to a model (statistics that normalise its observations,
weights in files of their own) is part of the policy and of its hash.
"""

from __future__ import annotations

import copy
import hashlib
import importlib
import io
import pickle
import sys
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
    "Loop", "Scan", "If", "SequenceMap", "Bernoulli", "Multinomial", "RandomNormal",
    "RandomNormalLike", "RandomUniform", "RandomUniformLike", "LSTM", "GRU", "RNN",
}  # fmt: skip
# The algorithms with continuous actions, and the packages that bring them.
SB3_ALGORITHMS = {
    **dict.fromkeys(("A2C", "DDPG", "PPO", "SAC", "TD3"), "stable_baselines3"),
    **dict.fromkeys(("ARS", "CrossQ", "RecurrentPPO", "TQC", "TRPO"), "sb3_contrib"),
}
REPEATED = 1e-6  # by which an action may differ when its observation is given again


@dataclass(frozen=True)
class Statistics:
    """What VecNormalize of stable-baselines3 does to observations.

    Attributes:
        mean: subtracted from an observation, shape (o,).
        scale: by which it is then divided, shape (o,).
        bound: to which it is then clipped.
    """

    mean: np.ndarray
    scale: np.ndarray
    bound: float

    @classmethod
    def of(cls, normalize: Any) -> Statistics | None:
        """The present statistics of a VecNormalize; None if it leaves observations alone.

        Raises:
            AttributeError, TypeError: it is something else.
        """
        if not normalize.norm_obs:
            return None
        variance = np.array(normalize.obs_rms.var, np.float64)
        mean = np.array(normalize.obs_rms.mean, np.float64)
        return cls(mean, np.sqrt(variance + normalize.epsilon), float(normalize.clip_obs))

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        return np.clip((observation - self.mean) / self.scale, -self.bound, self.bound)


@dataclass(frozen=True)
class ForeignPolicy:
    """A policy made from any function of one observation.

    Attributes:
        answer: the function, from an observation (o,) to an action (a,).
        observation_size: o.
        action_size: a.
        sha256: hash of the policy's files (`digest`), or None for a policy without a file.
        model: the model of stable-baselines3, or None.
        statistics: by which the model's observations are normalised, or None.
    """

    answer: Callable[[np.ndarray], Any]
    observation_size: int
    action_size: int
    sha256: str | None = None
    model: Any = None
    statistics: Statistics | None = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (n, a) for observations (n, o).

        Raises:
            TsbenchError: an action has another shape, or values that are not finite; or the first
                observation, given once more after the others, gets another action.
        """
        actions = np.stack([self._act(row) for row in observation])
        if np.abs(self._act(observation[0]) - actions[0]).max() > REPEATED:
            raise TsbenchError(
                "the policy has a memory or draws random numbers: given an observation again it "
                "acts differently, but an action must depend on its observation alone"
            )
        return actions

    def _act(self, observation: np.ndarray) -> np.ndarray:
        given = self.answer(observation)
        if hasattr(given, "detach"):  # a tensor of torch, perhaps with a gradient or on a GPU
            given = given.detach().cpu().double().numpy()
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


def made(policy: Any, mdp: MDP[Any]) -> ForeignPolicy:
    """A policy from a model of another library that is in memory, or from a function.

    Most models can be called too, but with other arguments than a function of one observation, so
    whether it can be called is asked last.

    Raises:
        TsbenchError: it is something else, or does not fit the task.
    """
    torch = sys.modules.get("torch")
    if isinstance(policy, type):
        raise TsbenchError(f"a policy must be a model, a file or a function, not a class: {policy}")
    if all(hasattr(policy, name) for name in ("predict", "observation_space", "action_space")):
        return from_sb3_model(policy, mdp)
    if torch is not None and isinstance(policy, torch.nn.Module):
        return from_torch(policy, mdp)
    if callable(policy):
        return from_function(policy, mdp)
    kind = type(policy).__name__
    raise TsbenchError(f"a policy must be a model, a file or a function, not {kind}")


def from_function(function: Callable[[np.ndarray], Any], mdp: MDP[Any]) -> ForeignPolicy:
    """A policy from a function of one observation (o,) that returns one action (a,), as an array, a
    list or a tensor. Each component of an action lies in [-1, 1].
    """
    return ForeignPolicy(function, mdp.observation_size, mdp.action_size)


def from_torch(module: Any, mdp: MDP[Any]) -> ForeignPolicy:
    """A policy from a torch module that takes observations (n, o), or from an actor of rsl-rl.

    A copy of the module acts, in evaluation mode: training may go on meanwhile.

    Raises:
        TsbenchError: the module has a memory, or does not fit the task.
    """
    torch = importlib.import_module("torch")  # evaluation starts without it
    module, size = plain_module(module), mdp.observation_size
    weight = next((one for one in module.parameters() if one.is_floating_point()), torch.zeros(1))

    def answer(observation: np.ndarray) -> Any:
        given = torch.as_tensor(observation[None], dtype=weight.dtype, device=weight.device)
        try:
            with torch.no_grad():
                actions = module(given)
        except Exception as error:  # whatever a module raises
            raise TsbenchError(f"the module does not take (1, {size}): {_line(error)}") from None
        shape = tuple(actions.shape) if isinstance(actions, torch.Tensor) else None
        if shape is None or len(shape) != 2 or shape[0] != 1:
            what = f"a {type(actions).__name__}" if shape is None else f"shape {shape}"
            raise TsbenchError(f"the module returns {what}, not (1, {mdp.action_size})")
        return actions[0]

    policy = ForeignPolicy(answer, size, mdp.action_size)
    policy(np.zeros((1, size)))
    return policy


def plain_module(module: Any) -> Any:
    """A copy of a torch module in evaluation mode. An actor of rsl-rl takes observations by group;
    of it, this is the network that takes them as one tensor.

    Raises:
        TsbenchError: the module has a memory, or cannot be copied.
    """
    nn = importlib.import_module("torch").nn
    if any(isinstance(one, (nn.RNNBase, nn.RNNCellBase)) for one in module.modules()):
        raise TsbenchError(f"the module {type(module).__name__} has a memory, a policy has none")
    try:
        return copy.deepcopy(module.as_jit() if hasattr(module, "as_jit") else module).eval()
    except Exception as error:  # whatever a module raises
        raise TsbenchError(f"the module cannot be copied: {_line(error)}") from None


def from_onnx(path: Path | str, mdp: MDP[Any]) -> ForeignPolicy:
    """A policy from an ONNX model with one input, (1, o) or (n, o). Its first output is the action.

    An ONNX file is data; it cannot run code of its own. One whose answers may depend on something
    else than its files and the observation, or which may never answer, is refused.

    Raises:
        TsbenchError: onnxruntime is missing, a file is damaged, or its sizes do not fit the task.
    """
    path = Path(path)
    runtime = extra("onnxruntime", "onnx")
    model, sha256 = read_onnx(path)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1  # more threads would sum in another order
    try:
        session = runtime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
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

    return ForeignPolicy(answer, mdp.observation_size, mdp.action_size, sha256)


def read_onnx(path: Path) -> tuple[Any, str]:
    """An ONNX model as one piece, and the hash of its files.

    Weights may lie in files beside the model, as torch writes them. onnxruntime itself would look
    for them in the current directory.

    Raises:
        TsbenchError: a file is missing or damaged, weights lie in another directory, or the model
            holds a memory, loops or random numbers.
    """
    onnx = extra("onnx", "onnx")
    content = read(path)
    try:
        model = onnx.load_from_string(content)
    except Exception as error:  # protobuf's own
        raise TsbenchError(f"damaged ONNX file {path}: {_line(error)}") from None
    nodes, tensors = [], list(model.graph.initializer)
    for sparse in model.graph.sparse_initializer:
        tensors += [sparse.values, sparse.indices]
    for graph in (model.graph, *model.functions):
        nodes += graph.node
    for node in nodes:
        if node.op_type in REFUSED_OPERATORS:
            raise TsbenchError(
                f"{path} holds the operator {node.op_type}: memory, loops and random numbers are "
                "not allowed"
            )
        for one in node.attribute:
            tensors += [*([one.t] if one.HasField("t") else []), *one.tensors]
    beside: dict[str, bytes] = {}
    for tensor in tensors:
        if tensor.data_location == onnx.TensorProto.EXTERNAL:
            _bring_in(tensor, path, beside)
    return model, digest(content, *(beside[name] for name in sorted(beside)))


def _bring_in(tensor: Any, path: Path, beside: dict[str, bytes]) -> None:
    """Copies a tensor's values from a file beside the model into the model.

    Args:
        tensor: that keeps its values elsewhere.
        path: the model.
        beside: the files read so far, by name.

    Raises:
        TsbenchError: the file is missing, lies in another directory, or lacks the values.
    """
    entries = {one.key: one.value for one in tensor.external_data}
    name = entries.get("location", "")
    if name in ("", "..") or Path(name).name != name:
        raise TsbenchError(
            f"{path} keeps weights in {quoted(name)}: only files beside it are read; "
            "save it as one file"
        )
    if name not in beside:
        beside[name] = read(path.parent / name)
    content = beside[name]
    try:
        begin = int(entries.get("offset", 0))
        end = begin + int(entries.get("length", len(content) - begin))
    except ValueError:
        begin = end = -1
    if not 0 <= begin <= end <= len(content):
        raise TsbenchError(f"damaged ONNX file {path}: {quoted(name)} lacks some of its weights")
    tensor.raw_data = content[begin:end]
    tensor.ClearField("external_data")
    tensor.ClearField("data_location")


def from_sb3(
    path: Path | str, algorithm: str, mdp: MDP[Any], vecnormalize: Path | None = None
) -> ForeignPolicy:
    """A policy from a file that stable-baselines3 saved. It acts deterministically.

    Such a file can run any code when it is loaded. Load only files of people you trust.

    Args:
        path: the model's file.
        algorithm: that saved it, a name in `SB3_ALGORITHMS`.
        mdp: the task in which the policy will act.
        vecnormalize: the file of the model's VecNormalize, which can run any code too.

    Raises:
        TsbenchError: stable-baselines3 is missing or has no such algorithm, a file is damaged, the
            model was trained with VecNormalize and its file is missing, or the model does not fit
            the task or has a memory.
    """
    path = Path(path)
    if algorithm not in SB3_ALGORITHMS:
        raise unknown("stable-baselines3 algorithm", algorithm, SB3_ALGORITHMS)
    package = extra(SB3_ALGORITHMS[algorithm], "sb3")
    content = [read(path)]
    try:
        model = getattr(package, algorithm).load(io.BytesIO(content[0]), device="cpu")
    except Exception as error:  # pickle, zipfile and torch raise anything
        raise TsbenchError(
            f"damaged stable-baselines3 file {path}, or not one that {algorithm} saved: "
            f"{_line(error)}"
        ) from None
    normalize = None
    if vecnormalize is not None:
        content.append(read(vecnormalize))
        try:
            normalize = pickle.loads(content[1])
            Statistics.of(normalize)
        except Exception as error:  # pickle raises anything
            raise TsbenchError(f"{vecnormalize} is no VecNormalize file: {_line(error)}") from None
    return from_sb3_model(model, mdp, str(path), digest(*content), normalize)


def from_sb3_model(
    model: Any,
    mdp: MDP[Any],
    name: str = "the model",
    sha256: str | None = None,
    normalize: Any = None,
) -> ForeignPolicy:
    """A policy from a model of stable-baselines3, or from its `policy`. It acts deterministically.

    Args:
        model: the model.
        mdp: the task in which the policy will act.
        name: the model in words, for messages.
        sha256: hash of its files.
        normalize: the model's VecNormalize; None for that of the model's own environment, if any.

    Raises:
        TsbenchError: the model's spaces are not the task's, it has a memory, or it was trained with
            VecNormalize and there is none.
    """
    sizes = (model.observation_space.shape, model.action_space.shape)
    if sizes != ((mdp.observation_size,), (mdp.action_size,)):
        raise TsbenchError(
            f"{name} maps observations {sizes[0]} to actions {sizes[1]}, not "
            f"({mdp.observation_size},) to ({mdp.action_size},) as {mdp.name} does"
        )
    low, high = model.action_space.low.min(), model.action_space.high.max()
    if np.any(model.action_space.low != -1.0) or np.any(model.action_space.high != 1.0):
        raise TsbenchError(f"the actions of {name} lie in [{low:g}, {high:g}], not in [-1, 1]")
    if normalize is None and hasattr(model, "get_vec_normalize_env"):
        normalize = model.get_vec_normalize_env()
    if normalize is None and getattr(model, "_last_original_obs", None) is not None:
        raise TsbenchError(
            f"{name} was trained with VecNormalize, whose statistics are missing: "
            "--vecnormalize FILE, or set_env(...) for a model in memory"
        )
    statistics = None if normalize is None else Statistics.of(normalize)
    if statistics is not None and statistics.mean.shape != (mdp.observation_size,):
        raise TsbenchError(f"the statistics of VecNormalize are of other sizes than {name}")

    def answer(observation: np.ndarray) -> Any:
        given = observation if statistics is None else statistics(observation)
        action, memory = model.predict(given.astype(np.float32), deterministic=True)
        if memory is not None:
            raise TsbenchError(f"{name} has a memory, a policy has none")
        return action

    policy = ForeignPolicy(answer, mdp.observation_size, mdp.action_size, sha256, model, statistics)
    policy(np.zeros((1, mdp.observation_size)))
    return policy


def load(
    path: Path, mdp: MDP[Any], sb3: str | None = None, vecnormalize: Path | None = None
) -> Policy | ForeignPolicy:
    """Loads a policy from its directory, an ONNX file or a stable-baselines3 file.

    Args:
        path: the directory or file.
        mdp: the task in which the policy will act.
        sb3: the algorithm that saved a stable-baselines3 file. Naming it means that the caller
            trusts the file, and that of VecNormalize.
        vecnormalize: the file of the model's VecNormalize.

    Raises:
        TsbenchError: the policy does not exist, is damaged, or does not fit the task.
    """
    if vecnormalize is not None and sb3 is None:
        raise TsbenchError("--vecnormalize belongs to a stable-baselines3 file")
    if path.is_dir():
        return Policy.load(path)
    if not path.exists():
        raise TsbenchError(f"no policy {path}")
    if sb3 is not None:
        return from_sb3(path, sb3, mdp, vecnormalize)
    if path.suffix == ".onnx":
        return from_onnx(path, mdp)
    if path.suffix == ".zip":
        raise TsbenchError(
            f"{path}: a stable-baselines3 file can run any code when it is loaded; "
            f"if you trust it: --trust-sb3 {'|'.join(sorted(SB3_ALGORITHMS))}"
        )
    if path.suffix in (".pt", ".pth"):
        raise TsbenchError(f"{path} holds weights of torch: make a policy of it by tsbench export")
    raise TsbenchError(f"{path} is neither a run directory nor an .onnx or .zip file")


def digest(*contents: bytes) -> str:
    """The hash of a policy's files: of one file its sha256, of several the sha256 of theirs."""
    hashes = [hashlib.sha256(content) for content in contents]
    if len(hashes) == 1:
        return hashes[0].hexdigest()
    return hashlib.sha256(b"".join(one.digest() for one in hashes)).hexdigest()


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
