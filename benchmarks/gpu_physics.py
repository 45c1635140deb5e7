"""Physics on mujoco-warp on a GPU: is it the same, how many verdicts flip, how fast is it.

    python3 benchmarks/gpu_physics.py

Every section says what it found as soon as it knows, and a section that fails does not stop the
next. The kernels are compiled first, for all models at once, which takes one to two minutes on a
machine that never did; the rest takes less than three. Exits with status 1 if a section failed.
`--device cpu` tries the script itself, on warp's CPU device.
"""

from __future__ import annotations

import argparse
import gc
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tsbench import tasks
from tsbench.evaluation.evaluate import evaluate
from tsbench.evaluation.flips import flips
from tsbench.evaluation.protocol import V1
from tsbench.runs.directory import RunDirectory
from tsbench.sim.agreement import disagreements, one_step_gaps, whole_episode_gaps
from tsbench.sim.change import Change
from tsbench.sim.device import DeviceEnvironment
from tsbench.sim.disturbed import Disturbances
from tsbench.sim.warp import HostPhysics, WarpPhysics

ROOT = Path(__file__).parents[1]
MODELS = ("laikago_trot", "rocket_navigation", "rocket_obstacles")  # the walk's is the trot's
WORLDS = {
    "laikago_trot": (1_024, 4_096, 16_384, 65_536),
    "rocket_navigation": (4_096, 16_384, 65_536),
    "rocket_obstacles": (4_096, 16_384, 65_536),
}
POOL = 1_024  # starts; no figure here depends on how many
DISTURBED = Disturbances(
    push=200.0, calm=0.2, interval=0.5, mass=0.2, friction=0.5, strength=0.1, latency=2
)
ENTRIES = ROOT / "leaderboards" / "v1"
# All but the changed physics, each of which needs a recording of its own.
PROTOCOL = replace(V1.elsewhere("warp"), conditions=())


def say(words: str) -> None:
    sys.stdout.write(words + "\n")
    sys.stdout.flush()


