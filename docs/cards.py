"""Pages that are made from the code: a card for each task and each method, and the board's tables.

Sphinx loads this file as an extension (docs/conf.py). Before it reads the sources, the cards are
written into docs/tasks/ and docs/methods/, and the tables to docs/board.md; git ignores all of
them. After the pages are written, each task's best entry is drawn in 3-D into the site's views/.

`python docs/cards.py` writes the table of results into README.md, and `python docs/cards.py films`
the films and pictures of these entries, which takes a minute a task.
"""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import imageio_ffmpeg
import numpy as np
from PIL import Image

from tsbench import gym, methods, tasks
from tsbench.core import plugins
from tsbench.core.constants import SOURCES, described
from tsbench.core.files import write_whole
from tsbench.core.task import MDP, Plannable, Task
from tsbench.core.words import duration, number, several, short
from tsbench.leaderboard import page
from tsbench.leaderboard.page import Row, Table
from tsbench.runs import schema

if TYPE_CHECKING:
    from sphinx.application import Sphinx

DOCS = Path(__file__).parent
ROOT = DOCS.parent
BOARD = ROOT / "leaderboards"
RESULTS = ("<!-- results: made by `python docs/cards.py` -->\n", "<!-- end of results -->\n")

BEST_PLAN = """\
`best plan` is the best motion known under the planner's speed limits, as if physics followed it
exactly; physics may be faster. [The board](../board.md) has costs and states of all entries, and
[Evaluation](../evaluation.md) defines the figures."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Sphinx calls this when it loads the extension."""
    app.connect("builder-inited", lambda app: write_pages(DOCS))
    app.connect("source-read", _unlink)
    app.connect("autodoc-process-docstring", _indent, priority=0)  # before napoleon reads it
    app.connect("build-finished", _write_views)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


@cache
def board() -> tuple[list[Table], list[str]]:
    """The tables of the board, and why an entry is in none."""
    return page.tables(BOARD)


def write_pages(folder: Path) -> list[Path]:
    """Writes the cards and the board's tables below a folder, in place of earlier ones, and returns
    the files."""
    found, left_out = board()
    before = (
        "# The board\n\nAll entries of `leaderboards/v1`, best first, with the policies `zero` and "
        "`random` beside them. [The leaderboard](leaderboard.md) says how to submit one, and "
        "[Evaluation](evaluation.md#what-the-figures-say) what each column means."
    )
    pages = {"board.md": page.markdown(found, left_out, before)}
    pages |= {f"tasks/{table.task}.md": task_card(table) for table in found}
    pages |= {f"methods/{name}.md": method_card(name, found) for name in methods.names()}
    for name, text in pages.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_whole(path, text.encode())
    written = [folder / name for name in pages]
    for path in {*folder.glob("tasks/*.md"), *folder.glob("methods/*.md")}.difference(written):
        path.unlink()  # of a task or method that is gone
    return written


# Cards


def task_card(table: Table) -> str:
    """The page of a task: what it asks, its numbers, and what was reached in it."""
    task = tasks.make(table.task)
    own = type(task)
    endings = [
        ("ends early", _prose(own.terminal)),
        ("violation", _prose(own.violated)),
        ("**solved**", _prose(own.success)),
    ]
    if own.reached is not MDP.reached:
        endings.insert(2, ("worth of a step that an arrival spares", _prose(own.quality)))
    parts = [
        f"# {task.name}",
        _prose(sys.modules[own.__module__]),
        _film(table),
        "## At a glance",
        _table(("", ""), _glance(task)),
        "## Results",
        _results(table),
        BEST_PLAN,
        "## Observation and action",
        f"An observation has {several(task.observation_size, 'number')}. {_prose(own.observation)}",
        f"An action has {several(task.action_size, 'number')} in [-1, 1]. {_prose(own.control)}",
        "## Reward",
        f"At most {number(task.max_reward)} a step. {_prose(own.reward)}",
        _literal(own.reward_terms),
        f"A report calls the terms {', '.join(_terms(task))}.",
        "## End of an episode",
        f"An episode ends after {task.horizon} steps, or earlier.",
        _table(("", ""), endings),
    ]
    if task.measure_notes:
        rows = [(name, note) for name, note in task.measure_notes.items()]
        parts += ["## Measures", _table(("figure", "meaning"), rows)]
    if isinstance(task, Plannable):
        parts += ["## Planning and imitation", *_variants(task)]
    parts += ["## Budgets", _budgets(task.name), "## Constants", *_constants(task)]
    parts += ["## Try it", _try(task)]
    return "\n\n".join(parts) + "\n"


