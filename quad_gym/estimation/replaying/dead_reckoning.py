"""Changes of an estimate that its IMU samples do not explain.

From each of many instants, the estimate is propagated with IMU samples for some time. In a
consistent filter the later estimate differs from this by at most the standard deviation of the
propagation, because measurements then only remove a part of it. A filter that follows a drift or a
jump of GNSS, or finds out that it was wrong, changes by many standard deviations.
"""

from typing import NamedTuple

import numpy as np

from quad_gym.estimation.logs import Floats, Log
from quad_gym.estimation.logs.clocks import PAUSE
from quad_gym.estimation.replaying.results import Replay
from quad_gym.rotations import quaternion_to_dcm

HORIZONS = (0.5, 2.0)
"""Durations of the propagations [s]: jumps, and changes within the seconds after which a filter
accepts measurements that it has rejected."""
IMPACT = 30.0
"""Specific force of a touchdown [m/s^2]: samples do not show a shock in full."""
SETTLED = 5.0  #: time after the start from which changes of the estimate count [s]
GRAVITY = 9.80665  #: [m/s^2]


class Change(NamedTuple):
    """Largest unexplained change of a quantity."""

    quantity: str  #: "position", "velocity", "tilt" or "heading"
    time: float  #: [s]
    size: float  #: [m], [m/s] or [rad]
    ratio: float  #: largest ratio of a component to its standard deviation


def changes(log: Log, result: Replay, settled: float) -> tuple[list[Change], int]:
    """Return the largest changes after a time, and the number of components that were compared.

    Changes within `SETTLED` after a pause do not count, as the filter starts again. The standard
    deviations of the propagation leave out correlations of the estimate's errors.
    """
    time = result.time
    rows = np.flatnonzero(time >= settled)
    if len(rows) < 3 or not np.isfinite(result.sigma[rows]).all():
        return [], 0
    first = rows[0]
    time, dt = time[first:], np.diff(time[first:])
    R = quaternion_to_dcm(result.quaternion[first:])
    r, v = result.position[first:], result.velocity[first:]
    gyro, accel = (increments(log, result, name)[first:] for name in ("gyro", "accel"))
    turns = gyro - result.gyro_bias[first:-1] * dt[:, np.newaxis]
    steps = accel - result.accel_bias[first:-1] * dt[:, np.newaxis]
    predicted = small_rotations(-turns) @ R[:-1]
    middle = 0.5 * (R[:-1] + predicted)
    gains = np.einsum("kji,kj->ki", middle, steps) - np.outer(dt, [0.0, 0.0, GRAVITY])
    V = np.vstack([np.zeros(3), np.cumsum(gains, axis=0)])
    S = np.cumsum((V[:-1] + 0.5 * gains) * dt[:, np.newaxis], axis=0)
    S = np.vstack([np.zeros(3), S])
    W = np.cumsum(np.einsum("kji,kj->ki", R[1:], _small_angles(R[1:], predicted)), axis=0)
    W = np.vstack([np.zeros(3), W])
    hardest = np.linalg.norm(accel, axis=1)  # parts may follow each other without time between
    np.divide(hardest, dt, out=hardest, where=dt > 0.0)
    began = np.maximum.accumulate(np.append(-np.inf, np.where(dt > PAUSE, time[1:], -np.inf)))
    found: dict[str, Change] = {}
    count = 0
    for T in HORIZONS:
        i = np.searchsorted(time, np.arange(time[0], time[-1] - T, 0.25 * T))
        j = np.minimum(np.searchsorted(time, time[i] + T), len(time) - 1)
        span = (time[j] - time[i])[:, np.newaxis]
        calm = np.array([hardest[a : b + 1].max() for a, b in zip(i, j, strict=True)]) < IMPACT
        calm &= time[i] - began[j] >= SETTLED
        i, j, span = i[calm], j[calm], span[calm]
        far = v[j] - v[i] - (V[j] - V[i])
        moved = r[j] - r[i] - v[i] * span - (S[j] - S[i] - V[i] * span)
        turned = W[j] - W[i]
        sigma = _propagated(result, first + i, span)
        for quantity, values, errors in (
            ("position", moved, sigma[0]),
            ("velocity", far, sigma[1]),
            ("tilt", turned[:, :2], sigma[2][:, :2]),
            ("heading", turned[:, 2:], sigma[2][:, 2:]),
        ):
            count += values.size
            ratios = (np.abs(values) / errors).max(axis=1)
            if not len(ratios):
                continue
            k = int(np.argmax(ratios))
            if quantity not in found or ratios[k] > found[quantity].ratio:
                size = float(np.linalg.norm(values[k]))
                found[quantity] = Change(quantity, float(time[i[k]]), size, float(ratios[k]))
    return list(found.values()), count


def increments(log: Log, result: Replay, name: str) -> Floats:
    """Return integrals (n - 1, 3) of IMU samples between the rows of a replay."""
    stamps, values = log.imu.time, log.imu.values[name]
    steps = np.diff(stamps)[:, np.newaxis]
    held = values[1:] if result.sensors.imu.samples == "average" else values[:-1]
    total = np.vstack([np.zeros(3), np.cumsum(held * steps, axis=0)])
    at = np.column_stack([np.interp(result.time, stamps, axis) for axis in total.T])
    return np.diff(at, axis=0)


def small_rotations(turns: Floats) -> Floats:
    """Return matrices (n, 3, 3) of rotation vectors (n, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(turns, axis=1)[:, np.newaxis, np.newaxis]
    K = np.zeros((len(turns), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        K[:, j, i], K[:, i, j] = turns[:, k], -turns[:, k]
    safe = np.maximum(angle, 1e-9)
    return np.eye(3) + np.sin(angle) / safe * K + (1.0 - np.cos(angle)) / safe**2 * (K @ K)


def _small_angles(later: Floats, predicted: Floats) -> Floats:
    """Return rotation vectors (n, 3) in B from predicted to later attitudes, if they are small."""
    D = later @ predicted.swapaxes(1, 2)
    parts = (D[:, 1, 2] - D[:, 2, 1], D[:, 2, 0] - D[:, 0, 2], D[:, 0, 1] - D[:, 1, 0])
    return 0.5 * np.stack(parts, axis=1)


def _propagated(result: Replay, rows: Floats, span: Floats) -> tuple[Floats, Floats, Floats]:
    """Return standard deviations (k, 3) of position, velocity and attitude after a span (k, 1)."""
    imu = result.sensors.imu
    r, v, e, b_a, b_g = np.split(result.sigma[rows] ** 2, 5, axis=1)
    turn = e + span**2 * b_g + imu.gyro_noise**2 * imu.dt * span
    tilt = turn[:, :2].max(axis=1, keepdims=True)
    force = b_a.max(axis=1, keepdims=True) + GRAVITY**2 * tilt * [1.0, 1.0, 0.0]
    white = imu.accel_noise**2 * imu.dt * span
    position = r + span**2 * v + 0.25 * span**4 * force + white * span**2 / 3.0
    return np.sqrt(position), np.sqrt(v + span**2 * force + white), np.sqrt(turn)
