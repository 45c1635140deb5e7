"""The files of the wheel, the pinned packages, and the words that `make` hands on."""

from __future__ import annotations

import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest

from tsbench import methods, tasks

ROOT = Path(__file__).parents[1]
MOST_BYTES = 15_000_000  # a wheel has 10.8 MB, an sdist 11.8; each kept training is 0.2 to 0.4


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    return dict(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"])


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built wheel, unpacked."""
    folder = tmp_path_factory.mktemp("wheel")
    words = ["-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("*.whl")
    with zipfile.ZipFile(built) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


def test_the_wheel_holds_the_data(wheel: Path) -> None:
    package = wheel / "tsbench"
    assert (package / "py.typed").is_file()  # type checkers read the annotations
    models = list((ROOT / "models").iterdir())
    assert models
    for path in models:
        assert (package / "models" / path.name).read_bytes() == path.read_bytes()
    assert (package / "leaderboards" / "README.md").is_file()
    assert (package / "py.typed").is_file()
    assert (package / "viewer" / "page.html").is_file()
    assert (package / "viewer" / "paper" / "page.html").is_file()
    assert {path.stem for path in (package / "references").iterdir()} <= set(tasks.names())
    assert {path.stem for path in (package / "conf" / "task").iterdir()} == set(tasks.names())
    assert {path.stem for path in (package / "conf" / "method").iterdir()} == set(methods.names())
    assert not (wheel / "tests").exists()


def test_the_wheel_works_without_the_checkout(wheel: Path, tmp_path: Path) -> None:
    program = f"""
import sys
sys.path.insert(0, {str(wheel)!r})
import tsbench
from tsbench import cli
from tsbench.sim.model import model_path
for name in {[path.stem for path in (ROOT / "models").glob("*.xml")]}:
    assert {str(wheel)!r} in str(model_path(name)), model_path(name)
sys.exit(cli.main(["list"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in tasks.names())


def test_the_wheel_is_small(wheel: Path) -> None:
    """The kept entries are most of it."""
    (built,) = wheel.parent.glob("*.whl")
    assert built.stat().st_size < MOST_BYTES


@pytest.mark.parametrize("version", ["3.11", "3.12"])
def test_the_wheel_starts_in_an_empty_environment(
    version: str, wheel: Path, tmp_path: Path
) -> None:
    """Without any package, help and a mistake's line work. `.ci/package` installs all of them."""
    python = shutil.which(f"python{version}")
    if python is None or subprocess.run([python, "-c", ""]).returncode:
        pytest.skip(f"no Python {version} here")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}

    def call(*words: str) -> subprocess.CompletedProcess[str]:
        program = f"import sys; sys.path.insert(0, {str(wheel)!r}); import tsbench.cli as c; "
        program += f"sys.exit(c.main({words!r}))"
        return subprocess.run(
            [python, "-S", "-c", program], cwd=tmp_path, env=environment, capture_output=True,
            text=True,
        )  # fmt: skip

    done = call("--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: tsbench COMMAND")
    done = call("veiw")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_the_sdist_makes_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    words = ["-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr  # without words, build makes the wheel of the sdist
    (source,), (built,) = tmp_path.glob("*.tar.gz"), tmp_path.glob("*.whl")
    assert source.stat().st_size < MOST_BYTES
    with tarfile.open(source) as archive:
        folders = {name.split("/")[1] for name in archive.getnames()}
    assert "examples" in folders
    assert "tests" not in folders  # they need files that are not there
    with zipfile.ZipFile(built) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    here = {str(path.relative_to(wheel)) for path in wheel.rglob("*") if path.is_file()}
    assert names == here


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_requirement_is_pinned(project: dict[str, Any]) -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {normalised(line.split("==")[0]) for line in lines if "==" in line}
    extras = dict(project["optional-dependencies"])
    del extras["ray"]  # it needs older packages than the pinned ones, so it has an own environment
    listed = [*project["dependencies"], *itertools.chain(*extras.values())]
    wanted = [item for item in listed if not item.startswith("tsbench[")]  # an extra in another
    assert {normalised(re.split(r"[<>=]", item)[0]) for item in wanted} <= pinned


def test_pins_name_no_local_build() -> None:
    assert "+" not in (ROOT / "constraints.txt").read_text()


def made(*words: str) -> list[str]:
    """The words of the last command that `make` would run."""
    of_make = ("MAKE", "MFLAGS", "ARGS")  # of a `make test` that runs the tests
    environment = {k: v for k, v in os.environ.items() if not k.startswith(of_make)}
    done = subprocess.run(
        ["make", "--dry-run", *words], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return shlex.split(done.stdout.splitlines()[-1])


def test_make_run_is_the_main_job() -> None:
    assert made("run") == [".venv/bin/tsbench", "run", "task=laikago_trot"]


@pytest.mark.parametrize(
    "words",
    [
        ["task=rocket_navigation", "method=twostage", "budget=smoke"],
        ["task=rocket_navigation", "task.training.plan.hidden=[64, 64]", "seed=range(0,3)"],
        ["task=rocket_navigation", "directory=it's mine/${seed}", "+task.constants.x=1"],
        ["task=rocket_navigation", r"directory=back\slash", "method.imitation=null"],
    ],
)
def test_make_run_hands_its_words_on(words: list[str]) -> None:
    assert sorted(made("run", *words)[2:]) == sorted(words)


def test_make_run_takes_other_words_in_args() -> None:
    words = made("run", "ARGS=-m seed=0,1", "task=rocket_navigation", "PYTHON=python3")
    assert words[2:] == ["task=rocket_navigation", "-m", "seed=0,1"]
