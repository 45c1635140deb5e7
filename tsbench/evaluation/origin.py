"""The origin of a score: the versions, hashes and machine that it depends on."""

from __future__ import annotations

import hashlib
import json
import platform
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info

from tsbench import tasks
from tsbench.core import plugins
from tsbench.core.policy import Policy
from tsbench.core.task import Task
from tsbench.evaluation.foreign import ForeignPolicy
from tsbench.evaluation.protocol import Protocol
from tsbench.sim.episodes import PolicyFunction
from tsbench.sim.model import compiled_hash, fingerprint

PACKAGES = ("mujoco", "numpy", "scipy")


@dataclass(frozen=True)
class Origin:
    """Everything that a score depends on.

    Attributes:
        protocol: the whole protocol, its seed included.
        task: name of the task.
        task_version: version of the task.
        mjcf: hash of the task's MJCF (`sim.model.fingerprint`).
        model: hash of the compiled model.
        constants: sha256 of the values that define the task (`Task.constants`).
        policy: sha256 of the policy file, or None for a policy without a file.
        packages: versions of Python, of the packages that compute the score, and of the package
            that brings the task.
        machine: the properties of the machine by which numerical libraries choose their kernels:
            architecture, vector extensions, BLAS, C library.
    """

    protocol: Protocol
    task: str
    task_version: int
    mjcf: str
    model: str
    constants: str
    policy: str | None
    packages: dict[str, str]
    machine: dict[str, str]

    @classmethod
    def here(cls, task: Task[Any], protocol: Protocol, policy: PolicyFunction) -> Origin:
        """The origin of a score that is made in this process."""
        spec = task.spec()
        provider = tasks.provider(task.name)
        plugin = {} if provider is None else {provider.distribution: provider.version}
        return cls(
            protocol=protocol,
            task=task.name,
            task_version=task.version,
            mjcf=fingerprint(spec),
            model=compiled_hash(spec),
            constants=constants_hash(task),
            policy=policy.sha256 if isinstance(policy, (Policy, ForeignPolicy)) else None,
            packages={"python": platform.python_version()}
            | {name: version(name) for name in PACKAGES}
            | {plugins.OWN: plugins.own().version}
            | plugin,
            machine=machine(),
        )


def machine() -> dict[str, str]:
    """The properties of this machine by which numerical libraries choose their kernels."""
    extensions = np.show_config(mode="dicts")["SIMD Extensions"]
    libraries = [one for one in threadpool_info() if one["user_api"] == "blas"]
    # scipy brings its own BLAS, and threadpoolctl lists the libraries in no fixed order.
    libraries.sort(key=lambda one: ("numpy" not in one["filepath"], one["filepath"]))
    first = libraries[0] if libraries else {}
    blas = [str(first.get(name)) for name in ("internal_api", "version", "architecture")]
    return {
        "architecture": platform.machine(),
        "extensions": " ".join([*extensions["baseline"], *extensions["found"]]),
        "blas": " ".join(blas),
        "libc": " ".join(platform.libc_ver()),
    }


def constants_hash(task: Task[Any]) -> str:
    """sha256 of `Task.constants`. Numbers, strings, tuples, mappings and dataclasses may be nested
    in them."""
    content = json.dumps(dict(task.constants()), sort_keys=True, default=asdict)
    return hashlib.sha256(content.encode()).hexdigest()
