"""Aiding sensors, a file each, and what blocks of a measurement share. Imports maths and filter."""
