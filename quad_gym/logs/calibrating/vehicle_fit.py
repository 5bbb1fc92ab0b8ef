"""Parameters of the vehicle from a log with motor voltages.

The smoothed trajectory of the log gives attitude, velocity and accelerometer bias. The specific
force of the model is, in B,

    f_B = a sum_i u_i^2 e3 - (c |z_I . v| + diag(d, 0)) R_BI v,
    du_i/dt = ((1 - s t) e_i - u_i) / tau_m,

with the voltages e_i, a = kF cm^2 / m, c = Cd Ad rho / (2 m), the linear drag d (2) over the mass,
the time constant tau_m of the rotors and the relative sag s of the battery. Least squares of the
accelerometer's samples minus f_B find a, tau_m, c, s and d, near a wide prior. Errors of successive
samples are correlated, so that each is compared with what the one before it predicts (P. Cochrane,
G. H. Orcutt, 1949). What correlation remains widens the intervals by the square root of its time.
Several logs are fitted one by one; the result is their mean, whose weights and interval include the
variance between flights (R. DerSimonian, N. Laird, 1986).
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quad_gym.logs.double import in_double
from quad_gym.logs.formats import Floats, Log, Reading, read_log
from quad_gym.logs.formats.clocks import longest_part
from quad_gym.logs.replaying.replay import prepared
from quad_gym.logs.replaying.results import correlation_time, correlations
from quad_gym.logs.smoothing import smooth
from quad_gym.params import checks as check
from quad_gym.params.suites import LogDelays, SensorSuite
from quad_gym.params.vehicle import VehicleParams, vehicle_params
from quad_gym.params.world import WorldParams
from quad_gym.rotations import quaternion_to_dcm

_SETTLING = 1.0  #: time after the start whose samples do not count [s]
_FIRST_LAG, _FIRST_DRAG = 0.05, 0.01
"""Values at which the search begins: time constant of the rotors [s], drag over mass [1/m]."""
_PRIOR = np.array([1.0, 1.0, 0.1, 0.01, 1.0, 1.0])
"""Standard deviations of the coordinates about these values, for logs that do not show them."""
_PASSES = 3  #: searches, after each of which the errors' correlation is found again


class FittedNumber(NamedTuple):
    """A number with its 95 % interval."""

    value: float  #: the number
    low: float  #: lower end of the interval
    high: float  #: upper end of the interval


class FittedVehicle(NamedTuple):
    """Result of `fit_vehicle`."""

    vehicle: VehicleParams
    """the vehicle with the thrust coefficient, drag coefficient and rotor lag that were found"""
    thrust_over_mass: FittedNumber  #: kF / m, thrust coefficient over mass [N/(rad/s)^2/kg]
    motor_time_constant: FittedNumber  #: time constant of the rotors [s]
    drag_over_mass: FittedNumber  #: cd Ad rho / (2 m) [1/m]
    sag: FittedNumber  #: relative decrease of the voltage at the motors [1/s]
    hover_voltage: FittedNumber
    """voltage at which the rotors carry the weight, with a full battery [V]"""
    linear_drag_over_mass: tuple[FittedNumber, FittedNumber]
    """linear drag along x and y of B, over the mass [1/s]"""
    world: WorldParams
    """a calm world with this linear drag, where its interval is above zero"""


@in_double
def fit_vehicle(
    log: Any,
    *,
    sensors: SensorSuite | str,
    motors: Mapping[str, ArrayLike] | None = None,
    vehicle: VehicleParams | str = "lab",
    start: Any = None,
    **reading: Unpack[Reading],
) -> FittedVehicle:
    """Find thrust, rotor lag, drag and battery sag of a vehicle from a log, or from several.

    Accelerations show forces over the mass: the mass stays as in `vehicle`, and the steady rotor
    speed per volt as well. Where the process computes in single precision, another one does this in
    double precision.

    Args:
        log: A table or a file, see `read_log`; or a list of them.
        sensors: The suite that the smoother assumes, or its name.
        motors: Commands of the motors: `time` (n,) [s] from which on they hold, and `voltages`
            (n, 4) [V]; None: the columns `motors` of the log.
        vehicle: The vehicle to begin with, or its name.
        start: Keywords of `initialize`, such as `{"heading": 0.5}`; of several logs, a list.
        **reading: Keywords of `read_log`: `body`, `instance`, `topic`, `columns`, `from_`, `until`.

    Raises:
        ValueError: If a log or an argument is invalid, or the commands are not during the flight.
    """
    known = vehicle_params(vehicle) if isinstance(vehicle, str) else vehicle
    check.instance("vehicle", known, VehicleParams)
    given = None if motors is None else _commands(motors)
    several = isinstance(log, (list, tuple))
    logs, starts = (log, start or [None] * len(log)) if several else ([log], [start])
    if not logs or len(starts) != len(logs):
        raise ValueError(f"start must be one for each of {len(logs)} logs, at least one")
    if given is not None and len(logs) > 1:
        raise ValueError("motors must not be given for several logs: they have columns of motors")
    pairs = [
        _fit(read_log(one, **reading), sensors, given, known, begin)
        for one, begin in zip(logs, starts, strict=True)
    ]
    return _result(known, *_mean(*(np.array(part) for part in zip(*pairs, strict=True))))


def _mean(values: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Return the mean (k,) of values (n, k) with standard deviations, and its own."""
    weights = sigma**-2
    mean = (weights * values).sum(axis=0) / weights.sum(axis=0)
    excess = (weights * (values - mean) ** 2).sum(axis=0) - (len(values) - 1)
    free = weights.sum(axis=0) - (weights**2).sum(axis=0) / weights.sum(axis=0)
    between = np.maximum(excess, 0.0) / np.where(free > 0.0, free, 1.0)
    weights = 1.0 / (sigma**2 + between)
    return (weights * values).sum(axis=0) / weights.sum(axis=0), weights.sum(axis=0) ** -0.5


