"""Tasks and methods of other installed packages."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import tsbench
from tsbench import tasks
from tsbench.core import plugins

if TYPE_CHECKING:
    from tests.conftest import Forks

SOME = tasks.names()[0]
CONF = Path(tsbench.__file__).parent / "conf"
TASK = '''
"""A task that is one of tsbench's own under another name, with a model and a mesh of its own."""

from dataclasses import dataclass

from tsbench.sim.model import load_spec
from tsbench.tasks import register
from tsbench.tasks.rocket import Rocket, rocket_navigation


@dataclass(frozen=True)
class Flight(Rocket):
    def spec(self):
        spec = super().spec()
        other = load_spec("stone", __name__)
        spec.attach(other, prefix="stone_", frame=spec.worldbody.add_frame(pos=[0.0, 9.0, 0.0]))
        return spec


@register("toy_flight")
def toy_flight(distance: float = 20.0) -> Rocket:
    return Flight(**{**vars(rocket_navigation(distance)), "name": "toy_flight"})
'''
STONE = """
<mujoco model="stone">
  <include file="assets.xml"/>
  <worldbody><geom type="mesh" mesh="stone" contype="0" conaffinity="0"/></worldbody>
</mujoco>
"""
ASSETS = '<mujoco><asset><mesh name="stone" file="meshes/stone.obj"/></asset></mujoco>'
MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
METHOD = '''
"""Lazy: what the paper does, under another name and by another package."""

from dataclasses import replace

from tsbench.methods.twostage import STAGES, Options
from tsbench.methods import twostage


def train(problem, workspace):
    policy = twostage.train(problem, workspace)
    return replace(policy, info=replace(policy.info, method="lazy"))
