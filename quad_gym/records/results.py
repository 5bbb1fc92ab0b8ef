"""What a step returns for every flight."""

RESULTS = (
    "reward",
    "terminated",
    "truncated",
    "ending",
    "position_error",
    "estimation_error",
    "filter_status",
    "episode_steps",
    "episode_return",
    "episode_error_sum",
    "gates_passed",
    "faults",
)
"""Columns of what a step returns for every flight."""
