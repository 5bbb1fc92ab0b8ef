"""`Estimator`: a user's own filter in place of the built-in one, and checks of its estimates."""

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

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

_NORM_ERROR = 1e-2  #: largest error of the squared norm of a quaternion, or of R_BI R_BI^T
_ASYMMETRY = 1e-4
"""Largest difference of covariances P_ij and P_ji over the standard deviations of both; sums in
float32 reach 1e-5."""


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

    An environment has its own deep copy of the estimator. Variables that change from tick to tick
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
    if "R_BI" in found:
        R = found["R_BI"]
        with np.errstate(all="ignore"):  # of flights that are not in `rows`
            skew = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
            good = (skew < _NORM_ERROR) & (np.linalg.det(R) > 0.0)
        if not good.all():
            _require(method, 'rotations for "R_BI"', good, R, rows)
        return found
    quaternion = found.pop("quaternion")
    squares = np.einsum("ni,ni->n", quaternion, quaternion)
    good = np.asarray(np.abs(squares - 1.0) < _NORM_ERROR)
    if not good.all():
        _require(method, 'rotations for "quaternion"', good, quaternion, rows)
    found["R_BI"] = quaternion_to_dcm(quaternion / np.sqrt(squares)[:, None])
    return found


def own_copy(given: Estimator) -> Estimator:
    """Return a copy that shares nothing with the estimator."""
    try:
        return copy.deepcopy(given)
    except Exception as error:  # of any library whose objects it holds
        raise ValueError(
            f"estimator must be one that copy.deepcopy can copy, got {type(given).__name__}: "
            f"{error}"
        ) from None


def _checked(method: str, name: str, value: Any, count: int, rows: Truths) -> Floats:
    """Return one array of an estimate."""
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f'{method} must return arrays without a mask for "{name}"')
    try:
        given = np.asarray(value)
        if given.dtype.kind not in "biufO":
            raise TypeError(given.dtype.name)
        array = given.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        must = f'{method} must return real numbers for "{name}"'
        raise ValueError(f"{must}, got {value!r:.60}") from None
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
    """Return lower Cholesky factors of covariances; NaN where not in `rows`."""
    variances = np.einsum("nii->ni", covariances)
    with np.errstate(invalid="ignore"):  # of negative variances, which are refused below
        most = _ASYMMETRY * np.sqrt(variances[:, :, np.newaxis] * variances[:, np.newaxis])
    uneven = (np.abs(covariances - covariances.transpose(0, 2, 1)) > most).any(axis=(1, 2)) & rows
    if uneven.any():
        raise ValueError(
            f'{method} must return a symmetric "covariance", got another for flight '
            f"{np.flatnonzero(uneven)[0]}"
        )
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
