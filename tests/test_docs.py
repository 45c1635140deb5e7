"""The documentation: each command and each block of README.md and of the pages under docs/.

The second word of a block's info string says what is done with it here:

- `sh run`: its commands are run, in a directory with the board in it. RUN is a run with
  `budget=smoke`, which the README's first block makes.
- `sh check`: its commands are checked, but take too long, need a network or wait for someone. A
  training's configuration is composed; the words of every other verb and of scripts are parsed;
  make says what it would do; files, modules and extras have to exist.
- `sh elsewhere`: the same for commands of another machine, such as one with a GPU.
- `sh example`: test_example.py runs them, with the package of docs/extending.md installed.
- `python`: run, the blocks of a page one after the other. `yaml` and `toml` are parsed.

Blocks of docs/extending.md that name a file are compared with it in test_example.py. `make docs`
checks links from page to page and their anchors.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import tomllib
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from tsbench import cli, methods, tasks
from tsbench.cli import arguments, verbs
from tsbench.core.errors import TsbenchError
from tsbench.core.words import short
from tsbench.runs import config, schema

ROOT = Path(__file__).parents[1]
MADE = ("board.md", "tasks", "methods")  # by docs/cards.py
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(path for path in sorted((ROOT / "docs").glob("*.md")) if path.name not in MADE),
]
BLOCK = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SMOKE = "runs/rocket_navigation/twostage/seed0-smoke"
# Words that stand for something else, and what stands for them here.
STAND_INS = {
    "RUN": SMOKE,
    "FILE": "file",
    "TASK": "rocket_navigation",
    "METHOD": "twostage",
    "NAME": "name",
    "FIGURES": "figures",
    "DIRECTORY": "directory",
    "REASON": "reason",
    "PATH_TO_TSBENCH": str(ROOT),
    "S": "0",
    "D": "80",
    "device=cuda": "device=warp",  # a GPU's code on a CPU
}
SHELL = {".", "cd", "export", "git", "mkdir", "pre-commit", "sha256sum"}  # not tsbench's


@dataclass(frozen=True)
class Block:
    """A block of code: its page, language, the second word of its info string, and its text."""

    page: Path
    language: str
    how: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.stem}:{self.text[:30]!r}"


def blocks() -> Iterator[Block]:
    for page in PAGES:
        for info, text in BLOCK.findall(page.read_text(encoding="utf-8")):
            language, _, how = info.partition(" ")
            if not language.startswith("{"):  # a directive of Sphinx
                yield Block(page, language, how, text)


BLOCKS = list(blocks())
COMMANDS = [block for block in BLOCKS if block.language == "sh"]


def commands(text: str) -> list[list[str]]:
    """The words of each command of a block, as bash reads them."""
    lines = [
        part.partition(" > ")[0].partition(" | ")[0]
        for line in text.replace("\\\n", " ").splitlines()
        for part in re.sub(r"(^|\s)#.*", "", line).split(" && ")
        if part.strip()
    ]
    script = "set -f\n" + "".join(f"printf '%s\\0' {line}; echo\n" for line in lines)
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    return [line.split("\0")[:-1] for line in done.stdout.splitlines()]


def stood_in(word: str) -> str:
    for name, value in STAND_INS.items():
        word = re.sub(rf"(?<!\w){name}(?!\w)", value, word)
    return word


def test_every_block_says_how_it_is_tested() -> None:
    assert {block.how for block in COMMANDS} == {"run", "check", "elsewhere", "example"}
    assert {block.page.stem for block in COMMANDS if block.how == "example"} == {"extending"}
    assert {block.language for block in BLOCKS} <= {"sh", "python", "yaml", "toml", "xml", "text"}


# What is run


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory in which blocks are run, with the run that RUN stands for."""
    folder: Path = tmp_path_factory.mktemp("home")
    first = next(block for block in COMMANDS if block.how == "run")
    assert first.page.name == "README.md"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for words in commands(first.text):
            assert words[:2] == ["make", "run"]
            assert cli.main(["run", *words[2:], "threads=1"]) == 0
    return folder


def test_the_first_command_of_the_readme_makes_a_run(home: Path) -> None:
    score = json.loads((home / SMOKE / "score.json").read_text())
    assert score["score"]["protocol"] == "smoke"
    assert (home / SMOKE / "report.html").stat().st_size > 100_000


@pytest.mark.parametrize("block", [b for b in COMMANDS if b.how == "run"], ids=str)
def test_commands_run(
    block: Block, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").symlink_to(home / "runs")
    (tmp_path / "leaderboards").symlink_to(ROOT / "leaderboards")
    for words in commands(block.text):
        if words[:2] == ["make", "run"]:  # made by `home`
            assert words == commands(next(b.text for b in COMMANDS if b.how == "run"))[0]
        else:
            assert words[0] == "tsbench"
            assert cli.main([stood_in(word) for word in words[1:]]) == 0


PYTHON = [page for page in PAGES if any(b.language == "python" for b in BLOCKS if b.page == page)]


@pytest.mark.parametrize(
    "page", [page for page in PYTHON if page.stem != "extending"], ids=lambda page: page.stem
)
def test_python_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "leaderboards").symlink_to(ROOT / "leaderboards")
    names: dict[str, Any] = {"__name__": page.stem}
    for block in BLOCKS:
        if block.page == page and block.language == "python":
            assert not block.how
            exec(compile(block.text, str(page), "exec"), names)


