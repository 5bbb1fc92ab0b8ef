"""Measurements of a log, as the filter of a suite receives them."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.filtering.filters import LONGEST_STEP
from quad_gym.estimation.filtering.samples import (
    HEADING_ALONE,
    Measurement,
    checked_baseline,
    checked_measurement,
)
from quad_gym.estimation.filtering.starts import level
from quad_gym.estimation.logs import Floats, Log
from quad_gym.estimation.replaying.plausibility import MisfitError
from quad_gym.frames import ecef_to_enu
from quad_gym.params.aid_table import AID_PARAMS
from quad_gym.params.portable import turned
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import Aid
from quad_gym.rotations import quaternion_to_dcm

_OF_GNSS = ("gnss_position_G", "gnss_baseline_G", "gnss_velocity_G")

UNMEASURED = 1e4  #: standard deviation along an axis that was not measured [m]


class LogMeasurements:
    """Measurements of a log that a suite uses.

    Attributes:
        streams: Streams that the suite uses, by name; the IMU first.
        unused: Names of the others.
        takes_velocity: True if the suite uses velocities of GNSS.
        R_GI: (3, 3) axes of I in G.
    """

    def __init__(self, log: Log, suite: SensorSuite, reported_noise: bool) -> None:
        self.log, self.suite, self._reported = log, suite, reported_noise
        given = {name: stream for name, stream in log.streams.items() if name != "imu"}
        used = {name: stream for name, stream in given.items() if self._uses(name)}
        self.streams = {"imu": log.imu, **used}
        self._names = list(self.streams)
        self.takes_velocity = suite.gnss is not None and suite.gnss.velocity_sigma is not None
        self.unused = tuple(name for name in given if name not in used)
        if "gnss" in used and not self.takes_velocity:
            velocities = {"velocity_G", "velocity_I"} & set(used["gnss"].values)
            self.unused += ("gnss_velocity",) if velocities else ()
        if "camera" in used:
            assert suite.camera is not None
            have = used["camera"].values["pixels"].shape[1]
            if have != len(suite.camera.features_I):
                raise MisfitError(
                    f"the log must have the {len(suite.camera.features_I)} features of the suite, "
                    f"got {have}"
                )
        self.R_GI, self._origin = np.eye(3), np.zeros(3)
        if suite.gnss is not None:
            self._origin = np.array(suite.gnss.reference_antenna_G)
            self.R_GI = ecef_to_enu(self._origin).T

    def _uses(self, name: str) -> bool:
        """Return True if the suite uses a stream: attitudes as baselines that the log lacks."""
        if name != "attitude":
            return getattr(self.suite, name) is not None
        gnss, given = self.suite.gnss, self.log.gnss
        told = given is not None and {"baseline_G", "baseline_I"} & set(given.values)
        return gnss is not None and gnss.has_baseline and not told

    def number(self, name: str) -> int:
        """Return the number of a stream."""
        return self._names.index(name)

    def by_number(self, number: int, k: int) -> Measurement:
        """Return measurement k of a stream, of which something was measured, by its number."""
        found = self.at(self._names[number], k)
        assert found is not None
        return found

    def present(self, number: int, rows: Any) -> NDArray[np.bool_]:
        """Return True for the rows of a stream, by its number, in which something was measured."""
        name = self._names[number]
        found = np.full(len(rows), name in ("camera", "attitude"))
        values, wanted = self.streams[name].values, [name]
        if name == "gnss":
            quantities = ("position", "baseline", "velocity")[: 3 if self.takes_velocity else 2]
            wanted = [f"{quantity}_{frame}" for quantity in quantities for frame in "GI"]
        for key in wanted:
            if key in AID_PARAMS:
                found |= AID_PARAMS[key].measured(values[key][rows])
            elif key in values and not found.all():
                found |= np.isfinite(values[key][rows]).reshape(len(rows), -1).all(axis=1)
        return found

    def at(self, name: str, k: int) -> Measurement | None:
        """Return measurement k of a stream; None: nothing was measured."""
        if name == "gnss":
            given = self.fix(k)
            position, baseline, velocity = (given.pop(key, None) for key in _OF_GNSS)
            if position is None and baseline is None and velocity is None:
                return None
            return checked_measurement(self.suite, position, baseline, None, velocity, given)
        if name == "camera":
            return Measurement(pixels=self.streams[name].values["pixels"][k])
        if name == "attitude":
            assert self.suite.gnss is not None
            baseline_I = turned(self._attitude(k).T, self.suite.gnss.baseline_B)
            alone = "heading" in self.streams[name].values
            return Measurement(
                baseline_G=checked_baseline(self.suite, turned(self.R_GI, baseline_I)),
                noise={"baseline_sigma": HEADING_ALONE} if alone else {},
            )
        aid = Aid[name.upper()]
        params, value = self.suite.aids[aid], self.streams[name].values[name][k]
        values = np.reshape(value, (-1, params.length))[: params.blocks]
        known = np.asarray(np.isfinite(values).all(axis=1))
        if not known.any():
            return None
        return Measurement(aids={aid: np.where(known[:, np.newaxis], values, np.nan)})

    def fix(self, k: int) -> dict[str, Any]:
        """Return the GNSS measurements of one instant as keywords of `update`."""
        found: dict[str, Any] = {}
        if (position := self._vector_G("position", k)) is not None:
            found["gnss_position_G"] = position
            self._add_noise(found, "gnss_sigma", "position_sigma_I", k)
        if (baseline := self._vector_G("baseline", k)) is not None:
            found["gnss_baseline_G"] = baseline
        velocity = self._vector_G("velocity", k) if self.takes_velocity else None
        if velocity is not None:
            found["gnss_velocity_G"] = velocity
            self._add_noise(found, "velocity_sigma", "velocity_sigma", k)
        return found

    def heading(self, time: float) -> float | None:
        """Return the heading by attitudes of the log near a time; None: unknown."""
        attitude = self.log.attitude
        if attitude is None or not len(attitude):
            return None
        k = int(np.argmin(np.abs(attitude.time - time)))
        R_BI = self._attitude(k)
        near = abs(attitude.time[k] - time) < LONGEST_STEP
        return math.atan2(R_BI[0, 1], R_BI[0, 0]) if near else None

    def _attitude(self, k: int) -> Floats:
        """Return an attitude R_BI of the log, level if only its heading is known."""
        assert self.log.attitude is not None
        values = self.log.attitude.values
        if "quaternion" in values:
            return quaternion_to_dcm(values["quaternion"][k])
        return level(float(values["heading"][k]))

    def _vector_G(self, quantity: str, k: int) -> Floats | None:
        """Return a vector in G, positions relative to the origin; None: not measured."""
        for frame in "GI":
            values = self.streams["gnss"].values.get(f"{quantity}_{frame}")
            if values is not None and np.isfinite(values[k]).all():
                vector = values[k] if frame == "G" else turned(self.R_GI, values[k])
                from_center = frame == "G" and quantity == "position"
                return vector - self._origin if from_center else vector
        return None

    def _add_noise(self, found: dict[str, Any], keyword: str, name: str, k: int) -> None:
        """Add the accuracy that a receiver reports."""
        values = self.streams["gnss"].values.get(name)
        if values is None:
            return
        sigma, suites = values[k], self.suite.gnss
        if name == "position_sigma_I" and np.isinf(sigma).any() and suites is not None:
            known = sigma if self._reported else np.full(3, np.nan)
            known = np.where(np.isnan(known), suites.position_sigma_I, known)
            found[keyword] = np.where(np.isinf(sigma), UNMEASURED, known)
        elif self._reported and np.isfinite(sigma).all():
            found[keyword] = sigma if values.ndim > 1 else float(sigma)
