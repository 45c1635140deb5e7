"""Collects the packages that tsbench needs on a machine with a GPU and without a network.

    make gpu-bundle                      into build/gpu-bundle
    bash build/gpu-bundle/install SITE   there: joins the pieces and installs into the folder SITE
    PYTHONPATH=SITE:. python3 -m tsbench bench --only gpu

The machine is expected to have torch, which is large, and what usually comes with it (`HAVE`). The
wheels are for Linux on x86-64. `part1`, `part2`, ... hold at most `PART` each, so that they can be
sent one by one; larger wheels are split.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Set
from importlib.metadata import requires, version
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
PART = 30_000_000  # bytes
GLIBC = (17, 24, 26, 27, 28, 31, 34, 35)  # minor versions of glibc 2 that wheels name

# What comes with torch, or with the usual image of a machine for machine learning.
HAVE = """
    absl-py attrs certifi charset-normalizer cloudpickle contourpy cycler etils filelock fonttools
    fsspec grpcio idna jinja2 kiwisolver lxml markdown markdown-it-py markupsafe matplotlib mdurl
    ml-dtypes mpmath networkx numpy onnx onnx-ir onnxscript packaging pillow protobuf psutil
    pygments pyparsing python-dateutil pyyaml requests rich safetensors scipy setuptools six sympy
    tensorboard tensorboard-data-server threadpoolctl torch tqdm typing-extensions urllib3 werkzeug
    zipp
"""
# What learning, scoring and `bench --only gpu` do not import.
NOT_NEEDED = "dm-control dm-env dm-tree gymnasium farama-notifications labmaze pyngrok"

INSTALL = """\
#!/bin/bash
# Joins the pieces beside this file and below, and installs all wheels into the folder $1.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
wheels=$(mktemp -d)
find "$here" -name '*.whl' -exec cp {} "$wheels" \\;
find "$here" -name '*.whl.00' | while read -r first; do
    name=$(basename "${first%.00}")
    find "$here" -name "$name.[0-9][0-9]" -printf '%f %p\\n' | sort | cut -d' ' -f2- |
        xargs -d '\\n' cat >"$wheels/$name"
done
(cd "$wheels" && sha256sum --check --quiet "$here/SHA256SUMS")
python3 -m pip install --quiet --no-index --no-deps --no-compile --upgrade --target "$1" \\
    "$wheels"/*.whl
rm -r "$wheels"
"""


def needed(have: Set[str]) -> dict[str, str]:
    """The packages that tsbench with its extra `gpu` needs beyond `have`, with the versions that
    are installed here. What only `have` needs counts as there too."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    first = [*project["dependencies"], *project["optional-dependencies"]["gpu"]]
    found: dict[str, str] = {}
    waiting = [Requirement(line) for line in first]
    seen: set[str] = set()
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        if name in have or str(wanted) in seen:
            continue
        seen.add(str(wanted))
        found[name] = version(name)
        for line in requires(name) or []:
            other = Requirement(line)
            extras = {"extra": ""}, *({"extra": extra} for extra in wanted.extras)
            place = {"python_version": "3.12", "python_full_version": "3.12.0"}
            if other.marker is None or any(other.marker.evaluate({**place, **e}) for e in extras):
                waiting.append(other)
    return dict(sorted(found.items()))


def fetch(name: str, release: str, folder: Path) -> None:
    """Downloads a wheel for Python 3.12 on Linux, or builds it where a package has none."""
    platforms = [f"--platform=manylinux_2_{minor}_x86_64" for minor in GLIBC]
    platforms.append("--platform=manylinux2014_x86_64")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    wanted = [f"{name}=={release}", "--no-deps"]
    download = ["download", *wanted, "--only-binary=:all:", f"--dest={folder}"]
    target = ["--python-version=3.12", "--implementation=cp", *platforms]
    if subprocess.run([*pip, *download, *target], stderr=subprocess.DEVNULL).returncode:
        subprocess.run([*pip, "wheel", *wanted, f"--wheel-dir={folder}"], check=True)


def split(wheels: list[Path], folder: Path) -> int:
    """Distributes the wheels over parts, large ones in pieces; returns the number of parts."""
    pieces: list[tuple[str, bytes]] = []
    for wheel in wheels:
        data = wheel.read_bytes()
        if len(data) <= PART:
            pieces.append((wheel.name, data))
            continue
        starts = range(0, len(data), PART)
        pieces += [(f"{wheel.name}.{i:02}", data[s : s + PART]) for i, s in enumerate(starts)]
    parts: list[int] = []  # bytes in each
    for name, data in sorted(pieces, key=lambda piece: -len(piece[1])):
        fitting = [i for i, size in enumerate(parts) if size + len(data) <= PART]
        if not fitting:
            fitting = [len(parts)]
            parts.append(0)
        parts[fitting[0]] += len(data)
        place = folder / f"part{fitting[0] + 1}"
        place.mkdir(exist_ok=True)
        (place / name).write_bytes(data)
    return len(parts)


def renew(folder: Path) -> None:
    """Makes the folder, in place of an earlier bundle. It has the names of one from the beginning,
    so that one that was interrupted is known too.

    Raises:
        FileExistsError: the folder holds something else.
    """
    known = [folder / name for name in ("install", "SHA256SUMS")]
    if folder.exists():
        if not folder.is_dir() or (any(folder.iterdir()) and not all(p.is_file() for p in known)):
            raise FileExistsError(f"{folder} is no bundle: give a new or an empty folder")
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    for path in known:
        path.touch()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "build" / "gpu-bundle")
    parser.add_argument("--have", default=HAVE, help="names of the packages that are there")
    parser.add_argument("--not-needed", default=NOT_NEEDED, help="names of packages to leave out")
    options = parser.parse_args()
    have = {canonicalize_name(name) for name in f"{options.have} {options.not_needed}".split()}
    try:
        renew(options.folder)
    except FileExistsError as error:
        parser.error(str(error))
    whole = options.folder / "whole"
    whole.mkdir()
    for name, release in needed(have).items():
        sys.stdout.write(f"{name} {release}\n")
        fetch(name, release, whole)
    wheels = sorted(whole.glob("*.whl"))
    sums = subprocess.run(
        ["sha256sum", *(w.name for w in wheels)], cwd=whole, capture_output=True, check=True
    )
    (options.folder / "SHA256SUMS").write_bytes(sums.stdout)
    (options.folder / "install").write_text(INSTALL, encoding="utf-8")
    count = split(wheels, options.folder)
    shutil.rmtree(whole)
    size = sum(path.stat().st_size for path in options.folder.rglob("*") if path.is_file())
    sys.stdout.write(
        f"{len(wheels)} wheels, {size / 1e6:.0f} MB in {count} parts: {options.folder}\n"
    )


if __name__ == "__main__":
    main()