class Checks:
    """Runs sections, and remembers whether one failed."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.failed = 0

    def section(self, name: str, run: Callable[[], object]) -> None:
        began = time.perf_counter()
        try:
            run()
        except Exception:
            self.failed += 1
            say(f"FAILED {name}\n{traceback.format_exc()}")
        gc.collect()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        say(f"-- {name}: {time.perf_counter() - began:.1f} s")

    def wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()

    def rate(self, step: Callable[[], object], count: int, seconds: float = 0.7) -> float:
        """Rows per second of a function that steps `count` of them."""
        for _ in range(3):
            step()
        self.wait()
        calls = 2
        while True:
            began = time.perf_counter()
            for _ in range(calls):
                step()
            self.wait()
            took = time.perf_counter() - began
            if took >= seconds:
                return calls * count / took
            calls = max(calls + 1, min(10 * calls, int(1.2 * calls * seconds / max(took, 1e-6))))

    def versions(self) -> None:
        names = ("mujoco", "mujoco_warp", "warp", "torch", "numpy")
        found = [f"{name} {sys.modules[name].__version__}" for name in names]
        card = torch.cuda.get_device_name(self.device) if self.device.type == "cuda" else "CPU"
        say(f"{card}; Python {sys.version.split()[0]}, {', '.join(found)}")

    def compiled(self) -> None:
        """In processes of their own, side by side; what they compile is kept on the disk."""
        command = [sys.executable, __file__, "--device", str(self.device), "--compile"]
        started = time.perf_counter()
        others = {name: subprocess.Popen([*command, name]) for name in MODELS}
        for name, process in others.items():
            try:
                code: object = process.wait(timeout=max(1.0, 200.0 + started - time.perf_counter()))
            except subprocess.TimeoutExpired:
                process.kill()
                code = "killed"
            say(f"compiled {name}: status {code}, {time.perf_counter() - started:.0f} s")

    def made(self, name: str, count: int, **more: Any) -> WarpPhysics[Any]:
        return WarpPhysics(
            tasks.make(name), count, device=self.device, pool=min(POOL, count), perturbed=True,
            **more,
        )  # fmt: skip

    def begun(self, physics: WarpPhysics[Any]) -> Any:
        count = len(physics.diverged)
        rows = torch.ones(count, dtype=torch.bool, device=self.device)
        return physics.begin(torch.arange(count, device=self.device) % physics.pool, rows)

    def actions(self, physics: WarpPhysics[Any]) -> torch.Tensor:
        rng = torch.Generator(self.device).manual_seed(0)
        shape = (len(physics.diverged), physics.task.action_size)
        return 0.4 * torch.rand(shape, generator=rng, device=self.device) - 0.2

    def agrees(self, name: str) -> None:
        """Step by step with C MuJoCo in float64, as tests/sim/test_warp.py has it."""
        task, engine = tasks.make(name), partial(HostPhysics, device=self.device)
        change = Change(mass=1.2, friction=0.5, strength=0.8)
        cases = {
            "each step": one_step_gaps(task, engine, episodes=4),
            "pushed, changed": one_step_gaps(task, engine, episodes=4, change=change, pushed=500.0),
        }
        if name.startswith("rocket"):
            cases["whole flights"] = whole_episode_gaps(task, engine, episodes=16)
        for title, gaps in cases.items():
            wrong = disagreements(gaps)
            state = {n: float(np.quantile(v, 0.95)) for n, v in gaps.state.items()}
            worst = max(state, key=lambda quantity: state[quantity])
            say(
                f"{name}, {title}: {'DIFFERENT ' + '; '.join(wrong) if wrong else 'agrees'} "
                f"({len(gaps.reward)} steps, 95 % within {state[worst]:.1e} ({worst}), reward "
                f"{np.quantile(gaps.reward, 0.95):.1e}, endings {int(gaps.ending.sum())})"
            )
            self.failed += bool(wrong)

    def safe(self, name: str) -> None:
        """A world without finite numbers spoils no other, and none runs out of room."""
        physics = self.made(name, 512, disturbances=DISTURBED)
        state, action = self.begun(physics), self.actions(physics)
        for _ in range(20):
            state = physics.advance(state, action)
        physics.check()
        assert not physics.diverged.any()
        physics.worlds.qvel[5] = torch.nan
        physics.worlds.qpos[9, 0] = 1e20
        state = physics.advance(state, action)
        assert physics.diverged.nonzero().ravel().tolist() == [5, 9], physics.diverged.nonzero()
        assert all(bool(torch.isfinite(values).all()) for values in vars(state).values())
        for _ in range(20):
            state = physics.advance(state, action)
        assert not physics.diverged.any()
        say(f"{name}: two of 512 disturbed worlds diverged alone; {physics.warned()}")

    def lies_on_the_ground(self, count: int) -> None:
        """Robots that are dropped upside down: as many contacts as there can be."""
        physics = self.made("laikago_trot", count)
        state, action = self.begun(physics), self.actions(physics)
        rng = torch.Generator(self.device).manual_seed(1)
        turn = torch.randn((count, 4), generator=rng, device=self.device)
        physics.worlds.qpos[:, 3:7] = turn / turn.norm(dim=-1, keepdim=True)
        most = 0
        for _ in range(60):
            state = physics.advance(state, 5.0 * action)
            most = max(most, int(physics.worlds.nefc.max()))
        physics.check()
        say(
            f"laikago_trot: {count:,} robots dropped at any attitude: at most {most} of "
            f"{physics.worlds.rows} rows of constraints; {physics.warned()}"
        )

    def speed(self, name: str, count: int) -> None:
        physics = self.made(name, count)
        state, action = self.begun(physics), self.actions(physics)
        bare = self.rate(physics.worlds.step, count)
        self.begun(physics)

        def advance() -> None:
            nonlocal state
            state = physics.advance(state, action)

        advanced = self.rate(advance, count)
        environment: DeviceEnvironment[Any] = DeviceEnvironment(
            physics.task, physics, count, 0, physics.device
        )
        environment.reset()
        whole = self.rate(lambda: environment.step(action), count)
        environment.check()
        say(
            f"{name}, {count:,} worlds: control steps/s {bare:,.0f} physics alone, {advanced:,.0f} "
            f"with control and reading, {whole:,.0f} the environment"
        )

    def flipped(self, entry: str, path: Path) -> None:
        run = RunDirectory(path)
        record, policy = run.record(), run.policy()
        task = run.task(record.task)
        other = evaluate(
            policy, task, protocol=PROTOCOL, engine=partial(HostPhysics, device=self.device)
        )
        certified = replace(record.score, changes={})
        for one in flips(certified, other):
            say(f"{entry}: {one.verdict}: {one.flipped} of {one.verdicts} ({one.share:.1%})")
        say(
            f"{entry}: solved_reward {other.solved_reward:.4f} here, "
            f"{certified.solved_reward:.4f} certified"
        )

    def repeats(self, count: int) -> None:
        """The same bits twice with `deterministic`, and what that costs."""
        found = []
        for _ in range(2):
            physics = self.made("laikago_trot", count, disturbances=DISTURBED, deterministic=True)
            state, action = self.begun(physics), self.actions(physics)
            for _ in range(20):
                state = physics.advance(state, action)
            found.append(
                torch.cat([values.reshape(count, -1) for values in vars(state).values()], 1)
            )
        bare = self.rate(physics.worlds.step, count)
        equal = torch.equal(found[0].clone(), found[1])
        say(
            f"laikago_trot, deterministic, {count:,} worlds: twice the same bits: {equal}; "
            f"{bare:,.0f} control steps/s physics alone"
        )
        self.failed += not equal


def kept(entries: Path) -> dict[str, Path]:
    """The run with the lowest seed of each kept entry, by TASK/ENTRY."""

    def seed(run: Path) -> int:
        return int(run.name.removeprefix("seed"))

    return {
        f"{entry.parent.name}/{entry.name}": min(entry.glob("seed*"), key=seed)
        for entry in sorted(path.parent for path in entries.glob("*/*/manifest.json"))
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--compile", choices=MODELS, help="only fill the cache of kernels")
    parser.add_argument(
        "--only", nargs="+", metavar="WORD", help="sections of that name, or 'NAME, ...'"
    )
    parser.add_argument("--most", type=int, default=65_536, help="of the worlds")
    parser.add_argument("--seconds", type=float, default=400.0, help="begin no section after them")
    options = parser.parse_args()
    checks = Checks(torch.device(options.device))
    if options.compile:
        physics = checks.made(options.compile, 64, disturbances=DISTURBED)
        physics.advance(checks.begun(physics), checks.actions(physics))
        HostPhysics(tasks.make(options.compile), 64, device=checks.device).worlds.look()
        return 0
    began = time.perf_counter()
    sections: dict[str, Callable[[], object]] = {
        "versions": checks.versions,
        "compiling": checks.compiled,
    }
    for name in tasks.names():
        sections[f"agreement, {name}"] = partial(checks.agrees, name)
    for count in (16_384, 4_096, 65_536, 1_024):  # what matters most comes first
        for name in MODELS:
            if count in WORLDS[name] and count <= options.most:
                sections[f"speed, {name}, {count:,}"] = partial(checks.speed, name, count)
    for name in MODELS:
        sections[f"divergence, {name}"] = partial(checks.safe, name)
    sections["room"] = partial(checks.lies_on_the_ground, min(4_096, options.most))
    sections["deterministic"] = partial(checks.repeats, min(8_192, options.most))
    for entry, path in kept(ENTRIES).items():  # many, so they come last
        sections[f"flips, {entry}"] = partial(checks.flipped, entry, path)
    for name, run in sections.items():
        if options.only and not any(f"{name},".startswith(f"{word},") for word in options.only):
            continue
        if time.perf_counter() - began > options.seconds:
            say(f"-- {name}: left out, {options.seconds:.0f} s are over")
            continue
        checks.section(name, run)
    say(f"{checks.failed} failed; {time.perf_counter() - began:.0f} s in all")
    return int(bool(checks.failed))


if __name__ == "__main__":
    sys.exit(main())
