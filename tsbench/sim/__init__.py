"""Simulation of tasks: one episode at a time by dm_control, or many at once."""
