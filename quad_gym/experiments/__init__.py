"""Experiments: trainings and flights that become tables, figures and pages."""
