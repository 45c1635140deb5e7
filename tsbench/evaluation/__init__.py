"""What a policy is worth. Sees a policy as a function and nothing of how it came about."""
