"""Consistency of filters: one configuration, and tables of many."""
