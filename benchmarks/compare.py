"""`tsbench bench` with comparisons to other libraries: `python benchmarks/compare.py --only NAME`.

The files `against_*.py` in this folder register comparisons, as the files of `tsbench/bench` do,
but for `against_mjlab.py`, which is a script of its own.
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
