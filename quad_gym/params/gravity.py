"""Gravity."""

GRAVITY = 9.8  #: standard gravity as rounded in the laboratory report [m/s^2]
