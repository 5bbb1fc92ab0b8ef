"""Benchmark of all parts, a module for each section."""
