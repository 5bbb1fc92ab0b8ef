"""The record of one flight: its columns and its files."""
