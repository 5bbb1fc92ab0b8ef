"""Baseline controllers, training, and export of policies."""

from baselines.pd import PDPolicy

__all__ = ["PDPolicy"]