def method_card(name: str, found: Sequence[Table]) -> str:
    """The page of a method: what it does, its options, and its entries."""
    module = methods.find(name)
    stages = ", ".join(f"`{stage}`" for stage in methods.stages(name)) or "none"
    entries = [(table, row) for table in found for row in table.rows if _method(row) == name]
    parts = [
        f"# {name}",
        _prose(module),
        "## Options",
        "With their defaults, as words of `tsbench run` such as `method.KEY=VALUE`:",
        _yaml("method", name),
        f"Its kinds of training stages: {stages}. They take `task.training.STAGE.KEY=VALUE`.",
    ]
    if name in schema.names("search"):
        parts += ["## What is tuned", "`tsbench tune` searches these:", _yaml("search", name)]
    parts += ["## Results"]
    head = ("task", "entry", *RESULT_COLUMNS)
    rows = [
        (f"[{table.task}](../tasks/{table.task}.md)", row.name, *_figures(row))
        for table, row in entries
    ]
    parts += [_table(head, rows) if rows else "No entry of the board was made with it yet."]
    parts += [
        "## Try it",
        f"```sh\ntsbench run task={found[0].task} method={name} budget=smoke\n```",
    ]
    return "\n\n".join(parts) + "\n"


def results() -> str:
    """README.md's table: the best entry of each task."""
    found, _ = board()
    head = ("task", "best entry", *RESULT_COLUMNS, "best plan")
    rows = [
        (table.task, row.name, *_figures(row), number(table.best))
        for table in found
        for row in table.rows[:1]
    ]
    return _table(head, rows) + "\n"


# Parts of cards

RESULT_COLUMNS = (
    "solved", "`solved_reward`", "100 N: survived", "recovered", "steps", "time", "seeds",
)  # fmt: skip


def _figures(row: Row) -> list[str]:
    figures, (steps, _, seconds) = row.figures, row.cost
    shares = [figures[name] for name in ("success", "survival_100N", "recovery_100N")]
    solved, survived, recovered = ("" if one is None else f"{one:.0%}" for one in shares)
    spent = (short(steps), duration(seconds), str(len(row.entry.kept)))
    return [solved, number(row.reward.iqm), survived, recovered, *spent]


def _results(table: Table) -> str:
    rows: list[tuple[str, ...]] = []
    for row in table.rows:
        method = _method(row)
        linked = f"[{row.name}](../methods/{method}.md)" if method in methods.names() else row.name
        rows.append((linked, *_figures(row)))
    for name, given in sorted(table.references.items()):
        keys = ("success", "survival_100N", "recovery_100N")
        shares = [f"{given[key]:.0%}" if key in given else "-" for key in keys]
        reward = number(given["solved_reward"])
        label = "`oracle`, the best plan" if name == "oracle" else f"`{name}`"
        rows.append((label, shares[0], reward, *shares[1:], "", "", ""))
    return _table(("", *RESULT_COLUMNS), rows)


def _method(row: Row) -> str:
    return row.entry.manifest.method


def _film(table: Table) -> str:
    """The film of the best motion, a strip of it, and a link to its 3-D view."""
    best = _shown(table)
    if best is None:
        return ""
    name, parts = table.task, []
    if (DOCS / f"static/{name}.mp4").is_file():
        robot = tasks.make(name).drawing().robot
        about = f"{name}: the motion of {best.name}; the translucent blue {robot} is the plan"
        parts.append(
            f'<video class="film" loop muted playsinline controls preload="none"\n'
            f'  poster="../_static/{name}.jpg" aria-label="{about}">\n'
            f'  <source src="../_static/{name}.mp4" type="video/mp4">\n</video>'
        )
    if (DOCS / f"pictures/{name}.png").is_file():
        words = f"{name}: the plan above, its execution below, at six instants"
        parts.append(f"![{words}](../pictures/{name}.png)")
    words = f"The plan beside the motion of `{best.name}`, in 3-D"
    return "\n\n".join([*parts, f'<a href="../views/{name}.html">{words}</a>'])


