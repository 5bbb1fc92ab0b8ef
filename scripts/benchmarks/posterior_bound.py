"""The posterior Cramer-Rao bound: the smallest mean square errors that any filter can have.

Tichavsky's recursion, with the models linearized on the true trajectory of each flight, in the form
of covariances, which admits noise of less than full rank; the mean over flights is the bound. It
has the measurements that arrived, and all errors of the sensors: the white ones, and as further
states the GNSS drift, the constant error of baselines, the errors of barometer and magnetometer,
and the accelerometer's scale and alignment. Approximations: the vibration is the one in hover, the
blur of images is normal, and the IMU's noise during the latency of a measurement is neglected.

Source: P. Tichavsky, C. H. Muravchik and A. Nehorai, IEEE Trans. Signal Processing 46(5), 1998.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.analysis.consistency import PARTS
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import Sensor
from scripts.benchmarks.linear_sensors import MOVING, SuiteModel, Truth, transposed

Floats = NDArray[np.float64]
MEMORY = 64  #: number of ticks after which a measurement is too late


class Recursion:
    """Covariances of the states of linear systems, one for each flight.

    Args:
        P: Initial covariances, (n, k, k).
        moving: Number of states that a delayed measurement observes at its time stamp; the others,
            errors of the sensors, it observes as they are when it arrives. None: all.
    """

    def __init__(self, P: ArrayLike, moving: int | None = None) -> None:
        self.P = np.array(P, np.float64)
        self._moving = slice(moving)
        start = np.broadcast_to(np.eye(self.P.shape[-1]), self.P.shape)
        self._transitions = deque([self._own(start)], MEMORY)  # from the start to the last instants

    def _own(self, F: Floats) -> Floats:
        return F[:, self._moving, self._moving]

    def predict(self, F: Floats, Q: Floats) -> None:
        """Advance by an instant: x' = F x + w, with covariances Q of w, (n, k, k) each."""
        self.P = F @ self.P @ transposed(F) + Q
        self._transitions.append(self._own(F) @ self._transitions[-1])

    def measure(
        self, rows: NDArray[np.intp], H: Floats, variance: ArrayLike, delay: int = 0
    ) -> None:
        """Use measurements z = H x + noise of the state some instants ago.

        Args:
            rows: Indices of the flights that have measured, (j,).
            H: Jacobians, (j, m, k).
            variance: Variances of independent noise, (m,) or (j, m); infinite: not measured.
            delay: Instants since the measurement.
        """
        if delay:  # x then = A then A now^-1 x now
            now, then = (self._transitions[-1 - k][rows] for k in (0, delay))
            moved = np.linalg.solve(transposed(now), transposed(H[..., self._moving] @ then))
            H = H.copy()
            H[..., self._moving] = moved.swapaxes(-1, -2)
        weights: Floats = 1.0 / np.sqrt(np.broadcast_to(variance, H.shape[:2]))
        H = weights[..., np.newaxis] * H
        P = self.P[rows]
        P_xz = P @ transposed(H)
        P = P - P_xz @ np.linalg.solve(H @ P_xz + np.eye(H.shape[1]), transposed(P_xz))
        self.P[rows] = 0.5 * (P + transposed(P))


def posterior_bound(
    batch: FlightBatch, *, seeds: Sequence[int], duration: float, settle: float, every: float = 0.1
) -> dict[str, float]:
    """Return the bound on the root mean square errors of position, velocity and attitude per axis.

    Args:
        batch: Flights on the true state, with a filter, of a task without endings.
        seeds: Seeds of the flights.
        duration: Length of the flights [s].
        settle: Time from which on errors count [s].
        every: Time between two of them [s].

    Returns:
        Bounds by the names of `quad_gym.analysis.consistency.PARTS` [m, m/s, rad].
    """
    times, variances = bound_over_time(batch, seeds=seeds, duration=duration, every=every)
    mean = variances[times > settle - 0.5 * batch.sensors.imu.dt].mean(axis=0)
    return {name: float(np.sqrt(mean[PARTS[name]].mean())) for name in list(PARTS)[1:4]}


def bound_over_time(
    batch: FlightBatch, *, seeds: Sequence[int], duration: float, every: float
) -> tuple[Floats, Floats]:
    """Return times (t,) [s] and the bounds (t, 15) on the mean square errors of a filter's states.

    Args:
        batch: As in `posterior_bound`.
        seeds: Seeds of the flights.
        duration: Length of the flights [s].
        every: Time between two bounds [s].
    """
    model, dt = SuiteModel(batch.sensors), batch.sensors.imu.dt
    delays = batch._settings["sensor_delay"][0].astype(int)
    batch.reset(seeds=seeds)
    recursion = Recursion(model.start(batch.covariance()), MOVING)
    past = deque([_truth(batch)], MEMORY)
    times, variances = [], []

    def at(sensor: Sensor) -> Truth:
        return past[-1 - min(delays[sensor], len(past) - 1)]

    for tick in range(1, round(duration / dt) + 1):
        batch.step()
        past.append(_truth(batch))
        F, Q = model.transition(past[-2], past[-1], batch.vehicle.gravity)
        if tick <= delays[Sensor["GNSS"]] and "drift" in model.parts:
            Q[:, model.parts["drift"]] = 0.0  # a fix of the start arrives, without drift
        recursion.predict(F, Q)
        valid = batch.record("block_valid") > 0.0
        for rows, H, variance, sensor in model.measurements(valid, at, batch.feature_places()):
            recursion.measure(rows, H, variance, min(delays[sensor], len(past) - 1))
        if tick % round(every / dt) == 0:
            times.append(tick * dt)
            variances.append(np.einsum("nii->ni", recursion.P)[:, :15].mean(axis=0))
    return np.array(times), np.array(variances)


def _truth(batch: FlightBatch) -> Truth:
    return Truth(*(batch.read(name) for name in ("position", "velocity", "R_BI", "body_rates")))
