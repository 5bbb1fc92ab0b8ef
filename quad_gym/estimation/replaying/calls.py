"""The calls of a filter that replays a log, as rows that an exported filter repeats.

A row has a name and numbers; NaN: not measured.

| row | numbers |
|---|---|
| `origin` | reference antenna in G |
| `start` | `time`, then the fields of `qg_start` (exported header), absent vectors as NaN |
| `rest` | position, heading, time: a level vehicle at rest |
| `level` | none: heights of the barometer are relative to the first one |
| `imu` | angular rate, specific force, duration: a prediction |
| `gnss` | time, position and its sigmas, baseline, velocity and its sigma |
| `camera`, `barometer`, ... | time, the measurement |
| `estimate` | none: the estimate is printed |

Samples of the IMU and magnetic fields are in the axes of their sensors, from which the exported
filter rotates them to B. Time stamps are corrected by the suite's delays. Positions, baselines and
velocities are in G, positions relative to the reference antenna; their sigmas are in I.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from quad_gym.estimation.filtering.samples import HEADING_ALONE, Measurement
from quad_gym.estimation.logs import Floats, Log
from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records.inputs import SAME_TIME, Outcome
from quad_gym.rotations import euler_to_dcm

_STARTS = (
    *("gnss_position_G", "gnss_sigma", "gnss_baseline_G", "gnss_velocity_G", "velocity_sigma"),
    *("heading", "magnetometer", "course", "time", "tilt_sigma", "rest_sigma"),
)
"""Keywords of `initialize` that exported filters have, too."""


class FilterCalls:
    """Rows of the calls for a part of a log, in their order."""

    def __init__(self, suite: SensorSuite, log: Log) -> None:
        self._suite, self.rows = suite, list[str]()
        self._sensed = {"imu": log.as_sensed("imu").values}
        if log.magnetometer is not None:
            self._sensed["magnetometer"] = log.as_sensed("magnetometer").values
        if suite.gnss is not None:
            self._add("origin", *suite.gnss.reference_antenna_G)

    def start(
        self, given: Mapping[str, Any], field: int | None, barometer_from_start: bool
    ) -> None:
        """Add the start of the filter, with row `field` of the magnetometer, if it uses one."""
        if "position" in given:
            check.keywords(given, ("position", "heading", "time"), "start with samples=")
            self._add("rest", *given["position"], given["heading"], given["time"])
        else:
            check.keywords(given, _STARTS, "start with samples=")
            known = {"gnss_baseline_G", "heading", "magnetometer"} & set(given)
            if not (known or given.get("course")):
                raise ValueError(
                    "a log for an exported filter must have a baseline or a magnetic field at its "
                    "start, or give a heading or the course"
                )
            magnetometer = given.get("magnetometer")
            if magnetometer is not None:
                magnetometer = self._field(magnetometer, field)
            self._add(
                "start",
                *(given["time"], *given["gnss_position_G"]),
                *_three(given.get("gnss_sigma")),
                *_three(given.get("gnss_baseline_G")),
                *_three(given.get("gnss_velocity_G")),
                *(given.get("velocity_sigma", math.nan), given.get("heading", math.nan)),
                *_three(magnetometer),
                bool(given.get("course")),
                *(given.get(name, math.nan) for name in ("tilt_sigma", "rest_sigma")),
            )
        if barometer_from_start and self._suite.barometer is not None:
            self._add("level")

    def _field(self, field_B: Any, row: int | None) -> Floats:
        """Return the magnetic field of a start in the axes of the sensor."""
        if row is not None:
            return self._sensed["magnetometer"]["magnetometer"][row]
        return euler_to_dcm(self._suite.log_compass_rotation).T @ np.asarray(field_B)

    def take(self, given: Any, name: str, row: int, measurement: Measurement | None) -> None:
        """Add the calls for an INPUT that a filter has taken.

        Args:
            given: INPUT.
            name: Name of the stream.
            row: Row there; of samples, the one that holds for this time.
            measurement: The measurement; None: a sample.
        """
        now, time = float(given["now"]), float(given["time"])
        if measurement is not None:
            if given["outcome"] == Outcome.OK:
                self._update(name, time, row, measurement)
            return
        if given["keeps"]:
            self.keep()
        if time - now > SAME_TIME and math.isfinite(given["gyro"][0]):
            sample = self._sensed["imu"]
            self._add("imu", *sample["gyro"][row], *sample["accel"][row], time - now)

    def _update(self, name: str, time: float, row: int, given: Measurement) -> None:
        """Add the measurement of a stream with its time stamp."""
        if given.noise.get("baseline_sigma") == HEADING_ALONE:
            raise ValueError(
                "a log for an exported filter must have attitudes or baselines, got headings alone"
            )
        if name in ("gnss", "attitude"):
            vectors = (
                *(given.position_G, given.noise.get("position_sigma_I")),
                *(given.baseline_G, given.velocity_G),
            )
            numbers = [number for vector in vectors for number in _three(vector)]
            self._add("gnss", time, *numbers, given.noise.get("velocity_sigma", math.nan))
        elif given.pixels is not None:
            self._add(name, time, *given.pixels.ravel())
        elif name in self._sensed:
            self._add(name, time, *self._sensed[name][name][row])
        else:
            (value,) = given.aids.values()
            self._add(name, time, *value.ravel())

    def keep(self) -> None:
        """Add the output of the estimate."""
        self._add("estimate")

    def _add(self, name: str, *numbers: float) -> None:
        self.rows.append(",".join((name, *(repr(float(number)) for number in numbers))) + "\n")


def _three(given: Any) -> Floats:
    """Return three numbers, of one or three; NaN for None."""
    return np.broadcast_to(np.asarray(math.nan if given is None else given, np.float64), 3)
