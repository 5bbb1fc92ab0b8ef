"""Conversion of parameters to the records that kernels read."""
