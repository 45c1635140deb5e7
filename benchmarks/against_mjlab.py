"""mjlab's flat Go1 task, whose robot is like Laikago, beside the figures of `bench --only gpu`.

    pip install 'mjlab>=1.6,<1.7'    in an environment of its own: it pins another MuJoCo
    python benchmarks/against_mjlab.py --worlds 1024 4096 16384 65536

prints control steps per second of all worlds together: from random actions to observations,
rewards, endings and resets, as `environment` of `tsbench bench --only gpu`. The robots, the control
steps (mjlab: 4 physics steps of 5 ms; Laikago: 20 of 1.7 ms) and the observations differ, so
physics steps are printed too. tsbench is not imported.
"""

from __future__ import annotations

import argparse
import sys
import time

import torch

TASK = "Mjlab-Velocity-Flat-Unitree-Go1"
CHUNK = 20  # control steps between two looks at the clock
NOISE = 0.2  # standard deviation of actions: the robots move, and do not fall at once
DRAWN = 16  # different actions, drawn in advance


def rate(worlds: int, device: str, seconds: float) -> tuple[float, int]:
    """The median of control steps per second, and physics steps in a control step."""
    # Here, since compare.py imports this file too.
    import mjlab.tasks  # noqa: F401  registers its tasks
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.registry import load_env_cfg

    config = load_env_cfg(TASK)
    config.scene.num_envs = worlds
    environment = ManagerBasedRlEnv(cfg=config, device=device)
    environment.reset()
    drawn = NOISE * torch.randn(DRAWN, worlds, environment.action_manager.total_action_dim)
    actions = drawn.to(device)

    def chunk() -> float:
        if device != "cpu":
            torch.cuda.synchronize()
        start = time.perf_counter()
        for step in range(CHUNK):
            environment.step(actions[step % DRAWN])
        if device != "cpu":
            torch.cuda.synchronize()
        return CHUNK * worlds / (time.perf_counter() - start)

    chunk()  # the first steps compile, record and allocate
    found, began = [chunk()], time.perf_counter()
    while time.perf_counter() - began < seconds:
        found.append(chunk())
    environment.close()
    return sorted(found)[len(found) // 2], config.decimation


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 4096, 16384, 65536])
    parser.add_argument("--device", default="cuda", help="as torch names it (cuda)")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each figure (5)")
    given = parser.parse_args()
    if given.device != "cpu" and not torch.cuda.is_available():
        parser.error(f"--device {given.device}: torch finds no GPU; cpu is slow, for tests")
    for worlds in given.worlds:
        steps, substeps = rate(worlds, given.device, given.seconds)
        sys.stdout.write(
            f"mjlab go1 environment.{worlds}: {steps:,.0f} steps/s, "
            f"{steps * substeps:,.0f} physics steps/s\n"
        )
        sys.stdout.flush()


if __name__ == "__main__":
    main()
