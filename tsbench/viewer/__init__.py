"""Seeing a motion: MuJoCo models in meshcat, and pages that anyone can open."""