def _fit(
    log: Log,
    sensors: SensorSuite | str,
    motors: tuple[Floats, Floats] | None,
    known: VehicleParams,
    start: Mapping[str, Any] | None,
) -> tuple[Floats, Floats]:
    """Return the coordinates log a, log tau_m, c, s, d of a log, and their standard deviations."""
    from scipy.linalg import solve_triangular
    from scipy.optimize import least_squares

    whole = longest_part(log)
    times, voltages = motors or _commands(_in_log(whole))
    whole, suite = prepared(whole, sensors, {})
    names = ("log_rotation", "log_compass_rotation", "log_accel_bias", "log_gyro_bias")
    suite = suite.replace(log_delays=LogDelays(), **dict.fromkeys(names, (0.0,) * 3))  # corrected
    smoothed = smooth(whole, sensors=suite, start=start)
    first, last = max(smoothed.time[0], times[0]) + _SETTLING, min(smoothed.time[-1], times[-1])
    ends = whole.imu.time
    rows = np.flatnonzero((ends[:-1] >= first) & (ends[1:] <= last)) + 1
    if len(rows) < 100:
        raise ValueError(
            "a log must have at least 100 IMU samples with motor commands, from "
            f"{_SETTLING:g} s after the start on, got {len(rows)}"
        )
    R_BI, v, bias = _motion(smoothed, 0.5 * (ends[rows] + ends[rows - 1]))
    measured = whole.imu.values["accel"][rows] - bias
    v_B = np.einsum("nij,nj->ni", R_BI, v)
    drag_B = np.abs((R_BI[:, 2] * v).sum(axis=1))[:, np.newaxis] * v_B
    spans = (ends[rows - 1], ends[rows])
    squares = known.gravity / (4.0 * known.hover_voltage**2)
    begin = np.array([math.log(squares), math.log(_FIRST_LAG), _FIRST_DRAG, 0.0, 0.0, 0.0])

    def errors_of(x: Floats) -> Floats:
        thrust = math.exp(x[0]) * _mean_squares(times, voltages, spans, math.exp(x[1]), x[3])
        model = -x[2] * drag_B - np.append(x[4:], 0.0) * v_B
        model[:, 2] += thrust
        return np.asarray(measured - model)

    def residuals(x: Floats, keep: Floats, sigma: float) -> Floats:
        errors = errors_of(x)
        return np.append(errors[1:] - keep * errors[:-1], sigma * (x - begin) / _PRIOR)

    x, keep, sigma = begin, np.zeros(3), float(errors_of(begin).std())
    for _ in range(_PASSES):
        found = least_squares(residuals, x, x_scale=_PRIOR, args=(keep, sigma))
        x, new = found.x, found.fun[: -len(begin)].reshape(-1, 3)
        sigma, keep = float(new.std()), correlations(errors_of(x))
    variance = max(correlation_time(column) for column in new.T) * sigma**2
    factor = np.linalg.qr(found.jac, mode="r")  # (J^T J)^-1 = R^-1 R^-T
    rows_of_inverse = solve_triangular(factor, np.eye(len(begin)))
    return x, math.sqrt(variance) * np.linalg.norm(rows_of_inverse, axis=1)


def _commands(motors: Mapping[str, ArrayLike]) -> tuple[Floats, Floats]:
    """Return checked times (n,) and voltages (n, 4)."""
    check.keywords(motors, ("time", "voltages"), "motors")
    times = check.array("motors['time']", motors["time"], (None,))
    voltages = check.array("motors['voltages']", motors["voltages"], (len(times), 4))
    if len(times) < 2 or not (np.diff(times) > 0.0).all():
        raise ValueError("motors['time'] must increase")
    if not np.ptp(voltages, axis=0).any():
        raise ValueError("motors['voltages'] must vary, but they are constant")
    return times, voltages