'''


@dataclass(frozen=True)
class Toy:
    """An installed plug-in.

    Attributes:
        site: the folder that it is installed into.
        package: its name for `import`.
    """

    site: Path
    package: str = "toy"

    @property
    def folder(self) -> Path:
        return self.site / self.package

    @property
    def info(self) -> Path:
        return self.site / f"{self.package}_tasks-0.dist-info"

    def install(self, version: str = "1.0") -> Toy:
        """Writes the files of an installed wheel."""
        files = {
            "__init__.py": "",
            "task.py": TASK,
            "lazy.py": METHOD,
            "models/stone.xml": STONE,
            "models/assets.xml": ASSETS,
            "models/meshes/stone.obj": MESH,
            "conf/task/toy_flight.yaml": self._copied("task/rocket_navigation.yaml", "toy_flight"),
            "conf/method/lazy.yaml": self._copied("method/twostage.yaml", "lazy"),
        }
        for name, content in files.items():
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / name).write_text(content)
        self.info.mkdir()
        (self.info / "entry_points.txt").write_text(
            f"[tsbench.tasks]\nanything = {self.package}.task\n"
            f"[tsbench.methods]\nlazy = {self.package}.lazy\n"
        )
        self.be(version)
        return self

    def be(self, version: str) -> None:
        """Changes the version of the installed package."""
        (self.info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {self.package}-tasks\nVersion: {version}\n"
        )

    @staticmethod
    def _copied(config: str, name: str) -> str:
        return (CONF / config).read_text().replace(f"name: {Path(config).stem}", f"name: {name}")


@pytest.fixture
def toy(tmp_path: Path) -> Toy:
    return Toy(tmp_path / "site").install()


def call(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Runs a tsbench command. See `python`."""
    return python(folder, "-m", "tsbench", *words)


def train(forks: Forks, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """As `call`, in a process in which torch is loaded already."""
    return forks.call(folder, *words, path=[folder / "site"])


def python(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Runs Python in `folder`, with the plug-ins in its `site` installed."""
    path = os.pathsep.join([str(Path(tsbench.__file__).parents[1]), str(folder / "site")])
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )


def listed(folder: Path) -> dict[str, Any]:
    """The content of `tsbench list --json`."""
    (folder / "list.json").unlink(missing_ok=True)
    done = call(folder, "list", "--json", "list.json")
    assert done.returncode == 0, done.stderr
    content: dict[str, Any] = json.loads((folder / "list.json").read_text())
    for line in content["refused"]:
        assert f"Refused: {line}\n" in done.stdout
    return content


RUN = ["run", "task=toy_flight", "method=lazy", "budget=smoke", "threads=1"]
QUICK = [*RUN, "task.budgets.smoke.plan=512", "task.budgets.smoke.act=512"]


def test_a_plugin_is_as_good_as_what_is_built_in(forks: Forks, toy: Toy, tmp_path: Path) -> None:
    content = listed(tmp_path)
    assert "toy_flight" in content["tasks"]
    assert set(content["tasks"]["toy_flight"]["budgets"]) == {"smoke", "fast", "paper"}
    assert content["methods"]["lazy"].startswith("Lazy: what the paper does")
    assert content["plug-ins"] == {"toy-tasks 1.0": ["toy_flight", "lazy"]}
    assert content["refused"] == []

    done = train(forks, tmp_path, *QUICK, "directory=run")
    assert done.returncode == 0, done.stderr
    versions = json.loads((tmp_path / "run" / "versions.json").read_text())
    assert versions["plug-ins"].keys() == {"toy-tasks"}
    assert versions["plug-ins"]["toy-tasks"]["version"] == "1.0"
    score = json.loads((tmp_path / "run" / "score.json").read_text())
    assert (score["task"], score["method"]) == ("toy_flight", "lazy")
    assert score["score"]["origin"]["packages"]["toy-tasks"] == "1.0"

    done = call(tmp_path, "evaluate", "run")
    assert done.returncode == 0, done.stderr
    assert "compared bit for bit: equal" in done.stdout
    done = call(tmp_path, "view", "run", "--html", "view.html")
    assert done.returncode == 0, done.stderr

    toy.be("1.1")
    done = call(tmp_path, "evaluate", "run")
    assert "toy-tasks 1.0 there, 1.1 here" in done.stdout


def test_the_runs_of_a_sweep(forks: Forks, toy: Toy, tmp_path: Path) -> None:
    done = train(forks, tmp_path, *QUICK, "-m", "seed=0,1")
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("runs/toy_flight/lazy/*/score.json"))) == 2


def test_another_plugin_does_not_go_on_with_a_run(forks: Forks, toy: Toy, tmp_path: Path) -> None:
    """A run is not resumed with another version of its plug-in, nor with other code."""
    done = train(forks, tmp_path, *QUICK, "directory=run")
    assert done.returncode == 0, done.stderr
    (tmp_path / "run" / "score.json").unlink()  # as if it had been interrupted at its very end
    for path, old, new in (
        (toy.info / "METADATA", "Version: 1.0", "Version: 1.1"),
        (toy.folder / "lazy.py", '"lazy"', '"lazy" + ""'),
    ):
        before = path.read_text()
        path.write_text(before.replace(old, new))
        done = train(forks, tmp_path, "run", "resume=run")
        assert done.returncode == 2
        assert "was begun with another version of a plug-in" in done.stderr
        assert len(done.stderr.splitlines()) == 1
        path.write_text(before)


def test_the_code_of_a_plugin(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hash covers the content and the names of all files but those that Python itself
    writes."""
    monkeypatch.syspath_prepend(str(toy.site))
    try:
        provider = plugins.Provider("toy", "toy-tasks", "1.0")
        codes = [provider.code()]
        for name in ("lazy.py", "conf/method/lazy.yaml", "models/stone.xml"):
            with (toy.folder / name).open("a") as file:
                file.write("\n")
            codes.append(provider.code())
        (toy.folder / "lazy.py").rename(toy.folder / "lazier.py")
        codes.append(provider.code())
        assert len(set(codes)) == len(codes)
        (toy.folder / "lazy.pyc").write_text("")
        assert provider.code() == codes[-1]
    finally:
        sys.modules.pop("toy", None)


@pytest.mark.parametrize("part", ["task/toy_flight", "method/lazy"])
def test_a_missing_configuration(part: str, toy: Toy, tmp_path: Path) -> None:
    (toy.folder / "conf" / f"{part}.yaml").unlink()
    done = call(tmp_path, *RUN)
    kind, name = part.split("/")
    line = f"tsbench: the {kind} {name!r} cannot be run: its package lacks conf/{part}.yaml\n"
    assert (done.returncode, done.stderr) == (2, line)
    assert listed(tmp_path)["incomplete"] == [line.removeprefix("tsbench: ").strip()]


def test_a_broken_promise_is_listed_and_refused(toy: Toy, tmp_path: Path) -> None:
    assert listed(tmp_path)["incomplete"] == []
    source = TASK.replace("class Flight(Rocket):", 'class Flight(Rocket):\n    pushed = "roket"')
    (toy.folder / "task.py").write_text(source)
    (line,) = listed(tmp_path)["incomplete"]
    assert line.startswith("unknown body `pushed` of the task toy_flight 'roket'; allowed: ")
    done = call(tmp_path, *RUN)
    assert (done.returncode, done.stderr) == (2, f"tsbench: {line}\n")
    assert not (tmp_path / "runs").exists()


def test_a_task_that_cannot_be_made_leaves_the_others_to_gymnasium(
    toy: Toy, tmp_path: Path
) -> None:
    sunk = 'raise ValueError("sunk")\n    return Flight'
    (toy.folder / "task.py").write_text(TASK.replace("return Flight", sunk))
    program = (
        f"import gymnasium, tsbench.gym; gymnasium.spec(tsbench.gym.identifier({SOME!r}))\n"
        "try: tsbench.gym.make('toy_flight')\n"
        "except tsbench.TsbenchError as error: print(error)"
    )
    done = python(tmp_path, "-c", program)
    assert done.stdout == "toy_flight cannot be made: sunk\n", done.stderr


def test_a_configuration_of_another_name(toy: Toy, tmp_path: Path) -> None:
    """It is told by `tsbench run` and by `tsbench list`, which goes on to show the others."""
    file = toy.folder / "conf" / "task" / "toy_flight.yaml"
    file.write_text(file.read_text().replace("name: toy_flight", "name: flight"))
    line = "conf/task/toy_flight.yaml must have name: toy_flight, not flight"
    done = call(tmp_path, *RUN)
    assert (done.returncode, done.stderr) == (2, f"tsbench: {line}\n")
    content = listed(tmp_path)
    assert content["incomplete"] == [line]
    assert content["tasks"].keys() == set(tasks.names())


@pytest.mark.parametrize("file", ["__init__.py", "task.py"])
def test_a_broken_plugin_breaks_nothing_else(file: str, toy: Toy, tmp_path: Path) -> None:
    (toy.folder / file).write_text("import nothing_of_that_name\n")
    content = listed(tmp_path)
    assert "toy_flight" not in content["tasks"]
    line = (
        "the plug-in toy-tasks 1.0 cannot be used: "
        "ModuleNotFoundError: No module named 'nothing_of_that_name'"
    )
    assert content["refused"] == [line]
    assert ("lazy" in content["methods"]) == (file == "task.py")
    done = call(tmp_path, "run", "task=toy_flight")
    assert done.returncode == 2
    assert done.stderr.startswith("tsbench: unknown task 'toy_flight'; ")
    assert done.stderr.endswith(f"; {line}\n")
    assert call(tmp_path, "describe", SOME).returncode == 0


def test_a_broken_method_is_told_when_it_is_used(forks: Forks, toy: Toy, tmp_path: Path) -> None:
    (toy.folder / "lazy.py").write_text(
        '"""Lazy: it fails when it is imported, not before."""\n1/0'
    )
    assert listed(tmp_path)["methods"]["lazy"].startswith("Lazy: it fails")
    done = train(forks, tmp_path, *RUN)
    assert done.returncode == 2
    assert done.stderr == (
        "tsbench: the plug-in toy-tasks 1.0 cannot be used: ZeroDivisionError: division by zero\n"
    )
    done = call(tmp_path, "describe", SOME)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("right", "wrong", "given"),
    [
        ("    return replace", "    replace", "NoneType, not a Policy"),
        ('method="lazy"', 'method="twostage"', "a policy that names the method twostage"),
    ],
)
def test_a_method_that_returns_something_else(
    forks: Forks, toy: Toy, tmp_path: Path, right: str, wrong: str, given: str
) -> None:
    (toy.folder / "lazy.py").write_text(METHOD.replace(right, wrong))
    done = train(forks, tmp_path, *QUICK)
    assert done.returncode == 2
    line = f"tsbench: the method lazy returns {given}"
    assert done.stderr.splitlines()[-1].startswith(line)


def test_a_method_that_goes_beyond_its_budget(forks: Forks, toy: Toy, tmp_path: Path) -> None:
    more = "replace(problem, budget=replace(problem.budget, act=20 * problem.budget.act))"
    (toy.folder / "lazy.py").write_text(
        METHOD.replace("= twostage.train(problem,", f"= twostage.train({more},")
    )
    done = train(forks, tmp_path, *QUICK)
    assert done.returncode == 0, done.stderr
    line = "over the budget, so no leaderboard takes this run: stages of 10,752 steps, where the"
    assert line in done.stdout


def test_a_missing_module_and_a_single_one(toy: Toy, tmp_path: Path) -> None:
    (toy.folder / "task.py").unlink()
    (toy.folder / "lazy.py").unlink()
    line = "the plug-in toy-tasks 1.0 cannot be used: ModuleNotFoundError: No module named 'toy."
    assert [text.startswith(line) for text in listed(tmp_path)["refused"]] == [True, True]
    (toy.info / "entry_points.txt").write_text("[tsbench.tasks]\nanything = single\n")
    (toy.site / "single.py").write_text("")
    (line,) = listed(tmp_path)["refused"]
    assert line.endswith("ImportError: single is a single module; it must be a package")


def test_a_name_that_two_bring_is_refused(toy: Toy, tmp_path: Path) -> None:
    Toy(toy.site, "other").install("2.0")
    both = "is brought by other-tasks 2.0 and by toy-tasks 1.0: uninstall all but one"
    content = listed(tmp_path)
    assert content["refused"] == [f"the task 'toy_flight' {both}", f"the method 'lazy' {both}"]
    assert content["tasks"].keys() == set(tasks.names())
    done = call(tmp_path, "run", "task=toy_flight")
    assert (done.returncode, done.stderr) == (2, f"tsbench: the task 'toy_flight' {both}\n")
    done = call(tmp_path, "run", f"task={SOME}", "method=lazy")
    assert (done.returncode, done.stderr) == (2, f"tsbench: the method 'lazy' {both}\n")


def test_no_plugin_takes_a_name_of_tsbenchs_own(toy: Toy, tmp_path: Path) -> None:
    source = TASK.replace('register("toy_flight")', f'register("{SOME}")')
    (toy.folder / "task.py").write_text(source)
    version = tsbench.__version__
    line = f"the task '{SOME}' is brought by toy-tasks 1.0 and by tsbench {version}: uninstall"
    content = listed(tmp_path)
    assert [refused.startswith(line) for refused in content["refused"]] == [True]
    assert content["tasks"].keys() == set(tasks.names()) - {SOME}
    done = call(tmp_path, "run", f"task={SOME}")
    assert done.returncode == 2
    assert done.stderr.startswith(f"tsbench: {line}")


def test_where_a_model_lies_is_not_part_of_it(toy: Toy, tmp_path: Path) -> None:
    """The same plug-in in another folder has the same physics, mesh included."""
    program = (
        "from tsbench import tasks; from tsbench.sim.model import *\n"
        "spec = tasks.make('toy_flight').spec()\n"
        "print(fingerprint(spec), compiled_hash(spec), spec.compile().mesh('stone_stone').vertnum)"
    )
    elsewhere = tmp_path / "a folder with another name"
    Toy(elsewhere / "site").install()
    found = [python(folder, "-c", program) for folder in (tmp_path, elsewhere)]
    assert [done.returncode for done in found] == [0, 0], found[0].stderr
    assert found[0].stdout == found[1].stdout
    assert found[0].stdout.endswith(" [4]\n")
    (toy.folder / "models" / "stone.xml").unlink()
    done = python(tmp_path, "-c", program)
    assert done.stderr.endswith("TsbenchError: the package toy lacks models/stone.xml\n")
