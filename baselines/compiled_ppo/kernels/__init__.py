"""Compiled parts: `common` ones, and those of networks without and with memory."""
