"""Compilation of kernels: decorators, linking, the cache, processes that compile in parallel."""

from quad_gym.kernels.compiling.decorators import call_stage, entry, kernel, routine, stage
from quad_gym.kernels.stages import Stage

__all__ = ["Stage", "call_stage", "entry", "kernel", "routine", "stage"]
