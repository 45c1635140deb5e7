"""Reinforcement learning by rsl-rl, which only this room and `testing` import."""
