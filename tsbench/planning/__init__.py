"""Planning without learning: gaits, paths, roadmaps, and inverse kinematics to poses."""