# What is checked


class ParsedError(Exception):
    """The words of a command were parsed without a mistake."""


@pytest.fixture
def parsing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A verb stops after it has parsed its words."""
    for name in ("parse_args", "parse_intermixed_args"):
        monkeypatch.setattr(arguments.Parser, name, _stopping(getattr(arguments.Parser, name)))


def _stopping(parse: Callable[..., Any]) -> Callable[..., Any]:
    def parse_and_stop(*arguments: Any) -> Any:
        parse(*arguments)
        raise ParsedError

    return parse_and_stop


@pytest.mark.parametrize("block", [b for b in COMMANDS if b.how in ("check", "elsewhere")], ids=str)
@pytest.mark.usefixtures("parsing")
def test_commands_are_right(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found = commands(block.text)
    assert found
    for words in found:
        while re.fullmatch(r"\w+=.*", words[0]):  # a variable of the command
            words = words[1:]
        if words[0] not in SHELL:
            CHECKS[words[0]]([stood_in(word) for word in words[1:]])


def check_tsbench(words: list[str]) -> None:
    verb, rest = words[0], words[1:]
    assert verb in verbs.VERBS
    if verb in ("run", "tune"):
        own = re.compile(r"-m|--multirun|--best|trials=\d+|study=.*|\+?hydra[./].*")
        given = [word for word in rest if not own.fullmatch(word)]
        if given[0].startswith("resume="):
            assert len(given) == 1
        else:
            jobs = list(config.sweep([word for word in given if "=" in word]))
            assert len(jobs) == 1 or rest != given
            for job in (jobs[0], jobs[-1]):
                assert cli.main(["run", *job, "--cfg", "job"]) == 0
    else:
        with pytest.raises(ParsedError):
            verbs.call(verb, rest)


def check_make(words: list[str]) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    line = ["make", "--dry-run", "PYTHON=python3", *words]
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if words[:1] == ["run"]:
        given = [word for word in words[1:] if "=" in word and not word.startswith("ARGS=")]
        check_tsbench(["run", *(given or ["task=laikago_trot"])])


def check_pip(words: list[str]) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert words[0] == "install"
    for word in words[1:]:
        if asked := re.fullmatch(r"\.\[(.*)\]", word):  # of a clone: no registry has tsbench
            assert set(asked[1].split(",")) <= extras.keys()
        elif word.startswith((".", "/")):
            assert (ROOT / word).exists()
        else:
            assert re.fullmatch(r"--\w+|build|mjlab|pytest|pre-commit", word)


def check_python(words: list[str]) -> None:
    if words[0] == "-m":
        name = words[1]
        if name in ("tsbench", "pytest"):
            CHECKS[name](words[2:])
        else:
            assert importlib.util.find_spec(name) is not None
    elif words[0] == "-c":
        compile(words[1], "-c", "exec")
    else:
        check_script(ROOT / words[0], words[1:])


def check_script(script: Path, words: list[str]) -> None:
    """Runs a script until it has parsed its words. One that needs a package that is not here, such
    as OMPL, is not checked, nor one that parses none."""
    if not re.search("argparse|cli import main", script.read_text(encoding="utf-8")):
        return
    handler = signal.getsignal(signal.SIGTERM)  # a script may set its own
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ArgumentParser, "parse_args", _stopping(ArgumentParser.parse_args))
        patch.setattr(sys, "argv", [str(script), *words])
        patch.syspath_prepend(script.parent)
        try:
            with pytest.raises(ParsedError):
                runpy.run_path(str(script), run_name="__main__")
        except ModuleNotFoundError as missing:
            if missing.name not in ("planner_ompl", "mujoco_warp", "warp"):
                raise
        except SystemExit as refused:
            raise AssertionError(f"{script.name} refuses {words}") from refused
        finally:
            signal.signal(signal.SIGTERM, handler)


def check_pytest(words: list[str]) -> None:
    assert all((ROOT / word).exists() for word in words if not word.startswith("-"))


def check_bash(words: list[str]) -> None:
    made = words[0].startswith("gpu-bundle/")  # by benchmarks/bundle.py
    assert made or (ROOT / words[0]).is_file()


def check_torchrun(words: list[str]) -> None:
    check_python(words[words.index("-m") :])


def check_sbatch(words: list[str]) -> None:
    place = next(i for i, word in enumerate(words) if not word.startswith("-"))
    assert (ROOT / words[place]).is_file()
    check_tsbench([word.replace("%a", "0") for word in words[place + 1 :]])


CHECKS: dict[str, Callable[[list[str]], None]] = {
    "tsbench": check_tsbench,
    "make": check_make,
    "pip": check_pip,
    "python": check_python,
    "python3": check_python,
    "pytest": check_pytest,
    "bash": check_bash,
    "sbatch": check_sbatch,
    "torchrun": check_torchrun,
    ".ci/run": lambda words: None,
}


SCRIPTS = {
    words
    for page in PAGES
    for words in re.findall(
        r"(?<!`)`python3? (\w+/\w+\.py[^`\n]*)`", page.read_text(encoding="utf-8")
    )
}


@pytest.mark.parametrize("words", sorted(SCRIPTS))
@pytest.mark.usefixtures("parsing")
def test_scripts_that_texts_name_are_right(words: str) -> None:
    check_python([stood_in(word) for word in words.split()])


@pytest.mark.usefixtures("parsing")
def test_a_wrong_word_of_a_script_would_be_noticed() -> None:
    with pytest.raises(AssertionError, match=r"gpu_check\.py refuses \['--what'\]"):
        check_python(["benchmarks/gpu_check.py", "--what"])


@pytest.mark.parametrize("words", ["view RUN --films x", "evaluate", "paint RUN"])
@pytest.mark.usefixtures("parsing")
def test_a_wrong_command_would_be_noticed(words: str) -> None:
    with pytest.raises((AssertionError, TsbenchError)):
        check_tsbench(words.split())


@pytest.mark.usefixtures("parsing")
def test_a_wrong_configuration_would_be_noticed() -> None:
    with pytest.raises(AssertionError):
        check_tsbench(["run", "task=laikago_trot", "task.training.imitate.speed=3"])


@pytest.mark.parametrize("language", ["yaml", "toml"])
def test_data_is_valid(language: str) -> None:
    found = [block.text for block in BLOCKS if block.language == language]
    assert found
    for text in found:
        assert yaml.safe_load(text) if language == "yaml" else tomllib.loads(text)


# Texts


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_and_named_files_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith("https://"):
            assert target.partition("/")[0] not in MADE, f"{target}: a checkout does not have it"
            assert (page.parent / target).exists(), target
    for name in re.findall(r"`((?:tests|benchmarks|tsbench|examples)/[\w/.-]+)`", text):
        stands_for_yours = "NAME" in name or page.stem == "extending"
        assert stands_for_yours or (ROOT / name).exists(), name


def test_the_readme_links_every_page() -> None:
    readme = PAGES[0].read_text(encoding="utf-8")
    pages = [f"docs/{page.name}" for page in PAGES if page.parent != ROOT]
    assert [page for page in pages if f"]({page})" not in readme] == []


def test_runs_has_the_budgets_of_each_task() -> None:
    table = (ROOT / "docs" / "runs.md").read_text(encoding="utf-8")
    for name in tasks.names():
        budgets = schema.budgets(name)
        sums = [
            f"{short(budgets[b].plan)} + {short(budgets[b].act)}"
            for b in ("smoke", "fast", "paper")
        ]
        assert re.search(rf"^\| .*`{name}`.* \| {re.escape(' | '.join(sums))} \|$", table, re.M)


# Cards


@cache
def cards() -> ModuleType:
    spec = importlib.util.spec_from_file_location("cards", ROOT / "docs" / "cards.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_each_task_and_method_has_a_card(tmp_path: Path) -> None:
    for kind in ("tasks", "methods"):
        (tmp_path / kind).mkdir()
        (tmp_path / kind / "gone.md").touch()
    cards().write_pages(tmp_path)
    assert {path.stem for path in (tmp_path / "tasks").iterdir()} == set(tasks.names())
    assert {path.stem for path in (tmp_path / "methods").iterdir()} == set(methods.names())
    for name in tasks.names():
        task, card = tasks.make(name), (tmp_path / "tasks" / f"{name}.md").read_text()
        for constant in task.constants().keys() - {"name"}:
            assert f"| `{constant}` | " in card
        assert f"{task.observation_size} numbers" in card
        entries = ROOT / "leaderboards" / "v1" / name
        for entry in entries.iterdir() if entries.is_dir() else ():
            assert f"[{entry.name}](../methods/" in card
            assert f"| {entry.name} | " in (tmp_path / "board.md").read_text()


def test_a_card_shows_its_film(tmp_path: Path) -> None:
    """With a poster, since a browser loads it only when asked; small enough for a checkout."""
    cards().write_pages(tmp_path)
    films = sorted((ROOT / "docs" / "static").glob("*.mp4"))
    assert films
    for path in films:
        assert path.stat().st_size < 300_000
        assert path.with_suffix(".jpg").stat().st_size < 100_000
        card = (tmp_path / "tasks" / f"{path.stem}.md").read_text()
        assert f'<source src="../_static/{path.name}"' in card
        assert f'poster="../_static/{path.stem}.jpg"' in card
    shown = re.findall(r"_static/([\w.]+)", (ROOT / "docs" / "index.md").read_text())
    assert shown
    assert all((ROOT / "docs" / "static" / name).is_file() for name in shown)


def test_the_readme_has_the_results_of_the_board() -> None:
    readme = PAGES[0].read_text(encoding="utf-8")
    assert cards().results() in readme
    assert " seeds |" in cards().results().partition("\n")[0]
    assert cards().with_results(readme) == readme, "run `python docs/cards.py`"
