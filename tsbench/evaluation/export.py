"""Policies of other libraries, written as tsbench's own file (`core.policy`).

Such a file can hold a multilayer perceptron: observations normalised and perhaps clipped, linear
layers with one activation between them, and a tanh or nothing before the actions are clipped to
[-1, 1]. A network is read as a chain of such operations; whatever else is in it, is refused with
its name. What was written is compared with the model's own answers.
"""

from __future__ import annotations

import importlib
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tsbench.core.errors import TsbenchError, quoted
from tsbench.core.policy import ACTIVATIONS, DECODINGS, Policy, PolicyInfo
from tsbench.core.task import MDP, Task
from tsbench.evaluation import foreign
from tsbench.evaluation.evaluate import check_fit
from tsbench.evaluation.protocol import V1, perturbed_starts
from tsbench.sim.model import fingerprint
from tsbench.sim.physics import Physics

SAME = 1e-4  # by which actions may differ: float32 sums in another order, over some layers
SAMPLES = 400  # random observations of the comparison, beside those of the perturbed starts
PRODUCER = "tsbench"  # in the ONNX files that `deploy` writes
RSL_EPSILON = 1e-2  # of EmpiricalNormalization in rsl_rl/modules/normalization.py

# Names of operations in torch and ONNX.
_ACTIVATIONS = {"ELU": "elu", "Elu": "elu", "ReLU": "relu", "Relu": "relu", "Tanh": "tanh"}
_NOTHING = {"Identity", "Flatten", "Dropout", "Cast", "_IdentityDeterministicOutput"}
_ROWS = {"Sequential", "MLP", "_TorchMLPModel"}  # of torch and rsl-rl: each child after the other


@dataclass
class Found:
    """A network as far as it was read.

    Attributes:
        size: of the observations.
        answer: observations (n, o) -> actions (n, a) by the model itself.
        shift: subtracted from observations, shape (o,).
        scale: by which they are then divided, shape (o,).
        bound: to which they are then clipped, or None.
        weights: shape (outputs, inputs) each.
        biases: shape (outputs,) each.
        activations: after each layer but the last; None after the last where nothing follows.
    """

    size: int
    answer: Callable[[np.ndarray], np.ndarray]
    shift: np.ndarray = field(default_factory=lambda: np.zeros(0))
    scale: np.ndarray = field(default_factory=lambda: np.ones(0))
    bound: float | None = None
    weights: list[np.ndarray] = field(default_factory=list)
    biases: list[np.ndarray] = field(default_factory=list)
    activations: list[str | None] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not len(self.shift):
            self.shift, self.scale = np.zeros(self.size), np.ones(self.size)

    def linear(self, weight: np.ndarray, bias: np.ndarray | None) -> None:
        """Adds a layer."""
        weight = np.asarray(weight, np.float64)
        if weight.ndim != 2:
            raise TsbenchError(f"a layer's weight has shape {weight.shape}")
        given = np.zeros(len(weight)) if bias is None else np.asarray(bias, np.float64).ravel()
        if len(given) != len(weight):
            raise TsbenchError(f"a layer has {len(weight)} outputs and {len(given)} biases")
        self.weights.append(weight)
        self.biases.append(given)
        self.activations.append(None)

    def add(self, values: np.ndarray) -> None:
        """Adds values: to the observations, or to the last layer."""
        if self.weights:
            if self.activations[-1] is not None:
                raise TsbenchError("it adds values after an activation")
            self.biases[-1] = self.biases[-1] + values
        else:
            if self.bound is not None:
                raise TsbenchError("it adds values to clipped observations")
            self.shift = self.shift - values * self.scale

    def multiply(self, values: np.ndarray) -> None:
        """Multiplies the observations by values."""
        if self.weights or self.bound is not None:
            raise TsbenchError("it scales something other than its observations")
        self.scale = self.scale / values

    def activate(self, name: str) -> None:
        """Adds an activation after the last layer."""
        if not self.weights:
            raise TsbenchError(f"it begins with {name} instead of a linear layer")
        if self.activations[-1] is not None:
            raise TsbenchError(f"it applies {self.activations[-1]} and {name} in a row")
        self.activations[-1] = name

    def clip(self, low: float, high: float) -> None:
        """Clips the observations, or the actions to [-1, 1]."""
        if self.weights:
            if (low, high) != (-1.0, 1.0):
                raise TsbenchError(f"it clips to [{low:g}, {high:g}], not to [-1, 1]")
            return
        if low != -high or self.bound is not None:
            raise TsbenchError(f"it clips its observations to [{low:g}, {high:g}]")
        self.bound = float(high)


