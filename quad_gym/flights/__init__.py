"""The record of one flight: its columns, its files, its replay in Rerun."""
