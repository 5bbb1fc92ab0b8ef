"""Logs of flights: one form for all, and a file for each format that translates to it."""

from quad_gym.estimation.logs.log import LOG_COLUMNS, Floats, Log, LogColumn, Stream
from quad_gym.estimation.logs.tables import read_log

__all__ = ["LOG_COLUMNS", "Floats", "Log", "LogColumn", "Stream", "read_log"]
