"""Makes `python -m tsbench` the command `tsbench`."""

import sys

from tsbench.cli.verbs import main

sys.exit(main())
