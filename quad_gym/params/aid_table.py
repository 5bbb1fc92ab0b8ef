"""The table of aiding sensors: a sensor other than IMU, GNSS and camera has one row here.

A row is the name of the sensor, which is also the name of its kernels' file, and the class of its
parameters. All else follows from the class: the sensor's draws, records, stage, group of the gate,
fault, quantity, reading, columns and delay in logs, figures, and its interface in an exported
filter.
"""

import dataclasses
import difflib
from typing import NamedTuple, get_args

from quad_gym.params import checks as check
from quad_gym.params.aids import OBSERVED, AidParams
from quad_gym.params.barometer import BarometerParams
from quad_gym.params.checks import Checked
from quad_gym.params.magnetometer import MagnetometerParams
from quad_gym.params.optical_flow import OpticalFlowParams
from quad_gym.params.range_finder import RangeFinderParams
from quad_gym.params.uwb_range import UwbRangeParams


class AidTable(Checked):
    """Aiding sensors of a suite, in the order in which a filter processes them; new ones last."""

    barometer: BarometerParams | None = None
    """barometer; None: no barometer"""
    magnetometer: MagnetometerParams | None = None
    """magnetometer; None: no magnetometer"""
    optical_flow: OpticalFlowParams | None = None
    """optical flow of the ground below; None: not measured"""
    range_finder: RangeFinderParams | None = None
    """range finder that looks down; None: no range finder"""
    uwb_range: UwbRangeParams | None = None
    """ranges to anchors of a known place, by ultra-wideband radio; None: no ranges"""


AID_PARAMS: dict[str, type[AidParams]] = {
    field.name: get_args(field.type)[0] for field in dataclasses.fields(AidTable)
}
"""Classes of parameters by the names of the sensors."""


class AidShape(NamedTuple):
    """Numbers of a sensor for which records and kernels are made."""

    length: int  #: as in `AidParams`
    most_blocks: int
    rows: int
    observes: tuple[str, ...]
    own_error: bool  #: True if an error of the sensor is among the states of a filter


def _shape_of(kind: type[AidParams]) -> AidShape:
    """Return the shape of a class of parameters, and refuse a class that is incomplete."""
    for word in ("observes", "unit", "frame", "meaning", "raw"):
        if not hasattr(kind, word):
            raise ValueError(f"{kind.__name__} must have {word}, as in AidParams")
    known = {*dir(AidParams), *(field.name for field in dataclasses.fields(kind))}
    for word in vars(kind).keys() - known:
        if near := difflib.get_close_matches(word, known, 1, cutoff=0.8):
            raise ValueError(f"{kind.__name__}.{word} is not read; did you mean {near[0]}?")
    check.whole(f"{kind.__name__}.length", kind.length, most=3)
    for word in kind.observes:
        check.choice(f"{kind.__name__}.observes", word, OBSERVED)
    own_error = (kind.slow_vector, kind.slow_scalar) != (
        AidParams.slow_vector,
        AidParams.slow_scalar,
    )
    return AidShape(kind.length, kind.most_blocks, kind.rows, kind.observes, own_error)


AID_SHAPES = {name: _shape_of(kind) for name, kind in AID_PARAMS.items()}
"""Shapes by the names of the sensors. Compiled code depends on these, not on other parameters."""

__all__ = [params.__name__ for params in AID_PARAMS.values()]  # what `quad_gym` exports
