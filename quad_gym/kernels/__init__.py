"""Compiled core, which computes every part of a flight."""
