"""Heights of drawn references, constants that checks of the ground can import without kernels."""

LOWEST_GATE, GATE_SPREAD = 0.7, 0.6
"""Lowest height of a gate, and range of heights above it, divided by `TaskParams.height`."""
RANDOM_RISE = 0.3
"""Ratio of vertical to horizontal coefficients of a random trajectory before scaling. Its vertical
extent is typically below this share of `TaskParams.radius`."""
