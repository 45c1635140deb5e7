"""Reinforcement learning by rsl-rl: the only room that imports torch."""
