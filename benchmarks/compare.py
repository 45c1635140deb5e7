"""`tsbench bench` with comparisons to other libraries: `python benchmarks/compare.py --only NAME`.

Each file `against_*.py` in this folder registers comparisons, as the files of `tsbench/bench` do.
They are outside the package because they need libraries that tsbench does not need:
`pip install 'tsbench[bench]'`.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from tsbench.cli import main

if __name__ == "__main__":
    for path in sorted(Path(__file__).parent.glob("against_*.py")):
        importlib.import_module(path.stem)
    sys.exit(main(["bench", *sys.argv[1:]]))