def read(
    path: Path,
    mdp: MDP[Any],
    *,
    algorithm: str | None = None,
    vecnormalize: Path | None = None,
    activation: str | None = None,
) -> Found:
    """The network in a file.

    Args:
        path: an ONNX file, a state dict that torch saved, a checkpoint of rsl-rl, or a
            stable-baselines3 file.
        mdp: that the policy is for.
        algorithm: of stable-baselines3, which says that whoever asks trusts both files.
        vecnormalize: the statistics of stable-baselines3's VecNormalize, or None.
        activation: of the hidden layers in a state dict, which does not say it.

    Raises:
        TsbenchError: the file is damaged, or holds something that the policy file cannot express.
    """
    if algorithm is not None or vecnormalize is not None or path.suffix == ".zip":
        policy = foreign.load(path, mdp, algorithm, vecnormalize)
        assert isinstance(policy, foreign.ForeignPolicy)
        return from_sb3(policy)
    if path.suffix == ".onnx":
        return from_onnx(path, mdp)
    if path.suffix in (".pt", ".pth"):
        return from_state_dict(path, mdp, activation)
    raise TsbenchError(f"{path} is no .onnx, .zip or .pt file")


def from_torch(module: Any, size: int) -> Found:
    """A torch module made of linear layers and activations in a row, or an actor of rsl-rl.

    Raises:
        TsbenchError: it holds something else.
    """
    torch = importlib.import_module("torch")  # evaluation starts without it
    module = foreign.plain_module(module)

    def answer(observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            given = torch.as_tensor(observation, dtype=torch.float32)
            return np.asarray(module(given).numpy(), np.float64)

    found = Found(size, answer)
    _add_modules(found, _leaves(module))
    return found


def from_sb3(policy: foreign.ForeignPolicy) -> Found:
    """A stable-baselines3 model, with the statistics of its VecNormalize if it had one.

    Raises:
        TsbenchError: the model is of another kind than an MlpPolicy.
    """
    model = policy.model
    net = getattr(model, "policy", model)
    found = Found(policy.observation_size, policy)
    if (statistics := policy.statistics) is not None:
        found.shift, found.scale, found.bound = statistics.mean, statistics.scale, statistics.bound
    extractor = type(getattr(net, "features_extractor", None) or net.actor.features_extractor)
    if extractor.__name__ != "FlattenExtractor":
        raise TsbenchError(f"its observations go through {extractor.__name__}")
    if getattr(model, "use_sde", False):
        raise TsbenchError("it was trained with state-dependent exploration (use_sde)")
    actor = getattr(net, "actor", None)
    if actor is None:  # PPO and A2C: tanh or what was asked for, actions clipped
        shared = getattr(net, "mlp_extractor", None)  # ARS has none: one network, perhaps squashed
        hidden = () if shared is None else _leaves(shared.policy_net)
        _add_modules(found, [*hidden, *_leaves(net.action_net)])
    elif hasattr(actor, "latent_pi"):  # SAC: the mean, squashed
        _add_modules(found, [*_leaves(actor.latent_pi), *_leaves(actor.mu)])
        if not found.activations[-1]:
            found.activate("tanh")
    else:  # TD3 and DDPG
        _add_modules(found, _leaves(actor.mu))
    return found


def from_state_dict(path: Path, mdp: MDP[Any], activation: str | None) -> Found:
    """The linear layers of a state dict in the order in which it has them, or of the actor in a
    checkpoint of rsl-rl with its normaliser.

    Raises:
        TsbenchError: the file holds other tensors, or nobody says the activation.
    """
    if activation not in ACTIVATIONS:
        raise TsbenchError(
            f"{path} says no activation: --activation {'|'.join(sorted(ACTIVATIONS))}"
        )
    torch = importlib.import_module("torch")
    if _is_script(path):
        raise TsbenchError(
            f"{path} is TorchScript, which is code: take the checkpoint (model_N.pt) or ONNX"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        arrays = {str(name): tensor.numpy() for name, tensor in _actor(content).items()}
    except Exception as error:  # torch and zipfile raise anything
        raise TsbenchError(f"{path} holds no state dict of plain tensors: {error}") from None
    if any(name.startswith(("rnn.", "memory_a.")) for name in arrays):
        raise TsbenchError(f"{path} holds an actor with a memory, a policy has none")
    found = Found(mdp.observation_size, lambda observation: _forward(found, observation))
    statistics = {name: arrays.pop(name) for name in list(arrays) if _NORMALISER in name}
    if statistics:
        values = {name.rpartition(".")[2]: array.ravel() for name, array in statistics.items()}
        if not {"_mean", "_std"} <= values.keys() or len(values["_mean"]) != found.size:
            raise TsbenchError(f"{path} holds a normaliser of another kind or size")
        found.shift, found.scale = values["_mean"], values["_std"] + RSL_EPSILON
    weights = {name: array for name, array in arrays.items() if name.endswith("weight")}
    biases = {name: array for name, array in arrays.items() if name.endswith("bias")}
    for name in arrays.keys() - weights.keys() - biases.keys():
        raise TsbenchError(f"{path} holds {quoted(name)}, which is no weight or bias of a layer")
    for name, weight in weights.items():
        if found.weights:
            found.activate(str(activation))
        found.linear(weight, biases.pop(f"{name.removesuffix('weight')}bias", None))
    for name in biases:
        raise TsbenchError(f"{path} holds {quoted(name)} without its weight")
    return found


_NORMALISER = "obs_normalizer."
# What a checkpoint of rsl-rl holds beside the actor: the critic, and the noise of exploration.
_NO_ACTOR = ("critic", "privileged_", "memory_c.", "distribution.", "std", "log_std")


def _actor(content: Mapping[str, Any]) -> dict[str, Any]:
    """The tensors of a state dict; of a checkpoint of rsl-rl, the actor's and its normaliser's.

    Releases 4 and 5 keep the actor apart. Before, critic and noise lie in the same mapping; release
    2 keeps the normaliser beside it.
    """
    for key in ("actor_state_dict", "student_state_dict", "model_state_dict"):
        if key in content:
            beside = content.get("obs_norm_state_dict", {})
            tensors = {f"{_NORMALISER}{name}": tensor for name, tensor in beside.items()}
            return tensors | {
                name: tensor
                for name, tensor in content[key].items()
                if not name.startswith(_NO_ACTOR)
            }
    return dict(content)


def _is_script(path: Path) -> bool:
    """Whether a file is TorchScript."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def _forward(found: Found, x: np.ndarray) -> np.ndarray:
    """The network in float64, where no model is there to ask."""
    x = (x - found.shift) / found.scale
    for weight, bias, name in zip(found.weights, found.biases, found.activations, strict=True):
        x = x @ weight.T + bias
        x = ACTIVATIONS[name](x) if name else x
    return x


def from_onnx(path: Path, mdp: MDP[Any]) -> Found:
    """The chain of operations in an ONNX file.

    Raises:
        TsbenchError: it is no chain, or holds operations that the policy file cannot express.
    """
    policy = foreign.from_onnx(path, mdp)  # also refuses files of other sizes
    onnx = foreign.extra("onnx", "onnx")
    model = foreign.read_onnx(path)[0]
    graph = model.graph
    values = {one.name: onnx.numpy_helper.to_array(one) for one in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            values[node.output[0]] = _constant(onnx, node, path)
    found = Found(mdp.observation_size, policy)
    (given,) = (one.name for one in graph.input if one.name not in values)
    nodes = [node for node in graph.node if node.op_type != "Constant"]
    for node in nodes:  # in the order of computation, as ONNX demands
        names = list(node.input)
        if names.count(given) != 1 or len(node.output) != 1:
            raise TsbenchError(f"{path} is no chain of operations: {node.op_type}")
        others = [values.get(name) for name in names if name != given]
        if any(other is None for other in others):
            raise TsbenchError(f"{path} is no chain of operations: {node.op_type}")
        attributes = {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute}
        try:
            _add_node(found, node.op_type, names.index(given), others, attributes)
        except TsbenchError as error:
            if model.producer_name == PRODUCER:  # the policy file can express more than a chain
                raise TsbenchError(
                    f"{path} is an export of tsbench: give the directory of the policy that it "
                    "was written from"
                ) from None
            raise TsbenchError(f"{path}: {error}") from None
        given = node.output[0]
    if given != graph.output[0].name:
        raise TsbenchError(f"{path} returns something else than the end of its chain")
    return found


def _constant(onnx: Any, node: Any, path: Path) -> np.ndarray:
    """The value of an ONNX Constant.

    Raises:
        TsbenchError: it is text or sparse.
    """
    (attribute,) = node.attribute
    value = onnx.helper.get_attribute_value(attribute)
    if attribute.name == "value":
        return np.asarray(onnx.numpy_helper.to_array(value))
    if attribute.name in ("value_float", "value_floats", "value_int", "value_ints"):
        return np.asarray(value)
    raise TsbenchError(
        f"{path} holds a Constant by {attribute.name}; allowed: value, value_float(s), value_int(s)"
    )


def _add_node(
    found: Found, kind: str, place: int, others: Sequence[Any], attributes: dict[str, Any]
) -> None:
    """Adds an ONNX operation whose input at `place` is what came before.

    Raises:
        TsbenchError: the policy file cannot express it.
    """
    if kind == "Gemm" and place == 0 and not attributes.get("transA"):
        weight = others[0] if attributes.get("transB") else others[0].T
        bias = attributes.get("beta", 1.0) * others[1] if len(others) > 1 else None
        found.linear(attributes.get("alpha", 1.0) * weight, bias)
    elif kind == "MatMul" and place == 0:
        found.linear(others[0].T, None)
    elif kind == "Add":
        found.add(_row(others[0]))
    elif kind == "Sub" and place == 0:
        found.add(-_row(others[0]))
    elif kind == "Div" and place == 0:
        found.multiply(1.0 / _row(others[0]))
    elif kind == "Mul":
        found.multiply(_row(others[0]))
    elif kind == "Clip" and len(others) == 2:
        found.clip(*(float(other) for other in others))
    elif kind == "Elu" and attributes.get("alpha", 1.0) != 1.0:
        raise TsbenchError(f"it has an Elu of alpha {attributes['alpha']:g}, not 1")
    elif kind in _ACTIVATIONS:
        found.activate(_ACTIVATIONS[kind])
    elif kind not in _NOTHING:
        raise TsbenchError(f"it has the operation {quoted(kind)}, which no policy file expresses")


def _row(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, np.float64).reshape(-1)


def _leaves(module: Any) -> Iterator[Any]:
    """The modules that a torch module is made of, in their order."""
    # Not `children`, which leaves out a module that is used again, as activations may be.
    inner, kind = list(module._modules.values()), type(module).__name__
    row = kind in _ROWS
    if not inner and not row:
        yield module
    elif not row:
        raise TsbenchError(f"it holds a {kind}, whose order nobody knows")
    for one in inner:
        yield from _leaves(one)


def _add_modules(found: Found, modules: Iterable[Any]) -> None:
    for module in modules:
        kind = type(module).__name__
        if kind == "Linear":
            bias = None if module.bias is None else module.bias.detach().numpy()
            found.linear(module.weight.detach().numpy(), bias)
        elif kind == "EmpiricalNormalization" and not found.weights:  # of rsl-rl
            found.add(-_row(module._mean.numpy()))
            found.multiply(1.0 / (_row(module._std.numpy()) + module.eps))
        elif kind == "ELU" and module.alpha != 1.0:
            raise TsbenchError(f"it has an ELU of alpha {module.alpha:g}, not 1")
        elif kind in _ACTIVATIONS:
            found.activate(_ACTIVATIONS[kind])
        elif kind not in _NOTHING:
            raise TsbenchError(f"it holds a {quoted(kind)}, which no policy file expresses")


def policy_of(found: Found, task: Task[Any], method: str) -> tuple[Policy, float]:
    """The policy, and by how much its actions differ from the model's own at most.

    Args:
        found: the network.
        task: that the policy is for.
        method: name of what made the policy.

    Raises:
        TsbenchError: the policy file cannot express the network, or its actions differ by more than
            `SAME`.
    """
    if not found.weights:
        raise TsbenchError("it has no linear layer")
    sizes = [found.size, *(len(weight) for weight in found.weights)]
    for weight, (before, _) in zip(found.weights, pairwise(sizes), strict=True):
        if weight.shape[1] != before:
            raise TsbenchError(f"a layer takes {weight.shape[1]} values and is given {before}")
    *hidden, last = found.activations
    kinds = sorted(set(map(str, hidden)))
    if len(kinds) > 1:
        raise TsbenchError(f"it has layers with different activations: {', '.join(kinds)}")
    if last not in (None, "tanh"):
        raise TsbenchError(f"it applies {last} to its actions")
    if kinds == ["None"]:
        raise TsbenchError("it has layers without an activation between them")
    if not method.isidentifier():
        raise TsbenchError(
            f"a method's name is made of letters, digits and _, not {quoted(method)}"
        )
    bound = found.bound
    policy = Policy(
        info=PolicyInfo(
            task=task.name,
            task_version=task.version,
            physics=fingerprint(task.spec()),
            method=method,
            activation=kinds[0] if kinds else "tanh",
            layers=tuple(sizes),
            output="tanh" if last else "clip",
            bound=None if bound is None or not np.isfinite(bound) else bound,
        ),
        mean=found.shift.astype(np.float32),
        scale=found.scale.astype(np.float32),
        weights=tuple(weight.astype(np.float32) for weight in found.weights),
        biases=tuple(bias.astype(np.float32) for bias in found.biases),
    )
    check_fit(policy, task)
    difference = _difference(policy, found, task)
    if not difference <= SAME:
        raise TsbenchError(
            f"the actions of the policy file differ by {difference:.2g} from the model's own"
        )
    return policy, difference


def _difference(policy: Policy, found: Found, task: Task[Any]) -> float:
    """The largest difference of an action, on perturbed starts and random observations."""
    seen = observations(policy, task)
    expected = np.clip(found.answer(seen), -1.0, 1.0)
    return float(np.abs(policy(seen) - expected).max())


def observations(policy: Policy, task: Task[Any]) -> np.ndarray:
    """Observations to compare a policy's actions on, shape (n, o): those of the perturbed starts,
    and `SAMPLES` random ones three times as wide as the policy has seen in training."""
    starts = perturbed_starts(task, V1)
    count = len(starts.time)
    physics: Physics[Any] = Physics(task, count, threads=1)
    seen = np.asarray(task.observation(physics.place(np.arange(count), starts)))
    draws = np.random.default_rng(0).normal(size=(SAMPLES, task.observation_size))
    encoded = policy.mean + 3.0 * policy.scale * draws.astype(np.float64)
    return np.concatenate([seen, DECODINGS[policy.info.encoding](encoded)])
