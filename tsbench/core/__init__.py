"""The definitions that tasks, learners and evaluations share."""
