"""The array script for Slurm, with stand-ins for `sbatch` and `scontrol`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "examples" / "slurm" / "array.sh"
WORDS = [
    "task=rocket_navigation", "method=monolithic", "budget=smoke", "checkpoint=0", "loggers=[]",
    "task.budgets.smoke.plan=2048", "task.budgets.smoke.act=4096",
]  # fmt: skip

# The command. With HELD it waits in its second iteration for the signal that interrupts it.
TSBENCH = """
import os, sys, time
from tsbench import cli
from tsbench.runs.workspace import RunWorkspace

def held(self, *row):
    record(self, *row)
    rows.append(row)
    while len(rows) == 2 and self._stopped_by is None:
        time.sleep(0.01)

rows, record = [], RunWorkspace.record
if "HELD" in os.environ:
    RunWorkspace.record = held
sys.exit(cli.main())
"""

# Starts the tasks of an array one after the other, and interrupts the first start of each while it
# trains by SIGTERM to the shell, as near the time limit.
SBATCH = """
import os, pathlib, signal, subprocess, sys, time

array, script, *words = sys.argv[1:]
options = [line.split()[1] for line in open(script) if line.startswith("#SBATCH")]
assert "--requeue" in options and any(one.startswith("--signal=B:TERM@") for one in options)
first, last = map(int, array.removeprefix("--array=").split("-"))
for task in range(first, last + 1):
    job = str(100 + task)
    asked = pathlib.Path("requeue-" + job)
    environment = os.environ | {
        "SLURM_ARRAY_TASK_ID": str(task), "SLURM_JOB_ID": job, "SLURM_CPUS_PER_TASK": "1"
    }
    for start in range(3):
        if start == 0:
            environment["HELD"] = "yes"
        else:
            environment.pop("HELD", None)
        shell = subprocess.Popen(["bash", script, *words], env=environment, start_new_session=True)
        if start == 0:
            until = time.monotonic() + 300
            while shell.poll() is None and time.monotonic() < until:
                found = pathlib.Path("runs").glob(f"*/*/seed{task}-*/metrics.jsonl")
                if any(path.read_bytes().count(b"\\n") > 1 for path in found):  # a checkpoint too
                    break
                time.sleep(0.1)
            shell.send_signal(signal.SIGTERM)
        print("start", task, start, shell.wait(), asked.exists(), flush=True)
        if not asked.exists():
            break
        asked.unlink()
"""


def program(path: Path, code: str) -> None:
    path.write_text(code)
    path.chmod(0o755)


def test_an_array_that_is_interrupted(tmp_path: Path) -> None:
    """A task that is stopped is started again and goes on where it was. That it then ends with the
    bits of a run that was left alone, tests/runs/test_resume.py shows."""
    programs = tmp_path / "bin"
    programs.mkdir()
    program(programs / "tsbench", f"#!{sys.executable}{TSBENCH}")
    program(programs / "scontrol", '#!/bin/sh\ntest "$1" = requeue && touch "requeue-$2"\n')
    program(programs / "sbatch", f"#!{sys.executable}{SBATCH}")
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(sys.path), "PATH": f"{programs}:{os.environ['PATH']}",
    }  # fmt: skip
    done = subprocess.run(
        ["sbatch", "--array=0-0", str(SCRIPT), "run", "-m", *WORDS, "seed=%a"],
        cwd=tmp_path, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    starts = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("start")]
    assert starts == [["0", "0", "143", "True"], ["0", "1", "0", "False"]], done.stderr
    (run,) = (tmp_path / "runs/rocket_navigation/monolithic").glob("seed0-*")
    assert (run / "score.json").is_file()
    assert "resumed: train goes on at" in (run / "log.txt").read_text()


@pytest.mark.parametrize("status", [0, 2])
def test_a_task_that_ends_by_itself_is_not_started_again(status: int, tmp_path: Path) -> None:
    """Also with an error, which would come again; %a is replaced wherever it stands."""
    program(tmp_path / "tsbench", f'#!/bin/sh\necho "$@" > words\nexit {status}\n')
    program(tmp_path / "scontrol", "#!/bin/sh\ntouch asked\n")
    variables = {"SLURM_ARRAY_TASK_ID": "7", "SLURM_JOB_ID": "9", "SLURM_CPUS_PER_TASK": "2"}
    done = subprocess.run(
        ["bash", str(SCRIPT), "run", "-m", "seed=%a", "directory=a b/%a"],
        cwd=tmp_path, env=os.environ | variables | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )  # fmt: skip
    assert done.returncode == status
    assert (tmp_path / "words").read_text() == "run -m seed=7 directory=a b/7 threads=2\n"
    assert not (tmp_path / "asked").exists()
