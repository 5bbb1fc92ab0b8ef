"""Metrics, filter consistency, figures and reports, all computed from flights."""
