"""Makes `python -m tsbench` the command `tsbench`."""

import sys

from tsbench.cli import main

sys.exit(main())
