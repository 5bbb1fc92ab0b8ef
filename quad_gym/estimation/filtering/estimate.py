"""The estimate of a filter, as properties that read the memory of its flight."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.filtering.engine import Engine
from quad_gym.estimation.filtering.headings import Moments, moments
from quad_gym.estimation.filtering.samples import Measurement
from quad_gym.packing.aids import blocks_of
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FilterStatus, covariance_of


class Innovations(NamedTuple):
    """Innovations of one update: position, baseline, velocity, features, aiding sensors."""

    innovation: NDArray[np.float64]
    """(n, 3) innovations: of position [m] and velocity [m/s] in I; of directions, horizontally and
    vertically across the predicted direction, then NaN; of the barometer [m], then zeros; of the
    magnetometer in B [T]"""
    sigma: NDArray[np.float64]
    """(n, 3) standard deviations of the innovations, as predicted by the filter"""
    nis: NDArray[np.float64]
    """(n,) normalized innovations squared; chi-square with 3, 2, 3, 2, 1 and 3 degrees of
    freedom"""
    gate: NDArray[np.float64]  #: (n,) gate decisions, see `quad_gym.records.GateDecision`


class FilterEstimate:
    """State estimate and covariance."""

    sensors: SensorSuite
    _engine: Engine
    _log_weights: NDArray[np.float64] | None
    _moments: Moments | None
    _report: Innovations | None
    _reported: Measurement
    _running: bool

    @property
    def position(self) -> NDArray[np.float64]:
        """Estimated position (3,) of the center of mass in I [m]."""
        return self._vector("r_hat")

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Estimated velocity (3,) in I [m/s]."""
        return self._vector("v_hat")

    @property
    def R_BI(self) -> NDArray[np.float64]:
        """Estimated attitude (3, 3)."""
        mixed = self._mixed()
        return self._read("R_hat") if mixed is None else mixed.R_hat.copy()

    @property
    def accel_bias(self) -> NDArray[np.float64]:
        """Estimated accelerometer bias (3,) in B [m/s^2]."""
        return self._vector("b_a_hat")

    @property
    def gyro_bias(self) -> NDArray[np.float64]:
        """Estimated gyro bias (3,) in B [rad/s]."""
        return self._vector("b_g_hat")

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance (15, 15) of the errors, in the order r, v, e, b_a, b_g."""
        mixed = self._mixed()
        if mixed is not None:
            return mixed.covariance[:15, :15].copy()
        return covariance_of(self._read("L"), self._read("arc"))

    @property
    def heading_known(self) -> bool:
        """True if the heading is certain enough for a single Gaussian.

        False after a start without any heading, until the motion has revealed it. Meanwhile,
        estimate and covariance are the moments of a Gaussian sum: a bank of filters, one for each
        of many headings.
        """
        self._require_start()
        return self._log_weights is None

    @property
    def gnss_drift(self) -> NDArray[np.float64]:
        """Estimated time-correlated error (3,) of GNSS positions in I [m]; zero without drift.

        It is zero at the start, because positions are relative to the position that the receiver
        reports there.
        """
        return self._slow()[:3] * self.sensors.drifts

    @property
    def gnss_drift_covariance(self) -> NDArray[np.float64]:
        """Covariance (3, 3) of the estimated GNSS drift [m^2]."""
        mixed = self._mixed()
        if mixed is not None and self.sensors.drifts:
            return mixed.covariance[15:18, 15:18].copy()
        L = self._read("L_slow")[:3]
        return L @ L.T * self.sensors.drifts

    @property
    def aid_errors(self) -> dict[str, NDArray[np.float64]]:
        """Estimated time-correlated errors of the suite's aiding sensors, by name.

        "barometer": (1,) bias [m]; "magnetometer": (4,) hard iron in B [T], and error of the
        declination, true minus modeled [rad].
        """
        slow, found = self._slow(), {}
        for aid in self.sensors.aids:
            vector, scalar = (
                int(self._engine.settings[f"aid_{kind}"][0, aid]) for kind in ("vector", "scalar")
            )
            places = [*range(vector, vector + 3)] if vector >= 0 else []
            found[aid.name.lower()] = slow[places + ([scalar] if scalar >= 0 else [])]
        return found

    @property
    def status(self) -> FilterStatus:
        """Numerical failures since the start; `FilterStatus(0)`: none."""
        return FilterStatus(int(self._of_lane("filter_status")))

    @property
    def diverged(self) -> bool:
        """True while innovations show that the estimate is wrong, as `filter_diverged` of flights.

        The NIS is twice its degrees of freedom or more, or recent innovations, or corrections of
        biases, are not white.
        """
        return bool(self._of_lane("diverged") > 0.0)

    @property
    def nis(self) -> tuple[float, int]:
        """Normalized innovation squared of the last update, and its degrees of freedom.

        The suite's noise applies, and directions count across themselves, with two numbers. NaN:
        the update was done in steps.

        With delayed measurements, the last update is the one with the latest time stamp.
        """
        return float(self._read("nis")), int(self._read("nis_dimension"))

    @property
    def block_nis(self) -> NDArray[np.float64]:
        """Normalized innovations squared (n,) of the last measurements, block by block.

        The blocks are position, baseline, velocity and features, followed by the barometer and the
        magnetometer if the suite has them. For a consistent filter they are chi-square with 3, 2,
        3, 2, 1 and 3 degrees of freedom; NaN: not measured yet.
        """
        return self._read("block_nis")[list(blocks_of(self.sensors))]

    @property
    def gate_decisions(self) -> NDArray[np.int64]:
        """Gate decisions (n,) in the order of `block_nis`, see `quad_gym.records.GateDecision`."""
        return self._read("gate")[list(blocks_of(self.sensors))].astype(np.int64)

    @property
    def last_update(self) -> Innovations:
        """Innovations of the last call of `update`, also of a delayed one; NaN: not measured."""
        self._require_start()
        if self._report is None:  # it came in time: its innovations are still in memory
            self._report = self._innovations(self._reported.blocks)
        return self._report

    def _innovations(self, measured: list[int]) -> Innovations:
        """Return the innovations of some blocks, as they are in memory now."""
        blocks = list(blocks_of(self.sensors))
        apart = np.array([block not in measured for block in blocks], bool)
        values = [
            np.array(self._of_lane(name)[blocks])
            for name in ("innovation", "innovation_sigma", "block_nis", "gate")
        ]
        for numbers in values:
            numbers[apart] = np.nan
        return Innovations(*values)

    def _vector(self, name: str) -> NDArray[np.float64]:
        mixed = self._mixed()
        return self._read(name) if mixed is None else mixed.vectors[name].copy()

    def _slow(self) -> NDArray[np.float64]:
        slow, mixed = self._read("slow_hat"), self._mixed()
        if mixed is not None:
            slow[: len(mixed.vectors["slow_hat"])] = mixed.vectors["slow_hat"]
        return slow

    def _mixed(self) -> Moments | None:
        """Return mean and covariance over all headings, as long as the heading is unknown."""
        self._require_start()
        if self._log_weights is not None and self._moments is None:
            self._moments = moments(self._engine, self._log_weights)
        return self._moments

    def _read(self, name: str) -> NDArray[Any]:
        """Return a field of the only flight, or of the flight with the likeliest heading."""
        self._require_start()
        return self._of_lane(name)

    def _of_lane(self, name: str) -> NDArray[Any]:
        weights = self._log_weights
        lane = 0 if weights is None else int(np.argmax(weights))
        blocks = self._engine.blocks[name]
        width = blocks.shape[-1]
        return np.array(blocks[lane // width, ..., lane % width])

    def _require_start(self) -> None:
        if not self._running:
            raise RuntimeError("call initialize() or set_state() before using the filter")
