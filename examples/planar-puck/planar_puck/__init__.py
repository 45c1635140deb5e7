"""A task and a method for tsbench."""
