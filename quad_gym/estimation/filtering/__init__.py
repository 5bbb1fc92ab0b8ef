"""A filter for one vehicle: its memory, starts, inputs and estimate."""
