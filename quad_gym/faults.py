"""Faults: what sensors and rotors suffer in the field, and when; see `quad_gym.params.faults`."""

from quad_gym.params.faults import *  # noqa: F403
from quad_gym.params.faults import __all__ as __all__
