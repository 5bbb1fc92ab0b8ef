"""Benchmarks of parts: filters, stages of a tick, options, compilation, learning, peers."""