def write_films() -> Iterable[Path]:
    """Films, posters and strips of the entries that the cards show, in place of older ones."""
    for table in board()[0]:
        if (row := _shown(table)) is None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            film, strip = Path(folder, "film.mp4"), Path(folder, "strip.png")
            # A process of its own chooses its OpenGL before it imports mujoco.
            words = ["view", str(_folder(row)), "--video", str(film), "--strip", str(strip)]
            subprocess.run([sys.executable, "-m", "tsbench", *words], check=True)
            yield _smaller_film(film, DOCS / f"static/{table.task}.mp4")
            yield _smaller_picture(strip, DOCS / f"pictures/{table.task}.png")


def _smaller_film(film: Path, place: Path) -> Path:
    """Writes a film so that it takes about a hundred kilobytes, and its poster beside it."""
    options = ["-crf", "32", "-preset", "slower", "-movflags", "+faststart"]
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", "-i", str(film)]
    subprocess.run([*program, *options, str(place)], check=True)
    frames = imageio_ffmpeg.read_frames(str(film), input_params=["-ss", "1.5"])
    poster = Image.frombytes("RGB", next(frames)["size"], next(frames))
    poster.save(place.with_suffix(".jpg"), quality=80)
    return place


def _smaller_picture(picture: Path, place: Path) -> Path:
    """Writes a picture with 128 colours."""
    Image.open(picture).quantize(128).save(place, optimize=True)
    return place


def _folder(row: Row) -> Path:
    """Of the training that represents an entry."""
    return row.entry.kept[0].run.path


def _shown(table: Table) -> Row | None:
    """The best entry that has a plan, whose motion a card shows."""
    planned = (row for row in table.rows if (row.entry.kept[0].run.path / "plan.npz").is_file())
    return next(planned, None)


def _glance(task: Task[Any]) -> Iterable[tuple[str, str]]:
    yield "version", str(task.version)
    yield "Gymnasium", f"`{gym.identifier(task.name)}`"
    yield "episode", f"{task.horizon} steps of {number(task.timestep)} s"
    rate = number(task.substeps / task.timestep)
    yield "physics", f"{task.substeps} steps in a control step, {rate} Hz"
    yield "observation", several(task.observation_size, "number")
    yield "action", f"{several(task.action_size, 'number')} in [-1, 1]"
    yield "reward of a step", f"at most {number(task.max_reward)}"
    yield "pushes", f"on the body `{task.pushed}` at {len(task.push_steps)} instants"


def _terms(task: Task[Any]) -> list[str]:
    ideal = task.ideal()
    before, after = ideal.rows(slice(0, 1)), ideal.rows(slice(1, 2))
    return list(task.reward_terms(before, np.zeros((1, task.action_size)), after))


def _variants(task: Plannable[Any]) -> list[str]:
    plan = task.abstraction()
    forms = ", ".join(f"`{form}`" for form in task.imitation_forms)
    rows = [
        ("plan", f"{plan.horizon} steps of {number(plan.timestep)} s"),
        ("coordinates of a plan", ", ".join(f"`{name}`" for name in plan.coordinates)),
        ("action of the planner", f"{several(plan.action_size, 'number')} in [-1, 1]"),
        ("observation of the planner", several(plan.observation_size, "number")),
        ("imitation rewards", f"{forms} (the first is the default)"),
    ]
    tracker = inspect.signature(type(task).tracker).return_annotation
    module = sys.modules[type(task).__module__]
    rewards = getattr(module, str(tracker), None)
    return [
        _prose(type(plan)),
        _table(("", ""), rows),
        *([_prose(rewards)] if rewards is not None else []),
    ]


def _budgets(name: str) -> str:
    rows = [
        (f"`{budget}`", f"{steps.plan:,}", f"{steps.act:,}")
        for budget, steps in schema.budgets(name).items()
    ]
    return _table(("budget", "environment steps to plan with", "to act with"), rows)


