"""The estimate of a filter in the memory of one flight, as its properties."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.packing.aids import blocks_of
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import FilterStatus


class Estimate:
    """What a filter has estimated, and how sure it is."""

    sensors: SensorSuite
    _flight: NDArray[Any]
    _settings: NDArray[Any]
    _running: bool

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) estimated position of the center of mass in I [m]."""
        return self._read("r_hat")

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(3,) estimated velocity in I [m/s]."""
        return self._read("v_hat")

    @property
    def R_BI(self) -> NDArray[np.float64]:
        """(3, 3) estimated attitude."""
        return self._read("R_hat")

    @property
    def accel_bias(self) -> NDArray[np.float64]:
        """(3,) estimated accelerometer bias in B [m/s^2]."""
        return self._read("b_a_hat")

    @property
    def gyro_bias(self) -> NDArray[np.float64]:
        """(3,) estimated gyro bias in B [rad/s]."""
        return self._read("b_g_hat")

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(15, 15) covariance of the errors, in the order r, v, e, b_a, b_g."""
        L = self._read("L")
        return L @ L.T

    @property
    def gnss_drift(self) -> NDArray[np.float64]:
        """(3,) estimated slow error of GNSS positions in I [m], zero for suites without one.

        It is zero at the start: positions count from where the receiver has the vehicle then.
        """
        return self._read("slow_hat")[:3] * self.sensors.drifts

    @property
    def gnss_drift_covariance(self) -> NDArray[np.float64]:
        """(3, 3) covariance of its error [m^2]."""
        L = self._read("L_slow")[:3]
        return L @ L.T * self.sensors.drifts

    @property
    def aid_errors(self) -> dict[str, NDArray[np.float64]]:
        """Estimated slow errors of the suite's aiding sensors, by name.

        "barometer": (1,) its bias [m]; "magnetometer": (4,) hard iron in B [T], then the true less
        the believed declination [rad].
        """
        slow, found = self._read("slow_hat"), {}
        for aid in self.sensors.aids:
            vector, scalar = (
                int(self._settings[f"aid_{kind}"][0, aid]) for kind in ("vector", "scalar")
            )
            places = [*range(vector, vector + 3)] if vector >= 0 else []
            found[aid.name.lower()] = slow[places + ([scalar] if scalar >= 0 else [])]
        return found

    @property
    def status(self) -> FilterStatus:
        """What has gone wrong since the start; `FilterStatus(0)` when nothing has."""
        return FilterStatus(int(self._flight["filter_status"][0, 0]))

    @property
    def nis(self) -> tuple[float, int]:
        """Normalized innovation squared of the last update, and how many measurements it had."""
        return float(self._flight["nis"][0, 0]), int(self._flight["nis_dimension"][0, 0])

    @property
    def block_nis(self) -> NDArray[np.float64]:
        """(n,) normalized innovation squared of the last position, baseline, velocity and features.

        Then of the barometer and of the magnetometer, if there are such. In a filter that is right
        they are chi-square with 3, 2, 3, 2, 1 and 3 degrees of freedom; NaN: not measured yet.
        """
        return self._read("block_nis")[list(blocks_of(self.sensors))]

    @property
    def gate_decisions(self) -> NDArray[np.int64]:
        """(n,) what became of each of these, see `quad_gym.records.Gate`."""
        return self._read("gate")[list(blocks_of(self.sensors))].astype(np.int64)

    def _read(self, name: str) -> NDArray[Any]:
        self._require_start()
        return np.array(self._flight[name][0, ..., 0])

    def _require_start(self) -> None:
        if not self._running:
            raise RuntimeError("call initialize() or set_state() before using the filter")
