"""A policy that tsbench has exported, in torch: all that a robot's computer needs to act by it.

This file needs torch and safetensors, not tsbench. It lies beside policy.json, which describes the
network, and policy.safetensors, which holds the weights. Neither can run code.

    from policy import load

    policy = load("exported")      # the folder of the three files
    action = policy(observation)   # tensors (..., n) -> (..., m), each component in [-1, 1]
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load as read_tensors


def _plain(x: torch.Tensor) -> torch.Tensor:
    return x


def _symlog(x: torch.Tensor) -> torch.Tensor:
    return x.sign() * x.abs().log1p()


Function = Callable[[torch.Tensor], torch.Tensor]
ENCODINGS: dict[str, Function] = {"plain": _plain, "symlog": _symlog}
ACTIVATIONS: dict[str, Function] = {
    "elu": torch.nn.functional.elu,
    "relu": torch.relu,
    "tanh": torch.tanh,
}
OUTPUTS: dict[str, Function] = {"clip": _plain, "tanh": torch.tanh}


class Policy(torch.nn.Module):
    """A multilayer perceptron with its observation normaliser: observation -> action."""

    mean: torch.Tensor
    scale: torch.Tensor

    def __init__(self, info: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> None:
        """
        Args:
            info: the content of policy.json.
            tensors: the content of policy.safetensors.
        """
        super().__init__()
        self.encode = ENCODINGS[info["encoding"]]
        self.activate = ACTIVATIONS[info["activation"]]
        self.finish = OUTPUTS[info["output"]]
        self.bound: float | None = info["bound"]
        self.layers = len(info["layers"]) - 1
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions (..., m) for observations (..., n)."""
        x = (self.encode(observation) - self.mean) / self.scale
        if self.bound is not None:
            x = x.clamp(-self.bound, self.bound)
        for i in range(self.layers):
            weight, bias = getattr(self, f"weight_{i}"), getattr(self, f"bias_{i}")
            x = torch.nn.functional.linear(x, weight, bias)
            if i < self.layers - 1:
                x = self.activate(x)
        return self.finish(x).clamp(-1.0, 1.0)


def load(folder: Path | str) -> Policy:
    """The policy in a folder.

    Raises:
        ValueError: the two files do not belong together.
    """
    folder = Path(folder)
    info = json.loads((folder / "policy.json").read_text("utf-8"))
    content = (folder / "policy.safetensors").read_bytes()
    if hashlib.sha256(content).hexdigest() != info["sha256"]:
        raise ValueError(f"{folder}: policy.safetensors is not what policy.json describes")
    return Policy(info, read_tensors(content)).eval()
