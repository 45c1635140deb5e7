"""Records torch's operations, to find those that wait for a device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch.utils._python_dispatch import TorchDispatchMode

# What reads a value on the host, makes a shape depend on one, or sends a number to the device. A
# CUDA graph cannot be recorded of any of them. `normal`, unlike `normal_`, reads whether a standard
# deviation is negative.
WAITING = frozenset(
    {"_local_scalar_dense", "nonzero", "masked_select", "unique", "lift_fresh", "item", "normal"}
)


class Operations(TorchDispatchMode):
    """A context that records torch's operations.

    Attributes:
        names: of the operations so far.
    """

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __torch_dispatch__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        packet: Any = func
        self.names.add(packet.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))
