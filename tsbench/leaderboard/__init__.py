"""The leaderboard: entries that people submit, and what is found out about them."""
