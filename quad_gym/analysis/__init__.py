"""Metrics, filter consistency, figures and reports; what scripts make of flights."""
