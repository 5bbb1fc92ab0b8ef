"""Controllers to compare against."""

from baselines.pd import PDPolicy

__all__ = ["PDPolicy"]
