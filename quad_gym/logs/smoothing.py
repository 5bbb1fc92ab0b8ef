"""Smoothing: the best trajectory of a log, from all of its measurements.

The compiled filter processes the log forward, with measurements in the order of their time stamps,
none late. A Rauch-Tung-Striebel pass in NumPy then goes back over the errors of its estimates: over
a prediction from x, P to x-, P- with transition Jacobian Phi,

    G = P Phi^T P-^-1,  x_s <- x + G (x_s - x-),  P_s <- P + G (P_s - P-) G^T,

with the state (r, v, e, b_a, b_g) and the slow errors of sensors. Phi is the analytic Jacobian of
the EKF (`filter/predict.py`) for both filters: sigma points of the UKF are so close that their
differences equal it, and the second order that the UKF adds to P- counts as process noise. Attitude
errors are the error Euler angles of the report and compose by multiplication, R_BI = R(e) R_hat;
the covariance is transformed with each change of R_hat, as in the filter (`error_state.py`).

An update does not change a smoothed state. Where the filter inflates its covariance after one, the
inflation is a jump of the state: G = P- (P- + Q)^-1, with the positive part Q of P - P-.

Sources: H. E. Rauch, F. Tung and C. T. Striebel, AIAA Journal 3(8), 1965; S. R. McReynolds, Editing
data using sequential smoothing techniques for discrete systems, AIAA/AAS Astrodynamics Conference,
1984.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from scipy.linalg import cho_solve

from quad_gym.estimation.filters import KalmanFilter, run_while_unknown
from quad_gym.estimation.inputs import Tape
from quad_gym.logs.double import in_double
from quad_gym.logs.formats import Floats, Log, Reading
from quad_gym.logs.replaying.player import ESTIMATORS, Player
from quad_gym.logs.replaying.replay import in_parts, judged, named_start, prepared
from quad_gym.logs.replaying.results import Smoothed
from quad_gym.params import checks as check
from quad_gym.params.suites import SensorSuite
from quad_gym.records import OPERATION, Operation, joint_covariance
from quad_gym.rotations import dcm_to_euler, dcm_to_quaternion, euler_to_dcm

_AT_ONCE = 256  #: operations between two readings of the filter's memory
_MIN_JUMP = 1e-9  #: share of a variance, at least, that an inflation adds
_MIN_CHANGE = 1e-6  #: share of a variance that smoothing must remove for the consistency test
_MIN_VARIANCE = 1e-14  #: added to all variances, in units of these, against rounding
_E = slice(6, 9)


@in_double
def smooth(
    log: Any,
    *,
    sensors: SensorSuite | str,
    estimator: str = "ukf",
    start: Mapping[str, Any] | None = None,
    reported_noise: bool = True,
    **reading: Unpack[Reading],
) -> Smoothed:
    """Return the best trajectory of a log, with its covariance.

    Each estimate contains all measurements of the log, earlier and later ones. The arguments are as
    in `quad_gym.estimation.replay`, whose `problems` also apply here. Where the process computes in
    single precision, another one does this in double precision.

    Args:
        log: A table or a file, see `quad_gym.estimation.read_log`, or its result.
        sensors: The suite that the filter assumes, or its name.
        estimator: Filter of the forward pass, "ukf" or "ekf".
        start: Keywords of `initialize`.
        reported_noise: True: use the accuracy that the receiver reports.
        **reading: Keywords of `read_log`: `body`, `instance`, `topic`, `columns`, `from_`, `until`.

    Raises:
        ValueError: As `replay`, if the heading is never known, or if an argument cannot be pickled
            in single precision.
    """
    check.choice("estimator", estimator, tuple(ESTIMATORS))
    check.flag("reported_noise", reported_noise)
    whole, suite = prepared(log, sensors, reading)
    begins = named_start(start)
    whole, found = judged(whole, suite, begins, estimator, reported_noise)
    whole = replace(whole, notes=(*whole.notes, *(finding.text for finding in found)))

    def fly(part: Log, begin: dict[str, Any]) -> Smoothed:
        return _smoothed(Player(part, suite, estimator, begin, reported_noise, None))

    return in_parts(whole, begins, fly)


def _smoothed(player: Player) -> Smoothed:
    """Return the smoothed trajectory of one part of a log."""
    forward = _filter_forward(player)
    x, R_BI, P = _smooth_back(forward)
    rows = forward.rows
    gained = forward.variances[rows, :15] - np.diagonal(P, axis1=1, axis2=2)
    gained[gained < _MIN_CHANGE * forward.variances[rows, :15]] = np.nan
    difference = forward.x[rows, :15] - x[:, :15]
    difference[:, _E] = dcm_to_euler(forward.R_BI[rows] @ R_BI.swapaxes(1, 2))
    return Smoothed(
        sensors=player.suite,
        time=forward.time,
        position=x[:, :3],
        velocity=x[:, 3:6],
        quaternion=dcm_to_quaternion(R_BI),
        accel_bias=x[:, 9:12],
        gyro_bias=x[:, 12:15],
        sigma=np.sqrt(np.diagonal(P, axis1=1, axis2=2)),
        covariance=P,
        difference=difference / np.sqrt(gained),
        status=player.filter.status,
    )


# ---- forward -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Forward:
    """States of the filter: the first one, and those after each of n predictions and updates."""

    x: Floats  #: (n + 1, N) estimates, zero for the error angles
    R_BI: Floats  #: (n + 1, 3, 3) estimated attitudes
    covariance: Floats  #: (n + 1, N, N) covariances
    variances: Floats  #: (n + 1, N) their diagonals
    sample: Any  #: (n,) number of the sample of a prediction; -1: an update
    jacobian: Floats  #: (n, 15, 15) of predictions, without slow errors
    decay: Floats  #: (n, N - 15) of predictions, for slow errors
    resets: bool  #: True: the covariance is transformed when error angles are reset
    rows: Any  #: (m,) numbers of the states at samples of the log
    time: Floats  #: (m,) times of these [s]


def _filter_forward(player: Player) -> _Forward:
    """Run the filter of a player."""
    player.write_tape()
    kf = player.filter
    tape, status = player.writer.tape(), kf.status
    tape = tape.after(run_while_unknown(kf, player.writer, tape, {})[0])
    codes = tape.operations["code"]
    if not (kf.heading_known and len(codes)):
        raise ValueError(
            "a log to smooth must have a start with a heading, or motion that shows it"
        )
    inputs = codes != Operation.KEEP
    operations = tape.operations[inputs].copy()
    operations["target"] = -1
    parts = [_run_and_copy(kf, tape, operations[:0])]
    for first in range(0, len(operations), _AT_ONCE):
        parts.append(_run_and_copy(kf, tape, operations[first : first + _AT_ONCE]))
    kf.warn_of_news(status)
    x, R_BI, covariance, changes = (np.concatenate(values) for values in zip(*parts, strict=True))
    predicts = operations["code"] == Operation.PREDICT
    sample = np.where(predicts, operations["index"], -1)
    jacobian, decay = _jacobians(kf, tape.samples[sample], x, R_BI, changes[:-1])
    rows = np.cumsum(inputs)[~inputs]
    last = np.diff(rows, append=len(codes)) > 0  # the first sample may be the start
    return _Forward(
        x,
        R_BI,
        covariance,
        np.diagonal(covariance, axis1=1, axis2=2),
        sample,
        jacobian,
        decay,
        kf._engine.sensors.estimator.attitude_reset,
        rows[last],
        np.array(player.times)[tape.operations["target"][~inputs][last]],
    )


def _run_and_copy(kf: KalmanFilter, tape: Tape, operations: Any) -> tuple[Floats, ...]:
    """Run operations; return x, R_BI, P and v_corrected after each, or the present ones."""
    engine, count = kf._engine, len(operations)
    slots = engine.memory[:1]
    if count:
        both = np.empty((count, 2), OPERATION)
        both[:, 0] = operations
        both[:, 1]["code"], both[:, 1]["target"] = Operation.COPY, np.arange(count)
        piece = replace(tape, operations=both.ravel(), slots=count, kept=0)
        slots = engine.empty_slots(piece)
        engine.run(piece, slots)
    names = ("r_hat", "v_hat", "b_a_hat", "b_g_hat", "slow_hat", "R_hat", "P", "P_slow")
    r, v, b_a, b_g, d, R_BI, P, P_slow = (engine.of_copies(slots, name) for name in names)
    slow = engine.slow_states
    x = np.hstack([r, v, 0.0 * r, b_a, b_g, d[:, :slow]])
    joint = joint_covariance(P, P_slow[:, :slow])
    return x, R_BI.copy(), joint, engine.of_copies(slots, "v_corrected").copy()


def _jacobians(
    kf: KalmanFilter, samples: Any, x: Floats, R_BI: Floats, changes: Floats
) -> tuple[Floats, Floats]:
    """Return the Jacobians (n, 15, 15) of predictions, and the decay (n, N - 15) of slow errors.

    The force in I follows from the change of the velocity; it contains the lever arm.
    """
    dt, engine = samples["dt"][:, np.newaxis], kf._engine
    estimator = engine.sensors.estimator
    decay = np.exp(-dt * engine.steps["rate"][0, :, 0])
    before = x[:-1]
    f_I = np.diff(x[:, 3:6], axis=0) / dt + [0.0, 0.0, estimator.gravity]
    w_B = samples["gyro"] - before[:, 12:15]
    R_IB, eye = R_BI[:-1].swapaxes(1, 2), np.eye(3)
    dt = dt[:, :, np.newaxis]
    found = np.tile(np.eye(15), (len(samples), 1, 1))
    of_gyro = np.zeros((len(samples), 3, 3))  # derivative of the acceleration
    if estimator.integration == "midpoint":
        half = _turn(0.5 * dt[:, 0] * w_B)
        R_IB_half = R_IB @ half.swapaxes(1, 2)
        found[:, _E, 6:9], found[:, _E, 12:15] = half @ half, -dt * half
        of_gyro = 0.5 * dt * _cross(f_I) @ R_IB_half
    else:
        R_IB_half, (p, _, r) = R_IB, w_B.T
        rates = np.zeros((len(samples), 3, 3))
        rates[:, 0, 1], rates[:, 1, 0], rates[:, 2, 1] = r, -r, -p
        reset = _resets(dt[:, 0] * w_B) if estimator.attitude_reset else eye
        found[:, _E, 6:9], found[:, _E, 12:15] = reset @ (eye + dt * rates), -dt * reset
    of_states = {6: -_cross(f_I) @ R_IB, 9: -R_IB_half, 12: of_gyro}
    found[:, 0:3, 3:6] = dt * eye
    for column, block in of_states.items():
        found[:, 0:3, column : column + 3] = 0.5 * dt * dt * block
        found[:, 3:6, column : column + 3] = dt * block
    of_change = -_cross(changes) @ R_IB  # with first estimates, else zero
    found[:, 0:3, 6:9] += dt * of_change
    found[:, 3:6, 6:9] += of_change
    for column, k in ((9, 0), (12, 1)):
        found[:, column : column + 3, column : column + 3] *= decay[:, k, np.newaxis, np.newaxis]
    return found, decay[:, 2 : 2 + engine.slow_states]


# ---- backward ------------------------------------------------------------------------------------


def _smooth_back(f: _Forward) -> tuple[Floats, Floats, Floats]:
    """Return smoothed x, R_BI and covariances (m, 15, 15) at the rows."""
    row = len(f.rows) - 1
    x, R_BI, P = f.x[-1], f.R_BI[-1], f.covariance[-1]
    xs, Rs = f.x[f.rows], f.R_BI[f.rows]
    Ps = np.empty((row + 1, 15, 15))
    for k in range(len(f.sample), -1, -1):
        while row >= 0 and f.rows[row] == k:
            xs[row], Rs[row], Ps[row] = x, R_BI, P[:15, :15]
            row -= 1
        if k == 0 or row < 0:
            break
        before = f.covariance[k - 1]
        predicts = f.sample[k - 1] >= 0
        Phi = _transition(f, k - 1) if predicts else np.eye(len(before))
        moved = Phi @ before
        expected = moved @ Phi.T
        noise = _added(f, k, expected, 0.0 if predicts else _MIN_JUMP)
        if not (predicts or noise.any()):
            continue
        after = expected + noise
        units = _units(np.diag(after))
        scaled = after / units[:, np.newaxis] / units + _MIN_VARIANCE * np.eye(len(units))
        gain = cho_solve((np.linalg.cholesky(scaled), True), moved / units[:, np.newaxis]).T / units
        origin = k if predicts else k - 1
        error, angles = x - f.x[origin], dcm_to_euler(R_BI @ f.R_BI[origin].T)
        if f.resets:  # to the angles about the filter's attitude
            P = _turned(P, _resets(angles), back=True)
        error[_E] = angles
        error = gain @ error
        x, angles = f.x[k - 1] + error, error[_E]
        x[_E], R_BI = 0.0, euler_to_dcm(angles) @ f.R_BI[k - 1]
        P = before + gain @ (P - after) @ gain.T
        if f.resets:
            P = _turned(P, _resets(angles))
        P = 0.5 * (P + P.T)
    return xs, Rs, Ps


def _transition(f: _Forward, k: int) -> Floats:
    """Return the Jacobian of a prediction for all states."""
    found = np.diag(np.concatenate([np.zeros(15), f.decay[k]]))
    found[:15, :15] = f.jacobian[k]
    return found


def _added(f: _Forward, k: int, expected: Floats, least: float) -> Floats:
    """Return the positive part of the covariance in state k minus the expected one.

    This is the noise of a prediction, or the inflation by an update, so that neither the second
    order of the UKF nor rounding makes a smoothed covariance indefinite.

    Args:
        f: States of the filter.
        k: Number of the state, after a prediction or an update.
        expected: Covariance without it.
        least: Smallest share of a variance that is not neglected.
    """
    after = f.covariance[k]
    if f.resets and f.sample[k - 1] < 0:
        moved = dcm_to_euler(f.R_BI[k] @ f.R_BI[k - 1].T)
        after = _turned(after, _resets(moved), back=True)
    units = _units(np.diag(expected))
    values, vectors = np.linalg.eigh((after - expected) / units[:, np.newaxis] / units)
    root = units[:, np.newaxis] * vectors * np.sqrt(np.where(values > least, values, 0.0))
    return np.asarray(root @ root.T)


def _units(variances: Floats) -> Floats:
    """Return standard deviations, and 1 for zero: a drift may start without any."""
    return np.asarray(np.sqrt(np.where(variances > 0.0, variances, 1.0)))


# ---- rotations -----------------------------------------------------------------------------------


def _cross(v: Floats) -> Floats:
    """Return [v x], (..., 3, 3) of (..., 3)."""
    found = np.zeros((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        found[..., j, i], found[..., i, j] = v[..., k], -v[..., k]
    return found


def _turn(v: Floats) -> Floats:
    """Return exp(-[v x]), (..., 3, 3) of (..., 3)."""
    angle, S = np.linalg.norm(v, axis=-1)[..., np.newaxis, np.newaxis], _cross(v)
    half = np.sinc(0.5 * angle / np.pi)
    return np.asarray(np.eye(3) - np.sinc(angle / np.pi) * S + 0.5 * half * half * (S @ S))


def _turned(P: Floats, T: Floats, back: bool = False) -> Floats:
    """Return a covariance after a linear change T of the error angles, or before it."""
    P = P.copy()
    T = np.asarray(np.linalg.inv(T), np.float64) if back else T
    P[_E] = T @ P[_E]
    P[:, _E] = P[:, _E] @ T.T
    return P


def _resets(m: Floats) -> Floats:
    """Return the Jacobians of resets of the error angles, see `kernels/filter/error_state.py`."""
    sines, cosines = np.sin(m), np.cos(m)
    (sin_phi, sin_th), (cos_phi, cos_th) = (np.moveaxis(v, -1, 0)[:2] for v in (sines, cosines))
    found = np.zeros((*m.shape, 3))
    found[..., 0, 0], found[..., 0, 2], found[..., 1, 1] = cos_th, -cos_phi * sin_th, 1.0
    found[..., 1, 2], found[..., 2, 0], found[..., 2, 2] = sin_phi, sin_th, cos_phi * cos_th
    return found
