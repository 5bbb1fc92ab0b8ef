"""How high references are drawn: numbers alone, which checks of the ground read without kernels."""

LOWEST_GATE, GATE_SPREAD = 0.7, 0.6
"""Height of a course's lowest gate, and of the highest above it, over `TaskParams.height`."""
RANDOM_RISE = 0.3
"""Vertical over horizontal coefficients of a random trajectory, before all are scaled; it typically
leads less far up or down than this share of `TaskParams.radius`."""
