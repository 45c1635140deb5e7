"""The page of a run: the executed motion of its policy, and its plan as a ghost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tsbench.evaluation.evaluate import check_fit
from tsbench.mdp import Task
from tsbench.motion import ReferenceMotion
from tsbench.policy import Policy
from tsbench.sim.batched import Physics
from tsbench.sim.episodes import play
from tsbench.viewer.page import write_page


def write_run_page(
    path: Path,
    task: Task[Any],
    policy: Policy,
    reference: ReferenceMotion | None,
    *,
    title: str,
    summary: list[tuple[str, str]],
) -> None:
    """Plays one episode from the task's own start and writes its page.

    Args:
        path: the HTML file, a new one.
        task: that the policy is for.
        policy: what to play.
        reference: the plan as full poses, if there was one.
        title: of the page.
        summary: labels and values of the score.

    Raises:
        TsbenchError: the policy or the reference is for another task, or the file exists.
    """
    check_fit(policy, task)
    physics: Physics[Any] = Physics(task, 1)
    qpos = physics.batch.bind("qpos")
    episode = play(task, physics, policy, 1, seed=0, record=lambda _: np.array(qpos))
    assert episode.states is not None
    write_page(
        path,
        task.spec().compile(),
        episode.states[: int(episode.lengths[0]) + 1, 0],
        task.timestep,
        ghost=None if reference is None else reference.qpos,
        ghost_timestep=None if reference is None else reference.timestep,
        title=title,
        summary=summary,
    )
