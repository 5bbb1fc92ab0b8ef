"""The table of sensors: each sensor but the IMU has one row here.

A row is the name of the sensor, which is also the name of its kernels' file, and the class of its
parameters. All else follows from the class: the sensor's draws, records, stage, groups of the gate,
fault, quantities, readings, columns and delay in logs, figures, and its interface in an exported
filter.
"""

import dataclasses
import difflib
from dataclasses import field
from typing import NamedTuple, get_args

from quad_gym.params import checks as check
from quad_gym.params.aids import (
    OBSERVED,
    AidParams,
    FurtherStage,
    ReadingDefinition,
    SensorBase,
)
from quad_gym.params.barometer import BarometerParams
from quad_gym.params.camera import CameraParams
from quad_gym.params.checks import Checked
from quad_gym.params.gnss import GnssParams
from quad_gym.params.imu import ImuParams
from quad_gym.params.magnetometer import MagnetometerParams
from quad_gym.params.optical_flow import OpticalFlowParams
from quad_gym.params.range_finder import RangeFinderParams
from quad_gym.params.uwb_range import UwbRangeParams


class SensorTable(Checked):
    """Sensors of a suite, in the order in which a filter processes them; new ones last."""

    imu: ImuParams = field(default_factory=ImuParams)
    """IMU, whose samples are the ticks of the simulation"""
    gnss: GnssParams | None = field(default_factory=GnssParams)
    """GNSS; None: no GNSS, and the filter starts from `initial_pose`"""
    camera: CameraParams | None = field(default_factory=CameraParams)
    """camera; None: no camera"""
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


SensorParams = GnssParams | CameraParams | AidParams  #: parameters of a sensor other than the IMU

SENSOR_PARAMS: dict[str, type[SensorParams]] = {
    row.name: get_args(row.type)[0] for row in dataclasses.fields(SensorTable) if row.name != "imu"
}
"""Classes of parameters by the names of the sensors."""

AID_PARAMS: dict[str, type[AidParams]] = {
    name: kind for name, kind in SENSOR_PARAMS.items() if issubclass(kind, AidParams)
}
"""The same of sensors of one reading, which has their name."""

READINGS: dict[str, ReadingDefinition] = {
    reading.name: reading
    for sensor, kind in SENSOR_PARAMS.items()
    for reading in kind.readings(sensor)
}
"""All readings by name, in the order of the sensors."""

SENSOR_OF: dict[str, str] = {
    reading.name: sensor
    for sensor, kind in SENSOR_PARAMS.items()
    for reading in kind.readings(sensor)
}
"""Sensors by the names of their readings."""

DRIFTING = tuple(name for name, kind in SENSOR_PARAMS.items() if kind.drift is not SensorBase.drift)
"""Sensors whose measurements may drift from zero at the start; see `SensorBase.drift`."""


def in_words(sensor: str) -> str:
    """Return a sensor in messages, such as "a barometer"."""
    return SENSOR_PARAMS[sensor].words or f"a {sensor.replace('_', ' ')}"


class ReadingShape(NamedTuple):
    """Properties of a reading for which records and kernels are made; see `ReadingDefinition`."""

    name: str
    length: int
    most_blocks: int
    observes: tuple[str, ...]
    direction: bool
    least_sigma: float
    in_G: bool
    marked: bool


class SensorShape(NamedTuple):
    """The same of a sensor."""

    readings: tuple[ReadingShape, ...]
    rows: int  #: triples in `AidParams.numbers`
    own_error: bool  #: True if an error of an `AidParams` is among the states of a filter
    aid: bool  #: True for an `AidParams`
    stages: tuple[FurtherStage, ...]  #: stages besides its own one


def _shape_of(name: str, kind: type[SensorBase]) -> SensorShape:
    """Return the shape of a class of parameters, and refuse a class that is incomplete."""
    aid = issubclass(kind, AidParams)
    own_error, rows = False, 0
    if issubclass(kind, AidParams):
        _require_complete(kind)
        slow = (kind.slow_vector, kind.slow_scalar)
        own_error = slow != (AidParams.slow_vector, AidParams.slow_scalar)
        rows = kind.rows
    shapes = []
    for reading in kind.readings(name):
        check.whole(f"{kind.__name__}.length", reading.length, most=3)
        for word in reading.observes:
            check.choice(f"{kind.__name__}.observes", word, OBSERVED)
        shapes.append(ReadingShape(*(getattr(reading, word) for word in ReadingShape._fields)))
    return SensorShape(tuple(shapes), rows, own_error, aid, kind.stages)


def _require_complete(kind: type[AidParams]) -> None:
    """Refuse a class that lacks a member, or has one that is not read."""
    for word in ("observes", "unit", "frame", "meaning", "raw"):
        if not hasattr(kind, word):
            raise ValueError(f"{kind.__name__} must have {word}, as in AidParams")
    known = {*dir(AidParams), *(row.name for row in dataclasses.fields(kind))}
    for word in vars(kind).keys() - known:
        if near := difflib.get_close_matches(word, known, 1, cutoff=0.8):
            raise ValueError(f"{kind.__name__}.{word} is not read; did you mean {near[0]}?")


SENSOR_SHAPES = {name: _shape_of(name, kind) for name, kind in SENSOR_PARAMS.items()}
"""Shapes by the names of the sensors. Compiled code depends on these, not on other parameters."""

__all__ = [params.__name__ for params in SENSOR_PARAMS.values()]  # what `quad_gym` exports
