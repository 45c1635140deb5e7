"""Reinforcement learning by rsl-rl. Of the library, only this package imports torch."""