def _constants(task: Task[Any]) -> list[str]:
    """The constants that decide a score, with units, meanings and sources where the code has
    them."""
    known = list(described(sys.modules[type(task).__module__]))
    rows = [(f"`{c.name}`", _value(c.value), c.unit, c.meaning, c.source) for c in known]
    named = {"name", *(constant.name for constant in known)}
    own = [
        (f"`{name}`", _value(value), "", "of this task", "")
        for name, value in task.constants().items()
        if name not in named
    ]
    letters = "; ".join(f"{letter}: {words}" for letter, words in SOURCES.items())
    changed = ", ".join(f"`task.constants.{name}`" for name in tasks.defaults(task.name))
    return [
        f"Sources: {letters}. Two letters: of the formula, and of the value.",
        _table(("constant", "value", "unit", "meaning", "source"), [*own, *rows]),
        f"For studies a run can change {changed}; its score is then not ranked.",
    ]


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_value(one)}" for key, one in value.items())
    if isinstance(value, (tuple, list)):
        if len(value) > 3 and value[:3] * (len(value) // 3) == value:
            return f"({_value(value[:3])}) x {len(value) // 3}"
        inner = ", ".join(f"({_value(v)})" if isinstance(v, tuple) else _value(v) for v in value)
        return inner or "none"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _try(task: Task[Any]) -> str:
    name = task.name
    lines = [f"tsbench run task={name}", f"tsbench view task={name}"]
    if not isinstance(task, Plannable):  # there is no plan to follow or to view
        lines = [f"tsbench run task={name} method={methods.PLANLESS}"]
    return "\n".join(["```sh", *lines, f"tsbench evaluate zero task={name}", "```"])


def _yaml(group: str, name: str) -> str:
    folders = (folder / f"{name}.yaml" for folder in plugins.configurations(group))
    file = next(file for file in folders if file.is_file())
    return f"```yaml\n{file.read_text(encoding='utf-8').strip()}\n```"


def _prose(thing: Any) -> str:
    """The docstring of a thing as Markdown, without its sections on attributes and errors."""
    text = inspect.cleandoc(thing.__doc__ or "")
    text = re.split(r"^(?:Attributes|Args|Returns|Raises):", text, flags=re.MULTILINE)[0].strip()
    return re.sub(r"([*_<|])", r"\\\1", text)


def _literal(thing: Any) -> str:
    """The docstring of a thing with its lines as they are."""
    return f"```text\n{inspect.cleandoc(thing.__doc__ or '')}\n```"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(' '.join(cell.split()) for cell in line)} |" for line in lines)


# The site and README.md


def _indent(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Indents the attributes of a docstring that begins with them, as napoleon expects, and parts
    code from a letter that follows it, as in `Task`s, as reStructuredText expects."""
    lines[:] = [re.sub(r"(`[^`]+`)(?=\w)", r"\1\\ ", line) for line in lines]
    if lines[:1] == ["Attributes:"]:
        end = lines.index("") if "" in lines else len(lines)
        lines[1:end] = [f"    {line}" for line in lines[1:end]]


def _unlink(app: Sphinx, name: str, source: list[str]) -> None:
    """Keeps only the text of links to folders and pages of the checkout that are not in the site.
    Other files of the checkout are copied into the site."""

    def kept(link: re.Match[str]) -> str:
        target = ROOT / link[2].partition("#")[0]
        return link[1] if target.is_dir() or target.suffix == ".md" else link[0]

    if "/" not in name:  # the pages in folders, which are cards, link within the site only
        source[0] = re.sub(r"(?<!!)\[([^]]*)\]\(\.\./([^)]*)\)", kept, source[0])


def _write_views(app: Sphinx, exception: Exception | None) -> None:
    if exception is not None or app.builder.format != "html":
        return
    from tsbench.viewer import page as viewer
    from tsbench.viewer.subject import subject

    folder = Path(app.outdir) / "views"
    folder.mkdir(exist_ok=True)
    for table in board()[0]:
        if (row := _shown(table)) is not None:
            show = subject(str(_folder(row))).show(None)
            write_whole(folder / f"{table.task}.html", viewer.render(show).encode())


def with_results(text: str) -> str:
    """The text of README.md with its table of results made again."""
    before, _, rest = text.partition(RESULTS[0])
    _, _, after = rest.partition(RESULTS[1])
    return f"{before}{RESULTS[0]}{results()}{RESULTS[1]}{after}"


def main() -> None:
    if sys.argv[1:] == ["films"]:
        for path in write_films():
            sys.stdout.write(f"{path}\n")
        return
    readme = ROOT / "README.md"
    write_whole(readme, with_results(readme.read_text(encoding="utf-8")).encode())


if __name__ == "__main__":
    main()
