"""What a method is given: a problem to solve, and a workspace to report to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from tsbench.core.task import Task


@dataclass(frozen=True)
class Budget:
    """How much a run may use.

    Attributes:
        plan: environment steps of the planning variant.
        act: environment steps of the task or its imitation variant. A method without a planning
            stage may use both (paper: monolithic gets the sum).
        environments: how many are stepped together at most, whatever the training settings say.
    """

    plan: int
    act: int
    environments: int | None = None


@dataclass(frozen=True)
class Problem:
    """What a method has to solve, and with what.

    Attributes:
        task: in full physics.
        budget: environment steps of each kind.
        training: changes to the PPO settings by kind of stage (a method's `STAGES`).
        options: of the method, as its config has them.
        seed: of all randomness.
        threads: for the physics, or None for all cores.
    """

    task: Task[Any]
    budget: Budget
    training: Mapping[str, Mapping[str, Any]]
    options: Mapping[str, Any]
    seed: int
    threads: int | None


Snapshot = Mapping[str, Any]  # nested mappings of numpy arrays and of what JSON can hold


class Monitor(Protocol):
    """Takes a stage's figures, once per iteration.

    Attributes:
        physics_substeps: steps of the physics so far.
        warnings: how often mujoco has warned so far, by mujoco's names.
        saved: the newest snapshot of this stage where a run is resumed, else None.
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
        """Takes an iteration's figures, and what to go on from should the run be interrupted.

        Args:
            steps: environment steps of this stage so far.
            metrics: named scalars.
            snapshot: gives all that the stage's next iteration depends on. It is called now and
                then. A stage without one is done again when a run is resumed.
        """


class Workspace(Protocol):
    """Where a method reports and leaves what it makes.

    When a run is resumed, the method is called again from the top. Its stages get back what they
    had `saved`, those that were finished their last state; what lies between them is done again,
    so it must depend on nothing but the problem and the stages before.
    """

    @property
    def directory(self) -> Path: ...

    def stage(self, name: str, steps: int) -> AbstractContextManager[Monitor]:
        """A stage that may use that many environment steps."""

    def note(self, line: str) -> None:
        """Tells the user something in plain words."""
