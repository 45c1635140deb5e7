"""From abstract states to poses, and planners that do not learn."""
