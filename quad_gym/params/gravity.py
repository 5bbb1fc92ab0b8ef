"""Gravity."""

GRAVITY = 9.8
"""Standard gravity as the laboratory rounds it [m/s^2]."""
