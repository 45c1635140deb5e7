"""A policy for robots: beside tsbench's own files as ONNX, and as torch code without tsbench.

The actions of each written file are compared with those of the policy that was exported.
"""

from __future__ import annotations

import importlib
import runpy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tsbench.core.errors import TsbenchError, os_errors
from tsbench.core.files import write_whole
from tsbench.core.policy import Policy
from tsbench.core.task import Task
from tsbench.evaluation import foreign
from tsbench.evaluation.export import PRODUCER, SAME, observations

OPSET = 17  # of ONNX, 2022: onnxruntime reads it from release 1.12 on
IR_VERSION = 8  # of ONNX's file format, which belongs to that opset
ONNX_FILE = "policy.onnx"
TORCH_FILE = "policy.py"
TORCH_CODE = Path(__file__).with_name("on_robot.py")
_OPERATORS = {"elu": "Elu", "relu": "Relu", "tanh": "Tanh"}
_SYMLOG = (  # x -> sign(x) log(1 + |x|)
    ("Sign", ("observation",), "sign"),
    ("Abs", ("observation",), "size"),
    ("Add", ("size", "one"), "grown"),
    ("Log", ("grown",), "logarithm"),
    ("Mul", ("sign", "logarithm"), "encoded"),
)


def write(
    policy: Policy,
    task: Task[Any],
    directory: Path,
    original: Callable[[np.ndarray], np.ndarray] | None = None,
) -> dict[str, float]:
    """Writes a policy into a new directory. Nothing is left if that fails.

    Args:
        policy: the policy.
        task: its task.
        directory: the new one.
        original: observations (n, o) -> actions (n, a) by what the policy was made from; None for
            the policy itself.

    Returns:
        By file, the largest difference of an action from the original's, over `observations`.

    Raises:
        TsbenchError: onnx or onnxruntime is missing, a file cannot be written, or its actions
            differ by more than `SAME`.
    """
    foreign.extra("onnx", "onnx"), foreign.extra("onnxruntime", "onnx")
    seen = observations(policy, task)
    expected = np.clip((original or policy)(seen), -1.0, 1.0)
    with os_errors(directory):
        directory.mkdir(parents=True)
        try:
            policy.save(directory)
            write_whole(directory / ONNX_FILE, as_onnx(policy, task))
            write_whole(directory / TORCH_FILE, TORCH_CODE.read_bytes())
            found = {
                "policy.safetensors": Policy.load(directory)(seen),
                ONNX_FILE: foreign.from_onnx(directory / ONNX_FILE, task)(seen),
                TORCH_FILE: _by_torch(directory, seen),
            }
            differences = {
                name: float(np.abs(actions - expected).max()) for name, actions in found.items()
            }
            for name, difference in differences.items():
                if not difference <= SAME:
                    raise TsbenchError(
                        f"the actions of {name} differ by {difference:.2g} from the model's own"
                    )
        except BaseException:
            shutil.rmtree(directory)
            raise
    return differences


def as_onnx(policy: Policy, task: Task[Any]) -> bytes:
    """An ONNX file of the policy: `observation` (rows, n) -> `action` (rows, m), float32, for any
    number of rows.

    Its metadata tell the task, its version, the seconds of a control step, the method, and the hash
    of policy.safetensors.

    Raises:
        TsbenchError: onnx is missing.
    """
    onnx = foreign.extra("onnx", "onnx")
    make, info = onnx.helper, policy.info
    arrays = {"mean": policy.mean, "scale": policy.scale}
    nodes: list[Any] = []
    last = "observation"

    def add(kind: str, *others: str, **attributes: Any) -> None:
        nonlocal last
        out = f"{len(nodes)}"
        nodes.append(make.make_node(kind, [last, *others], [out], **attributes))
        last = out

    def clip(bound: float, name: str) -> None:
        low, high = (np.array(edge, np.float32) for edge in (-bound, bound))
        arrays[f"-{name}"], arrays[name] = low, high
        add("Clip", f"-{name}", name)

    if info.encoding == "symlog":
        nodes += [make.make_node(kind, list(names), [out]) for kind, names, out in _SYMLOG]
        arrays["one"], last = np.array(1.0, np.float32), "encoded"
    add("Sub", "mean")
    add("Div", "scale")
    if info.bound is not None:
        clip(info.bound, "bound")
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays |= {f"weight_{i}": weight, f"bias_{i}": bias}
        add("Gemm", f"weight_{i}", f"bias_{i}", transB=1)
        if i < len(policy.weights) - 1:
            add(_OPERATORS[info.activation])
    if info.output == "tanh":
        add("Tanh")
    clip(1.0, "most")
    nodes[-1].output[0] = "action"
    tensor, kind = make.make_tensor_value_info, onnx.TensorProto.FLOAT
    graph = make.make_graph(
        nodes,
        "policy",
        [tensor("observation", kind, ["rows", info.layers[0]])],
        [tensor("action", kind, ["rows", info.layers[-1]])],
        [onnx.numpy_helper.from_array(np.asarray(array), name) for name, array in arrays.items()],
    )
    model = make.make_model(
        graph,
        opset_imports=[make.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name=PRODUCER,
    )
    told = {
        "task": info.task,
        "task_version": str(info.task_version),
        "timestep": str(task.timestep),
        "method": info.method,
        "sha256": policy.sha256,
    }
    make.set_model_props(model, told)
    onnx.checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString()
    return content


def _by_torch(directory: Path, seen: np.ndarray) -> np.ndarray:
    """The actions of the torch code that was written."""
    torch = importlib.import_module("torch")  # evaluation starts without it
    load = runpy.run_path(str(directory / TORCH_FILE))["load"]
    with torch.no_grad():
        actions = load(directory)(torch.as_tensor(seen, dtype=torch.float32))
    return np.asarray(actions.numpy(), np.float64)
