"""Betaflight's rate loop: its firmware, built here, between a policy and the motors."""

from docs.examples.betaflight.rate_loop import BehindBetaflight, firmware_settings, flights_behind

__all__ = ["BehindBetaflight", "firmware_settings", "flights_behind"]