def _in_log(log: Log) -> dict[str, ArrayLike]:
    """Return the commands of the motors in a log; of the battery's voltage if it is known."""
    if log.motors is None:
        raise ValueError(
            "a log must have the columns motor_0 to motor_3 to fit a vehicle, or motors="
        )
    times, values = log.motors.time, log.motors.values
    if "motors" in values:
        return {"time": times, "voltages": values["motors"]}
    if log.battery is None or not len(log.battery):
        raise ValueError(
            "a log with commands of the motors from 0 to 1 must have the voltage of the battery to "
            "fit a vehicle"
        )
    full = np.interp(times, log.battery.time, log.battery.values["battery"])
    return {"time": times, "voltages": values["commands"] * full[:, np.newaxis]}


def _result(known: VehicleParams, x: Floats, sigma: Floats) -> FittedVehicle:
    """Return the result for the coordinates log a, log tau_m, c, s, d, and their deviations."""
    ends = (x, x - 1.96 * sigma, x + 1.96 * sigma)
    squares, lag = (FittedNumber(*(math.exp(end[k]) for end in ends)) for k in (0, 1))
    drag, sag, along, across = (
        FittedNumber(*(float(end[k]) for end in ends)) for k in (2, 3, 4, 5)
    )
    linear = [known.mass * d.value if d.low > 0.0 else 0.0 for d in (along, across)]
    per_speed = known.motor_speed_per_volt**2
    full_drag = 0.5 * known.disc_area * known.air_density / known.mass
    changes = {
        "thrust_coefficient": squares.value * known.mass / per_speed,
        "motor_time_constant": lag.value,
    }
    if full_drag:
        changes["drag_coefficient"] = max(0.0, drag.value) / full_drag
    hover = [
        math.sqrt(known.gravity / (4.0 * a)) for a in (squares.value, squares.high, squares.low)
    ]
    per_mass = FittedNumber(*(a / per_speed for a in squares))
    return FittedVehicle(
        vehicle=known.replace(**changes),
        thrust_over_mass=per_mass,
        motor_time_constant=lag,
        drag_over_mass=drag,
        sag=sag,
        hover_voltage=FittedNumber(*hover),
        linear_drag_over_mass=(along, across),
        world=WorldParams(linear_drag_B=(*linear, 0.0)),
    )


def _motion(smoothed: Any, times: Floats) -> tuple[Floats, Floats, Floats]:
    """Return attitudes (n, 3, 3), velocities (n, 3) and accelerometer biases (n, 3) at times."""
    nearest = np.clip(np.searchsorted(smoothed.time, times), 0, len(smoothed.time) - 1)
    v, bias = (
        np.column_stack([np.interp(times, smoothed.time, axis) for axis in values.T])
        for values in (smoothed.velocity, smoothed.accel_bias)
    )
    return quaternion_to_dcm(smoothed.quaternion[nearest]), v, bias


def _mean_squares(
    times: Floats, voltages: Floats, spans: tuple[Floats, Floats], lag: float, sag: float
) -> Floats:
    """Return means over spans of the sum of u_i^2, the squared speeds of the rotors in volts.

    While a command e holds, u = e + d exp(-t / lag), so the integral of u^2 is
    e^2 t + 2 e d lag (1 - exp(-t / lag)) + d^2 lag / 2 (1 - exp(-2 t / lag)).
    """
    reached = voltages * (1.0 - sag * (times - times[0]))[:, np.newaxis]
    decay = np.exp(-np.diff(times) / lag)
    away = np.zeros_like(reached)  # of the speed from the command, d
    for k, keep in enumerate(decay):
        away[k + 1] = keep * away[k] + reached[k] - reached[k + 1]
    square, twice, rest = (
        x.sum(axis=1) for x in (reached**2, 2.0 * lag * reached * away, 0.5 * lag * away**2)
    )

    def since(k: Any, t: Floats) -> Floats:
        """Integral over a time t since command k."""
        return np.asarray(
            square[k] * t - twice[k] * np.expm1(-t / lag) - rest[k] * np.expm1(-2.0 * t / lag)
        )

    steps = since(slice(-1), np.diff(times))
    total = np.concatenate([[0.0], np.cumsum(steps)])
    begins, ends = (
        total[k] + since(k, span - times[k])
        for span in spans
        for k in [np.searchsorted(times, span, side="right") - 1]
    )
    return np.asarray((ends - begins) / (spans[1] - spans[0]))
