"""Gravity."""

GRAVITY = 9.8
"""Standard gravity as rounded in the laboratory report [m/s^2]."""
