"""The estimate of a filter in the memory of one flight, as its properties."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.estimation.engine import Engine
from quad_gym.estimation.headings import Moments, moments
from quad_gym.estimation.samples import Measurement
from quad_gym.packing.aids import blocks_of
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FilterStatus


class Innovations(NamedTuple):
    """Position, baseline, velocity, features, barometer and magnetometer of one update, in rows."""

    innovation: NDArray[np.float64]
    """(n, 3) of position [m] and velocity [m/s] in I; of a direction across the predicted one,
    horizontal and up, then NaN; of the barometer [m], then zeros; of the magnetometer in B [T]"""
    sigma: NDArray[np.float64]
    """(n, 3) standard deviations that the filter expected of them"""
    nis: NDArray[np.float64]
    """(n,) normalized squares, chi-square with 3, 2, 3, 2, 1 and 3 degrees of freedom"""
    gate: NDArray[np.float64]
    """(n,) what became of them, see `quad_gym.records.GateDecision`"""


class Estimate:
    """What a filter has estimated, and how sure it is."""

    sensors: SensorSuite
    _engine: Engine
    _log_weights: NDArray[np.float64] | None
    _moments: Moments | None
    _report: Innovations | None
    _reported: Measurement
    _running: bool

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) estimated position of the center of mass in I [m]."""
        return self._vector("r_hat")

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(3,) estimated velocity in I [m/s]."""
        return self._vector("v_hat")

    @property
    def R_BI(self) -> NDArray[np.float64]:
        """(3, 3) estimated attitude."""
        mixed = self._mixed()
        return self._read("R_hat") if mixed is None else mixed.R_hat.copy()

    @property
    def accel_bias(self) -> NDArray[np.float64]:
        """(3,) estimated accelerometer bias in B [m/s^2]."""
        return self._vector("b_a_hat")

    @property
    def gyro_bias(self) -> NDArray[np.float64]:
        """(3,) estimated gyro bias in B [rad/s]."""
        return self._vector("b_g_hat")

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(15, 15) covariance of the errors, in the order r, v, e, b_a, b_g."""
        mixed = self._mixed()
        if mixed is not None:
            return mixed.covariance[:15, :15].copy()
        L = self._read("L")
        return L @ L.T

    @property
    def heading_known(self) -> bool:
        """Whether the heading is known well enough for one Gaussian.

        False after a start without any heading, until the motion has told it. Meanwhile estimate
        and covariance are those of many filters together, one for each of many headings.
        """
        self._require_start()
        return self._log_weights is None

    @property
    def gnss_drift(self) -> NDArray[np.float64]:
        """(3,) estimated slow error of GNSS positions in I [m], zero for suites without one.

        It is zero at the start: positions count from where the receiver has the vehicle then.
        """
        return self._slow()[:3] * self.sensors.drifts

    @property
    def gnss_drift_covariance(self) -> NDArray[np.float64]:
        """(3, 3) covariance of its error [m^2]."""
        mixed = self._mixed()
        if mixed is not None and self.sensors.drifts:
            return mixed.covariance[15:18, 15:18].copy()
        L = self._read("L_slow")[:3]
        return L @ L.T * self.sensors.drifts

    @property
    def aid_errors(self) -> dict[str, NDArray[np.float64]]:
        """Estimated slow errors of the suite's aiding sensors, by name.

        "barometer": (1,) its bias [m]; "magnetometer": (4,) hard iron in B [T], then the true less
        the believed declination [rad].
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
        """What has gone wrong since the start; `FilterStatus(0)` when nothing has."""
        return FilterStatus(int(self._of_lane("filter_status")))

    @property
    def diverged(self) -> bool:
        """True while innovations show that the estimate is wrong, as `filter_diverged` of flights.

        Their NIS is twice its degrees of freedom or more, or they, or corrections of biases, have
        not been white lately.
        """
        return bool(self._of_lane("diverged") > 0.0)

    @property
    def nis(self) -> tuple[float, int]:
        """Normalized innovation squared of the last update, and how many measurements it had.

        Of the last by its time stamp, where measurements come late.
        """
        return float(self._read("nis")), int(self._read("nis_dimension"))

    @property
    def block_nis(self) -> NDArray[np.float64]:
        """(n,) normalized innovation squared of the last position, baseline, velocity and features.

        Then of the barometer and of the magnetometer, if there are such. In a filter that is right
        they are chi-square with 3, 2, 3, 2, 1 and 3 degrees of freedom; NaN: not measured yet.
        """
        return self._read("block_nis")[list(blocks_of(self.sensors))]

    @property
    def gate_decisions(self) -> NDArray[np.int64]:
        """(n,) what became of each of these, see `quad_gym.records.GateDecision`."""
        return self._read("gate")[list(blocks_of(self.sensors))].astype(np.int64)

    @property
    def last_update(self) -> Innovations:
        """What the last call of `update` measured, also where it came late; NaN for the rest."""
        self._require_start()
        if self._report is None:  # it came in time: what it told still stands in memory
            self._report = self._innovations(self._reported.blocks)
        return self._report

    def _innovations(self, measured: list[int]) -> Innovations:
        """The innovations of some blocks, as they are in memory now."""
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
        """Mean and covariance over all headings, as long as nobody knows it."""
        self._require_start()
        if self._log_weights is not None and self._moments is None:
            self._moments = moments(self._engine, self._log_weights)
        return self._moments

    def _read(self, name: str) -> NDArray[Any]:
        """A field of the one flight, or of that with the likeliest heading."""
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
