"""Faults by name, and the values of the keyword `faults`."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.faults import kinds
from quad_gym.faults.base import Fault
from quad_gym.params import checks as check
from quad_gym.params.aid_table import AID_PARAMS
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FAULT_KINDS

FaultsGiven = str | Fault | Iterable[str | Fault] | None
"""A fault, the name of a preset or several joined by "+", several of both, or None."""

_SOON = (2.0, 5.0)
"""Times [s] at which vehicles have left the ground and most of an episode lies ahead."""
_A_WHILE = (2.0, 5.0)
"""Some seconds [s]: a bridge, a tree, a shadow; our judgment, for episodes of 10 s."""

PRESETS: dict[str, tuple[Fault, ...]] = {
    "none": (),
    "gnss_outage": (kinds.GnssOutage(start=_SOON, duration=_A_WHILE),),
    "gnss_outliers": (kinds.GnssOutliers(),),
    "gnss_ramp": (kinds.GnssRamp(start=_SOON),),
    "gnss_jump": (kinds.GnssJump(start=_SOON, duration=_A_WHILE),),
    "baseline_loss": (kinds.BaselineLoss(start=_SOON, duration=_A_WHILE),),
    "position_jump": (kinds.PositionJump(start=_SOON),),
    "camera_occlusion": (kinds.CameraOcclusion(start=_SOON, duration=_A_WHILE),),
    "wrong_associations": (kinds.WrongAssociations(),),
    "imu_bias_step": (kinds.AccelBiasStep(start=_SOON), kinds.GyroBiasStep(start=_SOON)),
    "imu_saturation": (kinds.ImuSaturation(),),
    "rotor_loss": (kinds.RotorLoss(start=_SOON),),
    **{
        f"{sensor}_loss": (kinds.SensorLoss(sensor=sensor, start=_SOON, duration=_A_WHILE),)
        for sensor in AID_PARAMS
    },
}
"""Presets of faults by name, for episodes of ten seconds and more."""

ALL = "all"  #: name of all presets that a sensor suite can have


def faults_of(given: FaultsGiven, sensors: SensorSuite) -> tuple[Fault, ...]:
    """Return the faults that the keyword `faults` selects, in the order of `FaultKind`.

    "all" stands for every preset that the suite can have. At most one fault of each kind is
    accepted, and only faults of sensors in the suite.
    """
    given = () if given is None else (given,) if isinstance(given, (str, Fault)) else given
    if not isinstance(given, Iterable):
        raise ValueError(f"faults must be faults or names of presets, got {given!r}")
    found: list[Fault | None] = [None] * FAULT_KINDS
    for part in given:
        for fault in _named(part, sensors) if isinstance(part, str) else (part,):
            if not isinstance(fault, Fault):
                raise ValueError(f"faults must be faults or names of presets, got {fault!r}")
            if found[fault.kind] is not None:
                raise ValueError(
                    f"faults must contain one of each kind, got two {type(fault).__name__}; a "
                    "fault that recurs has a rate"
                )
            fault.check_suite(sensors)
            found[fault.kind] = fault
    return tuple(fault for fault in found if fault is not None)


def needs_sensors(fault: Fault) -> bool:
    """Return True for a fault of measurements, without effect where no sensors run."""
    return not isinstance(fault, (kinds.PositionJump, kinds.RotorLoss))


def felt_without_sensors(given: FaultsGiven, sensors: SensorSuite) -> tuple[Fault, ...]:
    """Return the faults that affect the vehicle itself, and thus also control on the truth."""
    return tuple(fault for fault in faults_of(given, sensors) if not needs_sensors(fault))


def _named(names: str, sensors: SensorSuite) -> Iterable[Fault]:
    """Yield the faults of presets joined by "+"."""
    for name in names.split("+"):
        if name == ALL:
            everything = (fault for preset in PRESETS.values() for fault in preset)
            yield from (fault for fault in everything if possible(fault, sensors))
        else:
            yield from PRESETS[check.choice("faults", name, (*PRESETS, ALL))]


def possible(faults: Any, sensors: SensorSuite) -> bool:
    """True if a sensor suite has the sensors that some faults need."""
    try:
        faults_of(faults, sensors)
    except ValueError:
        return False
    return True


def named_faults(faults: Iterable[Fault], bits: NDArray[Any]) -> dict[str, NDArray[np.bool_]]:
    """Return which faults are active, by name, from sums (...,) of 2^FaultKind."""
    whole = bits.astype(np.int64)
    return {fault.name: (whole >> fault.kind) % 2 > 0 for fault in faults}
