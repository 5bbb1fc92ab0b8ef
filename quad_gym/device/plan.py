"""`DevicePlan`: a configuration for a GPU, flown where only NumPy and torch are needed."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.kernels.stages import Stage

Words = NDArray[np.uint64]


class FieldPlace(NamedTuple):
    """Place of a field in the record of a flight."""

    first: int  #: index of its first word
    shape: tuple[int, ...]
    kind: str  #: "f8", "i8" or "u8"


class DevicePlan(NamedTuple):
    """A configuration; words have eight bytes, and a record has the words of one flight."""

    settings: bytes
    stages: Mapping[Stage, str]
    flight: Words  #: record of a flight that has never been reset
    skipped: int  #: words of the full record before the first stored one
    fields: Mapping[str, FieldPlace]
    world: Words  #: record of the true parameters
    model: Words  #: record of the parameters that filter and controller assume
    paths: NDArray[np.uint8]  #: a task's trajectories
    pieces: NDArray[np.uint8]  #: their segments
    low: NDArray[np.float64]  #: bounds of an observation, (k,)
    high: NDArray[np.float64]
    work: int  #: words of the workspace of a flight
    results: tuple[str, ...]  #: names of the results of a step
    autoreset: int  #: an `Autoreset`
    shown: int = 0  #: numbers of a flight for the views of a task in Python
