"""Renewal of every number, table and figure of README and the pages: `make results`."""
