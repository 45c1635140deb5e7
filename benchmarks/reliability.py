"""How reliably a recipe learns: trainings over seeds and rounding, in one table.

    python benchmarks/reliability.py task=rocket_navigation --seeds 10 --out reliability.jsonl

trains `budget=fast` with seeds 0 to 9, each as it is and with initial weights that differ by one
millionth, which stands for another processor (`tsbench.testing.rounding`). All of the words of
`tsbench run` but seed and threads are allowed. A training succeeds when its last policy solves at
least 95 of the protocol's 100 perturbed starts. A plan that fails its audit is a training that
fails, and so are numbers that are not finite. The file gets a line for each training as it ends.
Trainings that it has are not repeated, so that an interrupted study goes on. The table is made from
the file.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from rich.console import Console
from rich.table import Table

from tsbench import methods
from tsbench.core.errors import NotFiniteError, PlanError, TsbenchError
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.protocol import V1
from tsbench.rl.threads import one_thread
from tsbench.runs import config
from tsbench.runs.execute import prepare
from tsbench.runs.workspace import RunWorkspace
from tsbench.testing.rounding import perturbed

# The protocol's perturbed starts and its pushes of 100 N; nothing else of it is asked here.
PROTOCOL = replace(V1, conditions=(), forces=(V1.claim,))
ENOUGH = 0.95  # share of the perturbed starts that a training has to solve


def train(words: list[str], seed: int, rounding: float) -> dict[str, Any]:
    """One training, and what its last policy is worth."""
    chosen = config.compose([*words, f"seed={seed}", "threads=1"])
    row: dict[str, Any] = {"words": words, "seed": seed, "rounding": rounding}
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, perturbed(rounding), one_thread():
        problem = prepare(chosen)
        workspace = RunWorkspace(Path(folder), Console(quiet=True))
        try:
            policy = methods.find(chosen.method["name"]).train(problem, workspace)
            seconds = time.perf_counter() - began
            score = evaluate(policy, problem.task, protocol=PROTOCOL, threads=1)
        except (PlanError, NotFiniteError) as refused:
            sys.stderr.write(f"seed {seed}, rounding {rounding:g}: {refused}\n")
            nothing = ("solved", "solved_reward", "normalized_reward", "survival_100N")
            return {**row, **dict.fromkeys(nothing, 0.0), "seconds": time.perf_counter() - began}
        finally:
            workspace.close()
    return {
        **row,
        "solved": score.perturbed.success,
        "solved_reward": score.perturbed.solved_reward,
        "normalized_reward": score.perturbed.normalized_reward,
        "survival_100N": score.robustness.survival_100N,
        "seconds": round(seconds, 1),
    }


def table(rows: list[dict[str, Any]]) -> Table:
    """A row for each training, and how many succeed."""
    good = sum(row["solved"] >= ENOUGH for row in rows)
    title = f"{' '.join(rows[0]['words'])}: {good} of {len(rows)} trainings succeed"
    shown = Table(title=title, title_justify="left")
    for name in ("seed", "rounding", "solved", "normalized reward", "100 N survived", "seconds"):
        shown.add_column(name, justify="right")
    for row in sorted(rows, key=lambda row: (row["seed"], row["rounding"])):
        shown.add_row(
            str(row["seed"]), f"{row['rounding']:g}", f"{row['solved']:.2f}",
            f"{row['normalized_reward']:.4f}", f"{row['survival_100N']:.3f}",
            f"{row['seconds']:.0f}",
        )  # fmt: skip
    return shown


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("words", nargs="+", metavar="KEY=VALUE", help="words of tsbench run")
    parser.add_argument("--seeds", type=int, default=10, help="trainings of each rounding (10)")
    parser.add_argument("--rounding", type=float, nargs="+", default=[0.0, 1e-6])
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="side by side (all cores)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="a line a training")
    options = parser.parse_args()
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    rows = [row for row in map(json.loads, lines) if row["words"] == options.words]
    done = {(row["seed"], row["rounding"]) for row in rows}
    wanted = [(s, r) for s in range(options.seeds) for r in options.rounding if (s, r) not in done]
    broken = 0
    try:
        prepare(config.compose(options.words))
        # Fresh processes: a fork would share what torch has started.
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
            jobs = [pool.submit(train, options.words, *one) for one in wanted]
            for job in as_completed(jobs):
                try:
                    rows.append(job.result())
                except TsbenchError as error:  # the others go on
                    broken += 1
                    sys.stderr.write(f"reliability: {error}\n")
                    continue
                with options.out.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
                sys.stderr.write(f"{len(rows)}: {rows[-1]}\n")
    except TsbenchError as error:
        sys.stderr.write(f"reliability: {error}\n")
        return 2
    if rows:
        Console().print(table(rows))
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
