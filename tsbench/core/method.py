"""The arguments of a method: a problem to solve and a workspace to report to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from tsbench.core.task import Task

AUDITS = ("stop", "warn")


@dataclass(frozen=True)
class Budget:
    """The environment steps that a run may use.

    Attributes:
        plan: environment steps of the planning variant.
        act: environment steps of the task or its imitation variant. A method without a planning
            stage may use both (paper: monolithic gets the sum).
        environments: limit on the environments stepped together, which overrides larger numbers in
            the training settings; None for no limit.
        audit: what a plan that fails its audit does to the run: "stop" ends it, "warn" goes on. No
            plan of a budget of seconds passes, so such budgets say "warn".

    Raises:
        ValueError: a value out of range. The message begins with its name.
    """

    plan: int
    act: int
    environments: int | None = None
    audit: str = "stop"

    def __post_init__(self) -> None:
        for name in ("plan", "act", "environments"):
            if (amount := getattr(self, name)) is not None and amount < 1:
                raise ValueError(f"{name} must be at least 1, not {amount}")
        if self.audit not in AUDITS:
            raise ValueError(f"audit must be stop or warn, not {self.audit}")


@dataclass(frozen=True)
class Problem:
    """The task that a method has to learn, with its budget and settings.

    Attributes:
        task: the task in full physics.
        budget: environment steps of each kind.
        training: changes to the PPO settings by kind of stage (a method's `STAGES`).
        options: the method's options as in its config.
        seed: seed of all random numbers.
        threads: number of threads for the physics, or None for all cores.
        device: that stages learn on: "cpu", "cuda", "cuda:N", or "warp" for a GPU's code on a CPU.
        deterministic: whether a device other than the CPU has to give the same bits each time; the
            CPU always does.
    """

    task: Task[Any]
    budget: Budget
    training: Mapping[str, Mapping[str, Any]]
    options: Mapping[str, Any]
    seed: int
    threads: int | None
    device: str = "cpu"
    deterministic: bool = False


Snapshot = Mapping[str, Any]  # nested mappings of numpy arrays and JSON values


class Monitor(Protocol):
    """Receives the metrics of a stage, once per iteration.

    Attributes:
        physics_substeps: physics steps so far.
        warnings: number of mujoco warnings so far, by mujoco's name of their kind.
        saved: the newest snapshot of this stage if the run is resumed, else None.
    """

    physics_substeps: int
    warnings: dict[str, int]

    @property
    def saved(self) -> Snapshot | None: ...

    def update(
        self,
        steps: int,
        metrics: Mapping[str, float],
        snapshot: Callable[[], Snapshot] | None = None,
    ) -> None:
        """Receives the metrics of an iteration and a function that makes a checkpoint.

        Args:
            steps: environment steps of this stage so far.
            metrics: named scalars.
            snapshot: returns everything that the stage's next iteration depends on. The monitor
                calls it from time to time. A stage without it starts again when a run is resumed.
        """


class Workspace(Protocol):
    """The place where a method reports its progress and saves its results.

    When a run is resumed, the method is called again from its beginning. Each stage finds its
    newest snapshot in `Monitor.saved`; the snapshot of a finished stage is its last state. Code
    between stages runs again, so it may depend only on the problem and on earlier stages.
    """

    @property
    def directory(self) -> Path: ...

    def stage(self, name: str, steps: int) -> AbstractContextManager[Monitor]:
        """A context for a stage of at most `steps` environment steps; it yields the monitor."""

    def note(self, line: str) -> None:
        """Shows the user one line of text."""
