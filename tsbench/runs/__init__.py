"""Runs: a configuration in, a directory that explains itself out."""
