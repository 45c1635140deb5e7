"""Geometry of plans: gaits, paths, and inverse kinematics from abstract states to poses."""
