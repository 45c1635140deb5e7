"""Scores of policies. To this room a policy is a function; its training is unknown here."""
