"""What the rules of a verdict look at: a log, its replay, and the innovations of each sensor."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from quad_gym.estimation.logs import Log
from quad_gym.estimation.replaying.findings import Finding, Severity
from quad_gym.estimation.replaying.fits import Fit
from quad_gym.estimation.replaying.results import Measured, Replay
from quad_gym.params.aid_table import AID_PARAMS
from quad_gym.params.sensors import SensorSuite

FALSE_ALARM = 1e-3  #: probability of a chance event that counts as a finding

NAMES = {
    "gnss_position": "GNSS position",
    "gnss_baseline": "GNSS baseline",
    "gnss_velocity": "GNSS velocity",
    "features": "camera features",
    **{name: name.replace("_", " ") for name in AID_PARAMS},
}
"""Sensors in sentences."""


def _observing(*states: str) -> tuple[str, ...]:
    return tuple(name for name, kind in AID_PARAMS.items() if {*states} & {*kind.observes})


MEASURED_BY = {
    "position": ("gnss_position", "gnss_velocity", "features", *_observing("position", "velocity")),
    "height": ("gnss_position", "gnss_velocity", "features", *_observing("height")),
    "heading": ("gnss_baseline", "features", *_observing("heading")),
}
"""Sensors that correct a quantity."""
OF_SENSOR = {"gnss_baseline": "heading"} | {
    name: kind.observes[0]
    for name, kind in AID_PARAMS.items()
    if kind.observes in (("height",), ("heading",))
}
"""Quantities of sensors; the position for others."""


@dataclass(frozen=True, eq=False)
class Case:
    """A replay to be judged."""

    log: Log  #: corrected by the suite
    body: str  #: axes of the IMU in a table, "flu" or "frd"
    suite: SensorSuite
    result: Replay  #: its rows until the motors stop for good
    sensors: Mapping[str, Measured]  #: innovations, of all blocks of a sensor together
    fits: Mapping[str, Fit]  #: their statistics
    start: Mapping[str, Any] = field(default_factory=dict)  #: that the caller has given


def lost(quantity: str, text: str) -> Finding:
    """Return a finding with which a quantity cannot be used."""
    return Finding(quantity=quantity, severity=Severity.LOST, text=text)


def uncertain(quantity: str, text: str) -> Finding:
    """Return a finding with which a quantity has larger errors than its standard deviation."""
    return Finding(quantity=quantity, severity=Severity.UNCERTAIN, text=text)


def note(quantity: str, text: str) -> Finding:
    """Return a finding for information."""
    return Finding(quantity=quantity, severity=Severity.NOTE, text=text)
