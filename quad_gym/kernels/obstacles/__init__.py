"""Obstacles: shapes, contact and lines of sight. Imports maths."""
