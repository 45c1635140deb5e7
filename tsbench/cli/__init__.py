"""The command line."""

from tsbench.cli.command import main

__all__ = ["main"]
