"""From parameters to the records that kernels read."""
