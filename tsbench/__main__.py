"""`python -m tsbench` is `tsbench`."""

import sys

from tsbench.cli.verbs import main

sys.exit(main())
