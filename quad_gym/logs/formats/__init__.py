"""Logs of flights: one form for all, and a file for each format that translates to it."""

from quad_gym.logs.formats.log import LOG_COLUMNS, Floats, Log, LogColumn, Stream
from quad_gym.logs.formats.reading import Reading, read_log

__all__ = ["LOG_COLUMNS", "Floats", "Log", "LogColumn", "Reading", "Stream", "read_log"]
