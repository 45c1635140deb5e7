"""`tsbench evaluate`: score a policy by a protocol."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from tsbench.cli import places
from tsbench.cli.arguments import threads, verb_parser
from tsbench.cli.policies import VECNORMALIZE, read_policy
from tsbench.core.errors import unknown


def call(words: Sequence[str]) -> int:
    parser = verb_parser("evaluate")
    parser.add_argument(
        "policy",
        metavar="POLICY_OR_RUN",
        help="directory with a policy in it, kept entry (TASK/ENTRY), .onnx file, "
        "stable-baselines3 .zip, zero or random",
    )
    parser.add_argument(
        "task", nargs="?", metavar="task=NAME", help="for a policy that names no task"
    )
    parser.add_argument(
        "--protocol",
        metavar="NAME",
        help="v1, or smoke, which takes seconds (the protocol of the run's score, else v1)",
    )
    help_physics = (
        "elliptic, half_step or warp: also play the protocol there and count changed verdicts"
    )
    parser.add_argument("--physics", metavar="NAME", help=help_physics)
    parser.add_argument("--threads", type=threads, metavar="N", help="CPU threads (all)")
    parser.add_argument(
        "--trust-sb3",
        metavar="ALGORITHM",
        help="the algorithm that saved the .zip, which can run any code when it is loaded",
    )
    parser.add_argument("--vecnormalize", type=places.path, metavar="FILE", help=VECNORMALIZE)
    options = parser.parse_args(words)
    from rich.console import Console

    from tsbench import tasks
    from tsbench.cli import tables
    from tsbench.core.files import write_json
    from tsbench.core.words import number
    from tsbench.evaluation.evaluate import evaluate
    from tsbench.evaluation.flips import flips
    from tsbench.evaluation.protocol import PHYSICS, PROTOCOLS, V1
    from tsbench.evaluation.replay import compare
    from tsbench.runs import directory
    from tsbench.runs.progress import progress_bar

    path = places.run(options.policy)
    policy, task = read_policy(path, options.task, options.trust_sb3, options.vecnormalize)
    run = directory.RunDirectory(path)
    kept = run.record() if run.finished else None
    name = options.protocol or (kept.score.protocol if kept else V1.name)
    if name not in PROTOCOLS:
        raise unknown("protocol", name, PROTOCOLS)
    protocol = PROTOCOLS[name]
    log = run.actions(task) if kept else None
    if options.physics is not None and options.physics not in PHYSICS:
        raise unknown("physics", options.physics, PHYSICS)
    engine = _engine(options.physics)
    console, standard = Console(), tasks.standard(task)
    with progress_bar(console, "evaluate") as progress:
        score = evaluate(
            policy, task, protocol=protocol, threads=options.threads, progress=progress
        )
    label = options.policy
    place = places.path(label)
    if path not in (place, place.parent) and path.name != place.name:  # an entry's first training
        label = f"{label}, {path.name}"
    tables.show_score(console, f"{task.name}: {label}", score, task)
    tables.show_rank(console, standard, score)
    shown: dict[str, Any] = {**score.as_dict(), "standard": standard}
    confirmed = True
    if kept is not None:
        comparison = compare(kept.score, score, task, log)
        # Who names another protocol asks for a new score, and not whether the kept one is right.
        confirmed = bool(comparison.agrees) or protocol.name != kept.score.protocol
        made = replace(kept, score=score, standard=standard)
        shown = directory.shown(made) | {"comparison": vars(comparison)}
        line = f" {run.score_file}: {comparison.words}"
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if options.physics is not None:
        with progress_bar(console, options.physics) as progress:
            other = evaluate(
                policy,
                task,
                protocol=protocol.elsewhere(options.physics),
                threads=options.threads,
                progress=progress,
                engine=engine,
            )
        flipped = flips(score, other)
        tables.show_flips(console, options.physics, flipped)
        console.print(
            f" solved_reward: {number(score.solved_reward)} by protocol {protocol.name}, "
            f"{number(other.solved_reward)} in physics {options.physics}, which is never ranked",
            highlight=False,
            soft_wrap=True,
        )
        shown |= {"physics": {"score": other.as_dict(), "flips": [vars(one) for one in flipped]}}
    write_json(options.json, shown)
    return int(not confirmed)


def _engine(physics: str | None) -> Any:
    """What plays a score in one of the other physics (`evaluation.protocol.PHYSICS`).

    Raises:
        TsbenchError: its packages are not installed.
    """
    if physics == "warp":
        from tsbench.sim.warp import HostPhysics

        return HostPhysics
    from tsbench.sim.physics import Physics

    return Physics
