"""The package under examples/, as a user builds, installs, uses and removes it.

docs/extending.md shows its files and these commands.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest
import yaml

from tsbench import methods, tasks
from tsbench.rl.stages import ImitationOptions

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "planar-puck"
GUIDE = (ROOT / "docs" / "extending.md").read_text("utf-8")
BLOCK = re.compile(r"^```(\w+) ?(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RUN = "runs/puck_gap/by_hand/seed0-smoke"


def pieces(name: str) -> list[str]:
    """What the guide shows of a file of the example, in order."""
    return [text for _, file, text in BLOCK.findall(GUIDE) if file == name]


def commands(title: str) -> list[str]:
    """The commands of tsbench in the first block of a section of the guide."""
    (section,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", GUIDE, re.MULTILINE | re.DOTALL)
    block = next(text for language, _, text in BLOCK.findall(section) if language == "sh")
    return [line for line in block.splitlines() if line.startswith("tsbench ")]


def files() -> Iterator[str]:
    """All but README.md, which leads to the guide."""
    for path in sorted(EXAMPLE.rglob("*")):
        parts = path.relative_to(EXAMPLE).parts
        made = any(part.startswith((".", "__pycache__", "dist", "build")) for part in parts)
        if path.is_file() and not made and path.name != "README.md":
            yield "/".join(parts)


def written(text: str) -> list[str]:
    return [line for line in text.splitlines() if line]


@pytest.mark.parametrize("name", list(files()))
def test_the_guide_shows_the_file(name: str) -> None:
    """Whole, in pieces of whole lines; only blank lines may be missing between two of them."""
    source = (EXAMPLE / name).read_text("utf-8")
    shown = pieces(name)
    assert shown, f"docs/extending.md does not show {name}"
    for piece in shown:
        assert f"\n{piece}" in f"\n{source}"
    assert written("".join(shown)) == written(source)


@pytest.mark.parametrize(
    "folder", sorted((ROOT / "examples").iterdir()), ids=lambda path: path.name
)
def test_the_page_of_an_example_names_what_there_is(folder: Path) -> None:
    """The tasks and methods of its command, the way to install it, and the guide."""
    text, project = (folder / "README.md").read_text("utf-8"), folder / "pyproject.toml"
    offers: dict[str, dict[str, str]] = {}
    if project.exists():
        assert f"pip install ./examples/{folder.name}\n" in text
        offers = tomllib.loads(project.read_text())["project"]["entry-points"]
    for kind, known in (("task", tasks.names()), ("method", methods.names())):
        own = offers.get(f"tsbench.{kind}s", {})
        named = set(re.findall(rf"\b{kind}=(\w+)", text))
        assert named
        assert named <= {*known, *own}
        assert named & own.keys() or not own
    (guide,) = re.findall(r"\]\((\.\./[^)#]+)", text)
    assert (folder / guide).is_file()


def test_a_planner_that_imitates_has_the_options_of_imitation() -> None:
    """Its own tests hold it to that, and need OMPL."""
    folder = ROOT / "examples" / "planner-ompl" / "planner_ompl"
    settings = yaml.safe_load((folder / "conf" / "method" / "ompl.yaml").read_text("utf-8"))
    assert {field.name for field in fields(ImitationOptions)} <= settings.keys()


def test_an_ideal_without_a_plan_is_the_plan_s() -> None:
    (by_hand,) = pieces("")
    script = f"""
from dataclasses import asdict
import numpy as np
from planar_puck.task import PuckGap, PuckState
class ByHand(PuckGap):
{by_hand}
one, other = (asdict(task().ideal()) for task in (PuckGap, ByHand))
for name, values in one.items():
    np.testing.assert_allclose(other[name], values, atol=1e-9)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=EXAMPLE, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_the_guide_shows_no_other_file() -> None:
    shown = {file for language, file, _ in BLOCK.findall(GUIDE) if file and language != "sh"}
    assert shown == set(files())


@dataclass(frozen=True)
class Installation:
    """A virtual environment, and a directory to work in."""

    venv: Path
    folder: Path

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Runs a command of the environment's in the directory, without the checkout in sight."""
        environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        environment["PATH"] = os.pathsep.join([str(self.venv / "bin"), os.environ["PATH"]])
        return subprocess.run(
            words, cwd=self.folder, env=environment, capture_output=True, text=True
        )

    def succeed(self, *words: str) -> str:
        done = self.run(*words)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def pip(self, verb: str, *words: str) -> None:
        """No index is asked: every requirement has to be there."""
        options = ["--no-index"] if verb == "install" else []
        interpreter = ["--python", str(self.venv / "bin" / "python")]
        quiet = ["--disable-pip-version-check", "--quiet"]
        self.succeed(sys.executable, "-m", "pip", *interpreter, verb, *quiet, *options, *words)

    def listed(self) -> dict[str, Any]:
        """What `tsbench list` tells."""
        self.succeed("tsbench", "list", "--json", "list.json")
        file = self.folder / "list.json"
        content: dict[str, Any] = json.loads(file.read_text())
        file.unlink()
        return content


@pytest.fixture
def installation(tmp_path: Path) -> Installation:
    """A fresh environment, which sees the dependencies that are installed for these tests."""
    made = Installation(tmp_path / "venv", tmp_path / "work")
    made.folder.mkdir()
    venv.create(made.venv)
    site = sysconfig.get_path("purelib", vars={"base": str(made.venv)})
    dependencies = dict.fromkeys(sysconfig.get_path(name) for name in ("purelib", "platlib"))
    (Path(site) / "dependencies.pth").write_text("\n".join(dependencies))
    return made


def built(source: Path, folder: Path) -> str:
    """The wheel of a source directory, which stays as it is."""
    words = ["-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(source)]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    return str(wheel)


def test_the_example_is_installed_used_and_removed(
    installation: Installation, tmp_path: Path
) -> None:
    for name, source in (("own", ROOT), ("example", EXAMPLE)):
        installation.pip("install", built(source, tmp_path / name))

    content = installation.listed()
    assert content["plug-ins"] == {"planar-puck 0.1.0": ["puck_gap", "by_hand", "random_search"]}
    assert content["refused"] == []
    where = installation.succeed("python", "-c", "import tsbench; print(tsbench.__file__)")
    assert where.startswith(str(installation.venv))

    answers = {}
    for command in commands("Try it"):
        answers[command] = installation.succeed(*command.split())
    assert all(
        name in answers["tsbench list"]
        for name in ("puck_gap", "by_hand", "random_search", "planar-puck")
    )
    assert "compared bit for bit: equal" in answers[f"tsbench evaluate {RUN}"]
    for method in ("by_hand", "random_search", "twostage"):
        run = installation.folder / "runs" / "puck_gap" / method / "seed0-smoke"
        score = json.loads((run / "score.json").read_text())
        assert (score["task"], score["method"]) == ("puck_gap", method)
        assert (run / "report.html").is_file()
    assert (installation.folder / "puck.html").stat().st_size > 100_000

    shutil.copytree(EXAMPLE / "tests", installation.folder / "tests")
    told = installation.succeed("python", "-m", "pytest", "-q", "tests")
    assert re.search(r"^\d+ passed in ", told, re.MULTILINE), told

    installation.pip("uninstall", "--yes", "planar-puck")
    content = installation.listed()
    assert content["plug-ins"] == {}
    assert "puck_gap" not in content["tasks"]
    assert not {"by_hand", "random_search"} & set(content["methods"])
    done = installation.run("tsbench", "evaluate", RUN)
    assert done.returncode == 2
    assert re.fullmatch(r"tsbench: unknown task 'puck_gap'; allowed: .*\n", done.stderr)
