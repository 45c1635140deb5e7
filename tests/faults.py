"""The fault campaign: kills, starves and poisons real runs, and checks that they recover.

    make faults            50 kills, and every other fault once
    make faults N=3        3 kills and every other fault once, as in CI

`cli.main` starts the runs in forked processes, which saves each run some seconds of imports. A
signal kills a run in an iteration drawn at random or after the last one, after a random amount of
processor time, which does not depend on the load of the machine. Then the run is resumed until it
ends, and its files are compared with those of an uninterrupted run: the bytes of policy, plan and
reference, the metrics without wall-clock times, and the score.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import tsbench.cli.launch
import tsbench.viewer.report  # noqa: F401
from tsbench import cli
from tsbench.rl.ppo import Learner
from tsbench.rl.rollout import Rollout
from tsbench.sim.model import load_spec
from tsbench.tasks.laikago import Laikago

SMALL = ["budget=smoke", "threads=1", "task.budgets.smoke.environments=8"]
ROCKET = [
    "task=rocket_navigation",
    *SMALL,
    "task.budgets.smoke.plan=1_536",
    "task.budgets.smoke.act=2_048",
    "task.training.plan.rollout=32",
    "task.training.imitate.rollout=32",
    "task.training.imitate.epochs=2",
    "task.training.imitate.minibatches=4",
    "task.constants.distance=20.0",
]
LAIKAGO = [
    *SMALL,
    "task.budgets.smoke.plan=1_536",
    "task.budgets.smoke.act=1_152",
    "task.training.plan.rollout=32",
    "task.training.imitate.epochs=2",
]
RUNS = {
    "rocket, three stages": [*ROCKET, "method.finetune=0.5"],
    "laikago_trot, two stages": ["task=laikago_trot", *LAIKAGO],
    "laikago_walk, three stages": ["task=laikago_walk", *LAIKAGO, "method.finetune=0.5"],
    "rocket, monolithic": [*ROCKET, "method=monolithic", "task.training.task.rollout=64"],
}
INTERVALS = (0.0, 0.5, 1000.0)  # seconds between checkpoints
KILLS = 5  # of one run at most
PATIENCE = 600.0  # seconds, for a process that should end

Check = tuple[str, bool, str]  # the fault, whether the run recovered, the observation


class Process:
    """`tsbench WORDS` in its own process."""

    def __init__(
        self, words: list[str], folder: Path, before: Callable[[], None] | None = None
    ) -> None:
        """`before` is called in the new process and may damage it."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.errors = folder / "stderr"
        self.status: int | None = None
        self.cpu = 0.0  # seconds of processor time, known at the end
        self.pid = os.fork()
        if self.pid == 0:
            status = 1
            try:
                os.chdir(folder)
                for number, name in ((1, "stdout"), (2, "stderr")):
                    os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
                sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
                sys.argv = ["tsbench"]
                if before is not None:
                    before()
                status = cli.main(words)
                sys.stdout.flush()
                sys.stderr.flush()
            except BaseException:
                traceback.print_exc()
                sys.stderr.flush()
            finally:
                os._exit(status)

    def used(self) -> float:
        """Seconds of processor time so far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def size(self) -> int:
        """Bytes of address space."""
        return int(Path(f"/proc/{self.pid}/statm").read_text().split()[0]) * resource.getpagesize()

    def ended(self) -> bool:
        if self.status is None:
            pid, status, usage = os.wait4(self.pid, os.WNOHANG)
            if pid:
                self.status = os.waitstatus_to_exitcode(status)
                self.cpu = usage.ru_utime + usage.ru_stime
        return self.status is not None

    def until(self, event: Callable[[], bool]) -> bool:
        """Waits for an event; returns whether it came before the process ended."""
        deadline = time.monotonic() + PATIENCE
        while not self.ended():
            if event():
                return True
            if time.monotonic() > deadline:
                os.kill(self.pid, signal.SIGKILL)
                raise TimeoutError(f"a run did not end; see {self.errors}")
            time.sleep(0.02)
        return False

    def until_used(self, seconds: float) -> bool:
        """Waits until the process has used that much processor time; returns whether it did."""
        return self.until(lambda: self.used() >= seconds)

    def until_iterations(self, count: int) -> bool:
        """Waits until the run has recorded that many iterations; returns whether it did."""
        return self.until(lambda: iterations(self.folder) >= count)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Suspends the process, so that the test can change its files without a race."""
        os.kill(self.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, self.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        try:
            yield
        finally:
            os.kill(self.pid, signal.SIGCONT)

    def wait(self) -> int:
        """The exit status, negative for a signal."""
        self.until(lambda: False)
        assert self.status is not None
        return self.status

    def line(self) -> str:
        """The output on the error stream."""
        return self.errors.read_text().strip()


def outcome(run: Path) -> dict[str, Any]:
    """A run's policy, motions, metrics and score, without times."""
    files = [(run / name).read_bytes() for name in ("policy.safetensors", "policy.json")]
    for name in ("plan.npz", "reference.npz"):
        if (run / name).exists():
            with np.load(run / name) as recording:
                files += [recording[key].tobytes() for key in sorted(recording.files)]
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return {
        "files": files,
        "metrics": [
            {key: value for key, value in row.items() if not key.endswith("seconds")}
            for row in rows
        ],
        "score": json.loads((run / "score.json").read_text())["score"],
    }


def where(run: Path) -> str:
    """The stage and iteration that a run had reached, from its files."""
    metrics = run / "metrics.jsonl"
    rows = metrics.read_text().splitlines() if metrics.exists() else []
    if not rows:
        return "before the first iteration"
    if (run / "policy.json").exists():
        return "evaluation and page"
    try:
        return str(json.loads(rows[-1])["stage"])
    except ValueError:  # killed in the middle of a line
        return str(json.loads(rows[-2])["stage"]) if len(rows) > 1 else "the first line"


@dataclass
class Campaign:
    """The faults and their outcomes.

    Attributes:
        folder: the folder of all runs.
        random: the generator of all random draws.
        checks: the faults tried, and their outcomes.
        kills: the stages in which each run was killed.
    """

    folder: Path
    random: random.Random
    checks: list[Check] = field(default_factory=list)
    kills: Counter[tuple[str, str]] = field(default_factory=Counter)
    whole: dict[str, tuple[dict[str, Any], float]] = field(default_factory=dict)

    def check(self, what: str, good: bool, seen: str = "") -> None:
        self.checks.append((what, good, seen))
        sys.stdout.write(f"{'ok  ' if good else 'BAD '} {what}{': ' if seen else ''}{seen}\n")
        sys.stdout.flush()

    def uninterrupted(self, name: str) -> tuple[dict[str, Any], float]:
        """The files of the uninterrupted run, and its processor time in seconds."""
        if name not in self.whole:
            folder = self.folder / f"whole {name}"
            process = Process(["run", *RUNS[name], "directory=run"], folder)
            if process.wait():
                raise RuntimeError(f"{name} does not even run: {process.line()}")
            self.whole[name] = outcome(folder / "run"), process.cpu
        return self.whole[name]

    def kill(self, count: int) -> None:
        """Kills runs `count` times at random moments, resumes them and compares their files."""
        number = 0
        while self.kills.total() < count:
            name = list(RUNS)[number % len(RUNS)]
            interval = INTERVALS[number % len(INTERVALS)]
            folder, number = self.folder / f"killed {number}", number + 1
            expected, cost = self.uninterrupted(name)
            total = len(expected["metrics"])
            killed = 0
            words = ["run", *RUNS[name], f"checkpoint={interval}", "directory=run"]
            while True:
                begun = (folder / "run" / "config.yaml").exists()
                process = Process(["run", "resume=run"] if begun else words, folder)
                done = iterations(folder)
                over = killed > 0 and done == total  # one kill after the training is enough
                if over or killed == KILLS or self.kills.total() == count:
                    process.wait()
                    break
                target = self.random.randint(min(done + 1, total), total)
                if not process.until_iterations(target):
                    break
                # The kill falls into the next iteration, or into the work after the last one.
                span = cost / 2 if target == total else cost / 2 / total
                if not process.until_used(process.used() + self.random.uniform(0.0, span)):
                    break
                stage = where(folder / "run")
                os.kill(process.pid, signal.SIGKILL)
                if process.wait() != -signal.SIGKILL:
                    break  # it was quicker
                killed += 1
                self.kills[name, stage] += 1
            what = f"{name}, checkpoint={interval:g}, {killed} kills"
            if process.status:
                self.check(what, False, f"exit {process.status}: {process.line()}")
                continue
            left = outcome(folder / "run")
            differing = [key for key in expected if expected[key] != left[key]]
            self.check(
                what, not differing, "differs in " + ", ".join(differing) if differing else ""
            )
            shutil.rmtree(folder)

    # One fault each

    def signals(self) -> None:
        """Ctrl-C and SIGTERM save the iteration under way and say how to go on."""
        for number, status in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
            folder, process = self.begin(f"{number.name}", 1000.0)
            process.until_iterations(4)
            os.kill(process.pid, number)
            said = process.wait() == status and process.line().endswith("resume=run")
            kept = iterations(folder)
            names = sorted(path.name for path in (folder / "run" / "checkpoints").iterdir())
            steps = json.loads((folder / "run" / "metrics.jsonl").read_text().splitlines()[-1])
            saved = names[-1].split("-")[2] == f"{steps['steps']:012}"
            self.ends(f"{number.name} after {kept} iterations", folder, said and saved, process)

    def full_disk(self) -> None:
        """The disk fills up during training, and has room again later."""
        folder = self.folder / "full disk"
        words = ["run", *RUNS[SUBJECT], "checkpoint=0", "directory=run"]
        if not can_mount():
            limit = 60_000
            process = Process(
                words, folder, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            )
            refused = process.wait() == 2 and "File too large" in process.line()
            self.ends(f"no file above {limit:,} bytes (RLIMIT_FSIZE)", folder, refused, process)
            return
        with small_disk(folder, "400k"):
            process = Process(words, folder)
            refused = process.wait() == 2 and "No space left on device" in process.line()
            subprocess.run(["mount", "-o", "remount,size=64m", folder], check=True)
            self.ends("full disk (tmpfs of 400k)", folder, refused, process)

    def read_only(self) -> None:
        """The folder of the checkpoints becomes read-only, and is writable again later."""
        folder, process = self.begin("read-only", 0.0)
        process.until_iterations(3)
        with ExitStack() as stack:
            with process.paused():
                kind, says = stack.enter_context(read_only(folder / "run" / "checkpoints"))
            refused = process.wait() == 2 and says in process.line()
            refused &= Process(["run", "resume=run"], folder).wait() == 2
        self.ends(f"read-only ({kind})", folder, refused, process)

    def read_only_from_the_start(self) -> None:
        folder = self.folder / "nowhere to write"
        folder.mkdir()
        elsewhere = self.folder / "somewhere"
        with read_only(folder) as (kind, says):
            process = Process(["run", *RUNS[SUBJECT], f"directory={folder}/run"], elsewhere)
            refused = process.wait() == 2 and says in process.line()
        one_line = len(process.line().splitlines()) == 1
        self.check(f"read-only from the start ({kind})", refused and one_line, process.line())

    def vanished(self) -> None:
        """The run's directory is removed during training."""
        folder, process = self.begin("vanished", 0.0)
        process.until_iterations(3)
        with process.paused():
            shutil.rmtree(folder / "run")
        refused = process.wait() == 2 and len(process.line().splitlines()) == 1
        self.check("vanished directory", refused, process.line())

    def no_memory(self) -> None:
        """Memory is too small from the start, or runs out during training."""
        many = ["task.budgets.smoke.environments=null", "task.training.plan.environments=3_000_000"]
        few = SMALL[-1]  # of environments, which no run of many may say too
        words = [*(word for word in RUNS[SUBJECT] if word != few), *many]
        folder = self.folder / "too large"
        limit = 4 << 30
        process = Process(
            ["run", *words, "directory=run"],
            folder,
            before=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        )
        refused = process.wait() == 2 and "out of memory" in process.line()
        refused &= not (folder / "run").exists()
        self.check("memory limit (RLIMIT_AS, 4 GiB) from the start", refused, process.line())

        folder, process = self.begin("no more memory", 0.0)
        process.until_iterations(3)
        before = iterations(folder)
        limit = process.size() + (1 << 20)
        resource.prlimit(process.pid, resource.RLIMIT_AS, (limit, limit))
        refused = process.wait() == 2 and "out of memory" in process.line()
        self.ends(f"memory limit after {before} iterations", folder, refused, process)

    def two_at_once(self) -> None:
        folder, process = self.begin("two at once", 0.0)
        process.until_iterations(3)
        with process.paused():
            elsewhere = folder / ".." / "second"
            second = Process(["run", "resume=run"], elsewhere, lambda: os.chdir(folder))
            refused = second.wait() == 2 and "another process" in second.line()
        good = process.wait() == 0 and outcome(folder / "run") == self.uninterrupted(SUBJECT)[0]
        self.check("two runs into one directory", refused and good, second.line())

    def torn_checkpoint(self) -> None:
        folder, process = self.begin("torn", 0.0)
        process.until_iterations(4)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        # Without the line that the kill left half written.
        newest = sorted((folder / "run" / "checkpoints").glob("*.safetensors"))[-1]
        newest.write_bytes(newest.read_bytes()[:-1])
        self.ends("torn checkpoint", folder, True, process)
        said = "going back to the one before" in (folder / "run" / "log.txt").read_text()
        self.check("the log says so", said)

    def poisoned_model(self) -> None:
        """Motors so strong that the physics diverges: warnings are counted, and the run fails."""

        def poison() -> None:
            load = load_spec

            def strong(name: str) -> Any:
                spec = load(name)
                for actuator in spec.actuators:
                    actuator.gainprm[0] *= 1e12
                    actuator.forcelimited = False
                return spec

            patch("tsbench.tasks.laikago.load_spec", strong)

        folder = self.folder / "poisoned model"
        words = [*RUNS["laikago_trot, two stages"], "directory=run"]
        process = Process(["run", *words], folder, poison)
        status = process.wait()
        if status:
            self.check("poisoned model", False, f"exit {status}: {process.line()}")
            return
        record = json.loads((folder / "run" / "score.json").read_text())
        warned = record["stages"][1]["warnings"]
        failed = (
            record["score"]["nominal"]["violations"],
            record["score"]["perturbed"]["violations"],
        )
        good = sum(warned.values()) > 0 and failed == (1.0, 1.0) and not process.line()
        good &= "mujoco warned" in (folder / "run" / "log.txt").read_text()
        good &= not (folder / "MUJOCO_LOG.TXT").exists()
        self.check("poisoned model", good, f"{warned}, share of episodes failed {failed[1]:g}")

    def poisoned_numbers(self) -> None:
        """A number that is not finite in reward, state, action or loss, in the third iteration."""

        def reward() -> None:
            compute = Laikago.reward

            def wrong(self: Any, previous: Any, action: Any, state: Any) -> Any:
                value = compute(self, previous, action, state)
                if state.feet.shape[0] == 8 and state.time[3] > 1.0:
                    value[3] = np.nan
                return value

            patch("tsbench.tasks.laikago.Laikago.reward", wrong)

        def state() -> None:
            read = Laikago.read

            def wrong(self: Any, readings: Any) -> Any:
                value = read(self, readings)
                if value.com.shape[0] == 8:
                    value.com[5, 2] = np.inf
                return value

            patch("tsbench.tasks.laikago.Laikago.read", wrong)

        def action() -> None:
            learn = Learner.learn

            def wrong(self: Any, *arguments: Any) -> None:
                with torch.no_grad():
                    self._actor.mlp[-1].bias[0] = np.nan
                learn(self, *arguments)

            patch("tsbench.rl.ppo.Learner.learn", wrong)

        def loss() -> None:
            finish = Rollout.finish

            def wrong(self: Any, observation: Any) -> None:
                finish(self, observation)
                self.storage.returns[0, 0] = np.nan

            patch("tsbench.rl.rollout.Rollout.finish", wrong)

        for name, poison, says in (
            ("reward", reward, "reward of environment 3 is not finite at step "),
            ("state", state, "com of environment 5 is not finite at step "),
            ("action", action, "action of environment 0 is not finite at step "),
            ("loss", loss, "the value loss is not finite in the iteration after "),
        ):
            folder = self.folder / f"poisoned {name}"
            words = [*RUNS["laikago_trot, two stages"], "directory=run"]
            process = Process(["run", *words], folder, poison)
            good = process.wait() == 2 and process.line().startswith(f"tsbench: {says}")
            dump = folder / "run" / "not-finite.npz"
            good &= len(process.line().splitlines()) == 1 and dump.exists()
            if good:
                with np.load(dump) as arrays:
                    good = any(not np.isfinite(arrays[key]).all() for key in arrays.files)
            self.check(f"poisoned {name}", good, process.line())

    # What they share

    def begin(self, name: str, interval: float) -> tuple[Path, Process]:
        folder = self.folder / name
        words = ["run", *RUNS[SUBJECT], f"checkpoint={interval}", "directory=run"]
        return folder, Process(words, folder)

    def ends(self, what: str, folder: Path, good: bool, stopped: Process) -> None:
        """Resumes a run and compares it with the uninterrupted one."""
        seen = f"exit {stopped.status}: {stopped.line()}"
        lines = len(stopped.line().splitlines())
        process = Process(["run", "resume=run"], folder)
        if process.wait():
            self.check(what, False, f"{seen}; then {process.line()}")
            return
        same = outcome(folder / "run") == self.uninterrupted(SUBJECT)[0]
        left = [path.name for path in folder.rglob("*.part")]
        good &= same and lines <= 1 and not left
        self.check(what, good, f"{seen}; resumed {'to the same bits' if same else 'DIFFERENT'}")


def patch(name: str, value: Any) -> None:
    """Replaces a function or value of the program, in a process that the test damages."""
    pytest.MonkeyPatch().setattr(name, value)


def iterations(folder: Path) -> int:
    metrics = folder / "run" / "metrics.jsonl"
    return metrics.read_text().count("\n") if metrics.exists() else 0


@cache
def can_mount() -> bool:
    """Whether this process may mount file systems, which needs root, and more in a container."""
    with tempfile.TemporaryDirectory() as folder:
        mount = ["mount", "-t", "tmpfs", "tmpfs", folder]
        if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
            return False
        subprocess.run(["umount", folder], check=True)
    return True


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """Mounts a file system of that size."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


@contextmanager
def read_only(folder: Path) -> Iterator[tuple[str, str]]:
    """Makes a folder read-only: by a mount if possible, since permissions do not bind root. Yields
    the means used, and the system's error message."""
    if can_mount():
        subprocess.run(["mount", "--bind", folder, folder], check=True)
        try:
            subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
            yield "bind mount", "Read-only file system"
        finally:
            subprocess.run(["umount", folder], check=True)
    else:
        folder.chmod(0o500)
        try:
            yield "permissions", "Permission denied"
        finally:
            folder.chmod(0o700)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=50, metavar="N")
    parser.add_argument("--seed", type=int, default=None, help="of the moments (at random)")
    parser.add_argument("--only", choices=["kills", "faults"], help="one half of it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to a file too")
    options = parser.parse_args()
    seed = random.SystemRandom().randrange(2**32) if options.seed is None else options.seed
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="tsbench-faults-") as folder:
        campaign = Campaign(Path(folder), random.Random(seed))
        if options.only != "faults":
            campaign.kill(options.kills)
        if options.only != "kills":
            bound = can_mount() or os.geteuid() != 0
            for fault in FAULTS:
                if bound or fault not in NEED_A_BOUND:
                    fault(campaign)
                else:
                    name = fault.__name__.replace("_", " ")
                    sys.stdout.write(f"left out, root may write and not mount: {name}\n")
    sys.stdout.write(f"{campaign.kills.total()} kills (seed {seed}):\n")
    for (name, stage), count in sorted(campaign.kills.items()):
        sys.stdout.write(f"  {count:3} in {name}: {stage}\n")
    bad = [what for what, good, _ in campaign.checks if not good]
    minutes = (time.monotonic() - began) / 60.0
    sys.stdout.write(
        f"{len(campaign.checks) - len(bad)} of {len(campaign.checks)} checks passed"
        f" in {minutes:.1f} minutes\n"
    )
    if options.json:
        figures = {
            "seed": seed,
            "kills": [
                {"run": name, "stage": stage, "count": count}
                for (name, stage), count in sorted(campaign.kills.items())
            ],
            "checks": [
                {"what": what, "passed": good, "seen": seen} for what, good, seen in campaign.checks
            ],
        }
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    return int(bool(bad))


SUBJECT = "rocket, three stages"
FAULTS = (
    Campaign.signals,
    Campaign.full_disk,
    Campaign.read_only,
    Campaign.read_only_from_the_start,
    Campaign.vanished,
    Campaign.no_memory,
    Campaign.two_at_once,
    Campaign.torn_checkpoint,
    Campaign.poisoned_model,
    Campaign.poisoned_numbers,
)
NEED_A_BOUND = (Campaign.read_only, Campaign.read_only_from_the_start)

if __name__ == "__main__":
    sys.exit(main())
