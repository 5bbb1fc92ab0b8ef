"""Flights on a GPU: their memory as torch tensors, and the launches of their kernel."""
