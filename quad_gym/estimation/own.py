"""`Estimator`: a user's own filter in place of the built-in one, and checks of its estimates."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params.checks import did_you_mean
from quad_gym.rotations import quaternion_to_dcm

if TYPE_CHECKING:
    from quad_gym.batch.measurements import Measurements, StartView

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

ESTIMATES: dict[str, tuple[int, ...]] = {
    "position": (3,),
    "velocity": (3,),
    "R_BI": (3, 3),
    "quaternion": (4,),
    "body_rates": (3,),
    "accel_bias": (3,),
    "gyro_bias": (3,),
    "covariance": (15, 15),
}
"""Names in an estimate, and the shape of each for one flight."""

_NORM_ERROR = 1e-2  #: largest error of the sum of the squares of a quaternion, or of R_BI


class Reading(NamedTuple):
    """Measurement of one sensor, of all flights."""

    value: Floats  #: one row per flight; NaN where no measurement arrives at this instant
    new: Truths  #: True where one arrives: (n,), for pixels (n, features)
    age: float
    """Time since the measurement was taken, its time stamp: the latency of the sensor [s]"""


class Estimator:
    """Your own state estimator, on which the controller flies instead of the built-in filter.

    `gymnasium.make(id, estimator=Mine())`, `make_vec`, `make_sb3_vec_env` and `FlightBatch` take an
    instance, the class, or "module:Class". The sensors measure as usual; at every tick, an IMU
    sample, `update` receives the measurements of all flights that have arrived, and returns an
    estimate as a dictionary of arrays with one row per flight:

    | name | shape | meaning |
    |---|---|---|
    | `position`, `velocity` | (n, 3) | of the center of mass, in I [m, m/s] |
    | `R_BI` | (n, 3, 3) | attitude, v_B = R_BI v_I |
    | `quaternion` | (n, 4) | instead of `R_BI`: B to I, (w, x, y, z) |
    | `body_rates` | (n, 3) | in B [rad/s]; optional: the gyro minus `gyro_bias` |
    | `accel_bias`, `gyro_bias` | (n, 3) | in B [m/s^2, rad/s]; optional: zero |
    | `covariance` | (n, 15, 15) | of the errors, positive definite; optional |

    The covariance has the order position and velocity in I, attitude, accelerometer and gyro bias
    in B. The attitude error e is the rotation from the estimated to the true body frame, R_BI =
    R(e) R_BI_hat; for small angles R(e) = 1 - [e x]. `include_std`, NEES, recorded flights and
    videos use the covariance at the end of a control period; without one, they have NaN, and
    `include_std=True` is refused.

    An environment has its own copy of the estimator. Variables that change from tick to tick
    belong in `state`: a class attribute with initial values by name, which define shape and type
    for one flight: {"position": np.zeros(3), "P": np.eye(15)}. In the methods `self.state.P` is the
    array (n, 15, 15) of all flights. It is saved, restored, copied and pickled with the flights,
    and has the initial values again in each new episode. Flights are the same in batches of any
    size, provided that the methods compute each row independently of the others.
    """

    state: Any = MappingProxyType({})

    def reset(self, view: "StartView", mask: Truths) -> Mapping[str, ArrayLike] | None:
        """Begin episodes.

        Args:
            view: Start of the episodes as the built-in filter has it (not the truth), and the first
                measurements.
            mask: Flights that begin an episode, (n,). Changes of the state of others are undone.

        Returns:
            Estimate at the start, of which the rows in `mask` are used; None: the built-in start.
        """
        return None

    def update(self, measurements: "Measurements") -> Mapping[str, ArrayLike]:
        """Return the estimate at the end of a tick.

        Args:
            measurements: The IMU sample of the tick, and the measurements that arrive at its end.

        Returns:
            Estimate of all flights.
        """
        raise NotImplementedError(f"{type(self).__name__} must define update(measurements)")


def checked_estimate(method: str, given: Any, count: int, rows: Truths) -> dict[str, Floats]:
    """Return an estimate as arrays, with the attitude as R_BI.

    Args:
        method: Class and method that returned it, for messages.
        given: Its return value.
        count: Number of flights.
        rows: Flights whose values must be finite, (n,).

    Raises:
        ValueError: If it is not a dictionary, a name is missing or unknown, or a value has another
            shape, is not finite, or is no rotation.
    """
    if not isinstance(given, Mapping):
        raise ValueError(f"{method} must return a dictionary of arrays, got {given!r:.60}")
    for name in given:
        if name not in ESTIMATES:
            known = did_you_mean(name, ESTIMATES) or f": one of {', '.join(ESTIMATES)}"
            raise ValueError(f"{method} must return known names, got {name!r}{known}")
    found = {name: _checked(method, name, given[name], count, rows) for name in given}
    if ("R_BI" in found) == ("quaternion" in found):
        raise ValueError(f'{method} must return either "R_BI" or "quaternion"')
    for name in ("position", "velocity"):
        if name not in found:
            raise ValueError(f'{method} must return "{name}"')
    attitude = "R_BI" if "R_BI" in found else "quaternion"
    values = found[attitude].reshape(count, -1)
    squares = np.einsum("ni,ni->n", values, values)
    norm = 3.0 if attitude == "R_BI" else 1.0
    good = np.asarray(np.abs(squares - norm) < _NORM_ERROR)
    if not good.all():
        _require(method, f'rotations for "{attitude}"', good, found[attitude], rows)
    if attitude == "quaternion":
        found["R_BI"] = quaternion_to_dcm(found.pop("quaternion") / np.sqrt(squares)[:, None])
    return found


def _checked(method: str, name: str, value: Any, count: int, rows: Truths) -> Floats:
    """Return one array of an estimate."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f'{method} must return numbers for "{name}", got {value!r:.60}') from None
    if array.shape != (count, *ESTIMATES[name]):
        raise ValueError(
            f'{method} must return shape {(count, *ESTIMATES[name])} for "{name}", got '
            f"{array.shape}"
        )
    if not np.isfinite(array.sum()):
        finite = np.isfinite(array).reshape(count, -1).all(axis=1)
        _require(method, f'finite numbers for "{name}"', finite, array, rows)
    return array


def _require(method: str, what: str, good: Any, values: Floats, rows: Truths) -> None:
    """Refuse values of flights in `rows` that are not `good`."""
    wrong = np.flatnonzero(~good & rows)
    if wrong.size:
        raise ValueError(
            f"{method} must return {what}, got {values[wrong[0]].tolist()!r:.60} for flight "
            f"{wrong[0]}" + (f" and {wrong.size - 1} more" if wrong.size > 1 else "")
        )


def factors(method: str, covariances: Floats, rows: Truths) -> Floats:
    """Return lower Cholesky factors of covariances; NaN where not in `rows`.

    Raises:
        ValueError: If a covariance in `rows` is not positive definite.
    """
    found = np.tril(np.full_like(covariances, np.nan))
    try:
        found[rows] = np.linalg.cholesky(covariances[rows])
    except np.linalg.LinAlgError:
        for flight in np.flatnonzero(rows):
            try:
                np.linalg.cholesky(covariances[flight])
            except np.linalg.LinAlgError:
                raise ValueError(
                    f'{method} must return a positive definite "covariance", got one that is not '
                    f"for flight {flight}"
                ) from None
        raise
    return found
