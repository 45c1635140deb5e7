"""Runs: from a configuration to a run directory that documents itself."""
