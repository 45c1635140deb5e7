"""The command line."""

from tsbench.cli.verbs import main

__all__ = ["main"]
