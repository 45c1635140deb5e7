"""What a user's editor and type checker see of the package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import tsbench

PUBLIC = {"TsbenchError", "evaluate", "list_methods", "list_tasks", "load", "load_batched"}


def test_the_public_names() -> None:
    """Completion shows them, and nothing that the package itself imports."""
    assert set(dir(tsbench)) == PUBLIC | {"__version__"}
    names: dict[str, Any] = {}
    exec("from tsbench import *", names)
    assert names.keys() - {"__builtins__"} == PUBLIC


def test_every_public_name_explains_itself() -> None:
    for name in PUBLIC:
        thing = getattr(tsbench, name)
        assert thing.__doc__
        assert thing.__module__.startswith("tsbench")


def test_a_type_checker_sees_types(tmp_path: Path) -> None:
    """In a user's program elsewhere: results have types, and a wrong argument is found."""
    (tmp_path / "program.py").write_text(
        "import tsbench\n"
        "import tsbench.gym\n"
        "reveal_type(tsbench.list_tasks())\n"
        "reveal_type(tsbench.load_batched('laikago_trot', count=2).count)\n"
        "reveal_type(tsbench.evaluate('zero', 'laikago_trot').as_dict)\n"
        "reveal_type(tsbench.gym.make('laikago_trot').render_mode)\n"
        "tsbench.load('laikago_trot', seed='five')\n"
    )
    words = ["-m", "mypy", "--cache-dir", str(tmp_path / "cache"), "program.py"]
    done = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True)
    found = done.stdout.splitlines()
    for line, kind in zip(
        found, ("tuple[str, ...]", "int", "def () -> dict[str, Any]", "str | None"), strict=False
    ):
        assert line.endswith(f'Revealed type is "{kind}"'), done.stdout
    assert 'Argument "seed" to "load" has incompatible type "str"' in found[4]
    assert found[5] == "Found 1 error in 1 file (checked 1 source file)"
