"""What everyone may know: the words that tasks, learners and evaluations share."""
