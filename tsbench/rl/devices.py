"""The devices that a run can learn on: the CPU, a GPU, or mujoco-warp on the CPU for tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import torch

from tsbench.core.errors import TsbenchError
from tsbench.rl import processes

CPU, WARP = "cpu", "warp"
DRIVER = Path("/proc/driver/nvidia/version")  # of NVIDIA's kernel module on Linux
EXTRA = ("mujoco_warp", "warp")  # modules of the extra `gpu`
INSTALL = "pip install 'tsbench[gpu]'"
# cuBLAS gives the same bits each time only if it has a workspace of fixed size, which it asks for
# when the process uses it first.
WORKSPACE = ("CUBLAS_WORKSPACE_CONFIG", ":4096:8")


def pick() -> str:
    """What `auto` stands for here: a GPU if torch and mujoco-warp can use one, else the CPU."""
    return "cuda" if torch.cuda.is_available() and not _missing() else CPU


def torch_device(name: str) -> torch.device:
    """The device of the tensors. Of several processes each has its own GPU by the name `cuda`.

    Raises:
        TsbenchError: this machine or this installation lacks it.
    """
    if name == CPU:
        return torch.device("cpu")
    if missing := _missing():
        raise TsbenchError(f"device={name} needs {', '.join(missing)}: {INSTALL}")
    if name == WARP:
        return torch.device("cpu")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if not count:
        raise TsbenchError(f"device={name}: torch finds no GPU here; allowed: {CPU}, {WARP}")
    device = torch.device(name)
    index = processes.local_rank() if device.index is None else device.index
    if index >= count:
        names = ", ".join(f"cuda:{number}" for number in range(count))
        raise TsbenchError(f"device={name}: there is no such GPU here; allowed: {names}")
    return torch.device("cuda", index)


def described(name: str) -> dict[str, str]:
    """What determines a run's results on a device other than the CPU beside its configuration: the
    versions of the engine and, on a GPU, its name and driver."""
    found = {name: version(name) for name in ("mujoco-warp", "warp-lang")}
    if name != WARP:
        device = torch_device(name)
        found["gpu"] = torch.cuda.get_device_name(device)
        found["cuda"] = str(torch.version.cuda)
        found["driver"] = _driver()
    return found


@contextmanager
def working_on(device: torch.device, *, deterministic: bool) -> Iterator[None]:
    """Makes a GPU torch's current one, and torch's algorithms deterministic if asked."""
    before = torch.are_deterministic_algorithms_enabled()
    if deterministic:
        os.environ.setdefault(*WORKSPACE)
        torch.use_deterministic_algorithms(True)
    try:
        with torch.cuda.device(device) if device.type == "cuda" else nullcontext():
            yield
    finally:
        torch.use_deterministic_algorithms(before)


def _missing() -> list[str]:
    return [module for module in EXTRA if find_spec(module) is None]


def _driver() -> str:
    """The version of NVIDIA's kernel driver, as the system gives it; "unknown" elsewhere."""
    try:
        words = DRIVER.read_text(encoding="utf-8").partition("\n")[0].split()
    except OSError:
        return "unknown"
    return next((word for word in words if word[:1].isdigit() and "." in word), "unknown")
