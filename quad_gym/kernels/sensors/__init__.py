"""Measurements of the sensors, and faults that corrupt them. Imports maths and vehicle."""
