"""A method for tsbench that plans with OMPL."""
