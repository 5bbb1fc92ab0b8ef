"""The verdict on a replay as a classifier: simulated flights with one fault each, and without.

    python -m tests.statistical.verdicts --flights 60

A fault makes the estimate useless, or contradicts the suite. Flights without a fault have a
disturbance of real flights that a filter withstands. Suites, disturbances and faults take turns;
sizes and times are drawn. Prints false alarms and misses.
"""

import argparse
from itertools import pairwise

import numpy as np

from quad_gym.estimation import replay
from quad_gym.params.suites import sensor_suite
from quad_gym.rotations import euler_to_dcm
from tests.many_logs import logs_of

SUITES = ("consumer", "rtk", "field", "standard", "indoor", "stale", "lab")
SECONDS = 50.0
MICROTESLA = 1e-6


def rows(table, name):
    """Rows with a measurement."""
    return np.isfinite(table[name].reshape(len(table["time"]), -1)).any(axis=1)


def direction(rng):
    """A horizontal unit vector."""
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def correlated(rng, time, sigma, tau, axes=1):
    """A Gauss-Markov process (n, axes)."""
    found = np.zeros((len(time), axes))
    found[0] = rng.normal(0.0, sigma, axes)
    for k, (a, b) in enumerate(pairwise(time)):
        keep = np.exp(-(b - a) / tau)
        found[k + 1] = keep * found[k] + rng.normal(0.0, sigma * np.sqrt(1.0 - keep**2), axes)
    return found


# ---- disturbances, which are no faults: each changes a copy of a table --------------------------


def nothing(table, rng, suite):
    """The flight as simulated."""


def wash(table, rng, suite):
    """Propeller wash in the barometer, two to four times its noise, correlated over 0.3 s."""
    k = rows(table, "barometer")
    sigma = rng.uniform(2.0, 4.0) * suite.barometer.noise_sigma
    table["barometer"][k] += correlated(rng, table["time"][k], sigma, 0.3)[:, 0]


def iron(table, rng, suite):
    """Iron and currents near the magnetometer that vary within its hard iron."""
    k = rows(table, "magnetometer")
    sigma = 1.2 * suite.magnetometer.hard_iron_sigma
    table["magnetometer"][k] += correlated(rng, table["time"][k], sigma, 20.0, 3)


def outliers(table, rng, suite):
    """Single fixes, 3 %, that are off by 20 to 60 m."""
    k = rng.permutation(np.flatnonzero(rows(table, "gnss_enu"))[5:])
    for row in k[: round(0.03 * len(k))]:
        table["gnss_enu"][row] += rng.uniform(20.0, 60.0) * direction(rng)


def drift(table, rng, suite):
    """A slow drift of GNSS, as large as its noise, over a minute."""
    k = rows(table, "gnss_enu")
    sigma = np.array(suite.gnss.position_sigma_I)
    table["gnss_enu"][k] += sigma * correlated(rng, table["time"][k], 1.0, 60.0, 3)


def outage(table, rng, suite):
    """Three to six seconds without GNSS."""
    begin = rng.uniform(10.0, 30.0)
    gone = (table["received"] > begin) & (table["received"] < begin + rng.uniform(3.0, 6.0))
    for name in (n for n in table if n.startswith("gnss")):
        table[name][gone] = np.nan


def jitter(table, rng, suite):
    """Stamps that are off by up to 5 ms."""
    k = ~rows(table, "gyro")
    table["time"][k] -= rng.uniform(0.0, 0.005, k.sum())


def biases(table, rng, suite):
    """Biases of the IMU two to three times as large as the suite has them."""
    for name in ("accel", "gyro"):
        sigma = getattr(suite.imu, f"{name}_bias_sigma")
        table[name] += rng.uniform(2.0, 3.0) * sigma * rng.choice([-1.0, 1.0], 3)


def vibration(table, rng, suite):
    """Noise of the IMU twice as large."""
    k = rows(table, "gyro")
    for name, sigma in (("accel", suite.imu.accel_noise), ("gyro", suite.imu.gyro_noise)):
        table[name][k] += np.sqrt(3.0) * sigma * rng.normal(size=(k.sum(), 3))


def noise(table, rng, suite):
    """White noise of all measurements 1.4 times as large."""
    amplify(table, rng, suite, 1.0)


def losses(table, rng, suite):
    """A tenth of all measurements lost."""
    gone = ~rows(table, "gyro") & (rng.random(len(table["time"])) < 0.1) & (table["time"] > 1.0)
    return {name: column[~gone] for name, column in table.items()}


def pessimism(table, rng, suite):
    """A suite with noise of GNSS three times as large as it is."""
    gnss = suite.gnss.replace(position_sigma_I=tuple(3.0 * s for s in suite.gnss.position_sigma_I))
    return suite.replace(gnss=gnss)


# ---- faults -------------------------------------------------------------------------------------


def amplify(table, rng, suite, factor):
    """Add noise of `factor` times the suite's."""
    if suite.gnss is not None:
        k = rows(table, "gnss_enu")
        sigma = factor * np.array(suite.gnss.position_sigma_I)
        table["gnss_enu"][k] += sigma * rng.normal(size=(k.sum(), 3))
        if suite.gnss.velocity_sigma is not None:
            shape = (k.sum(), 3)
            table["gnss_velocity_enu"][k] += (
                factor * suite.gnss.velocity_sigma * rng.normal(size=shape)
            )
    if suite.camera is not None:
        table["pixels"] += (
            factor * suite.camera.pixel_sigma * rng.normal(size=table["pixels"].shape)
        )


def noisy(table, rng, suite):
    """White noise of GNSS and camera four to ten times as large."""
    amplify(table, rng, suite, rng.uniform(4.0, 10.0))


def ramp(table, rng, suite):
    """Fixes and velocities that drift off at 4 m/s for 20 s."""
    begin, way = rng.uniform(10.0, 25.0), direction(rng)
    since = np.clip(table["time"] - begin, 0.0, None)
    drifting = (since > 0.0) & (since < 20.0)
    table["gnss_enu"][drifting] += 4.0 * since[drifting, np.newaxis] * way
    if "gnss_velocity_enu" in table:
        table["gnss_velocity_enu"][drifting] += 4.0 * way


def jump(table, rng, suite):
    """Fixes that jump by 30 to 500 m for good."""
    size = np.exp(rng.uniform(np.log(30.0), np.log(500.0)))
    table["gnss_enu"][table["time"] > rng.uniform(10.0, 35.0)] += size * direction(rng)


def too_late(table, rng, suite):
    """Stamps that are 0.8 to 3 s early."""
    k = ~rows(table, "gyro")
    table["time"][k & (table["time"] > 1.0)] -= rng.uniform(0.8, 3.0)


def clock(table, rng, suite):
    """Stamps of GNSS or camera that are 0.4 s early."""
    k = rows(table, "pixels" if suite.gnss is None else "gnss_enu")
    table["time"][k & (table["time"] > 1.0)] -= 0.4


def silence(table, rng, suite):
    """No GNSS and camera for 12 s or more."""
    begin = rng.uniform(10.0, 30.0)
    gone = (table["received"] > begin) & (table["received"] < begin + rng.uniform(12.0, 19.0))
    for name in (n for n in table if n.startswith(("gnss", "pixels"))):
        table[name][gone] = np.nan


def course(table, rng, suite):
    """Velocities of GNSS in a direction that is off by 60 to 180 degrees."""
    angle = rng.uniform(np.pi / 3.0, np.pi) * rng.choice([-1.0, 1.0])
    table["gnss_velocity_enu"] = table["gnss_velocity_enu"] @ euler_to_dcm((0.0, 0.0, angle)).T


def compass(table, rng, suite):
    """A magnetometer that is turned by 40 to 140 degrees from the tenth second on."""
    angle = np.radians(rng.uniform(40.0, 140.0)) * rng.choice([-1.0, 1.0])
    k = table["time"] > 10.0
    field = table["magnetometer"]
    field[k] = field[k] @ euler_to_dcm((0.0, 0.0, angle)).T


def units(table, rng, suite):
    """An accelerometer in g, or a gyro in deg/s."""
    name, factor = (("accel", 1.0 / 9.80665), ("gyro", np.degrees(1.0)))[rng.integers(2)]
    table[name] *= factor


def axes(table, rng, suite):
    """An IMU whose x axis points to the left or right."""
    angle = 0.5 * np.pi * rng.choice([-1.0, 1.0])
    for name in ("gyro", "accel"):
        table[name] = table[name] @ euler_to_dcm((0.0, 0.0, angle)).T


def step(table, rng, suite):
    """A gyro that stops at its last value after 15 to 30 s."""
    k = np.flatnonzero(rows(table, "gyro") & (table["time"] > rng.uniform(15.0, 30.0)))
    table["gyro"][k] = table["gyro"][k[0]] + 0.5


HARMLESS = (
    nothing,
    wash,
    iron,
    outliers,
    drift,
    outage,
    jitter,
    biases,
    vibration,
    noise,
    losses,
    pessimism,
)
FAULTS = (noisy, ramp, jump, too_late, clock, silence, course, compass, units, axes, step)
NEEDS = {
    "barometer": (wash,),
    "magnetometer": (iron, compass),
    "gnss": (outliers, drift, outage, ramp, jump, course, pessimism),
    "gnss.velocity_sigma": (course,),
}
"""What requires a sensor of the suite."""


def possible(change, suite):
    """Return True if the suite has the sensors that a change concerns, and the gate."""
    if change is outliers and not suite.estimator.false_alarm_probability:
        return False
    for need, changes in NEEDS.items():
        part, _, field = need.partition(".")
        sensor = getattr(suite, part)
        if change in changes and (sensor is None or (field and getattr(sensor, field) is None)):
            return False
    return True


def cases(kinds, count):
    """Return pairs of suite and change, in turns."""
    found, k = [], 0
    while len(found) < count:
        for j, name in enumerate(SUITES):
            change = kinds[(k + 3 * j) % len(kinds)]
            if possible(change, sensor_suite(name)):
                found.append((name, change))
        k += 1
    return found[:count]


def start_of(suite, truth):
    """The true pose, where no sensor shows it."""
    if suite.gnss is not None:
        return {}
    w, x, y, z = truth["quaternion"][0]
    heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return {"position": truth["position"][0], "heading": float(heading)}


def position_errors(result, truth):
    """Errors of the replayed positions (n,) [m]."""
    true = [np.interp(result.time, truth["time"], axis) for axis in truth["position"].T]
    return np.linalg.norm(np.transpose(true) - result.position, axis=1)


def judged(name, change, log, truth, seed):
    """Replay a changed log; return the result and its largest position error after 10 s [m]."""
    rng, suite = np.random.default_rng(seed), sensor_suite(name)
    table = {key: column.copy() for key, column in log.items()}
    changed = change(table, rng, suite)
    if isinstance(changed, dict):
        table = changed
    elif changed is not None:
        suite = changed
    result = replay(table, sensors=suite, start=start_of(suite, truth))
    error = position_errors(result, truth)
    return result, float(error[result.time > 10.0].max())


def flown(name, count, seed):
    """Yield logs of flights that do not tumble, and their truth."""
    while count:
        for log, truth in logs_of(name, count, SECONDS, seed=seed):
            _, x, y, _ = truth["quaternion"].T
            if (1.0 - 2.0 * (x**2 + y**2)).min() > 0.0:
                count -= 1
                yield log, truth
        seed += 1000


def run(some, faulty, verbose=False, seed=100):
    """Yield the pairs of `cases` on which the verdict is wrong, with its sentences."""
    for name in dict.fromkeys(case for case, _ in some):
        mine = [change for case, change in some if case == name]
        for k, (change, flight) in enumerate(zip(mine, flown(name, len(mine), seed), strict=True)):
            result, error = judged(name, change, *flight, seed=k)
            if verbose:
                print(
                    f"{name} {change.__name__}: {error:.2f} m", *result.findings[:3], sep="\n    "
                )
            if bool(result.problems) != faulty:
                yield name, change.__name__, result.findings


def main():
    """Print the false alarms and misses."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--flights", type=int, default=60)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    for word, kinds, faulty in (("false alarms", HARMLESS, False), ("misses", FAULTS, True)):
        wrong = list(run(cases(kinds, args.flights), faulty, args.verbose, args.seed))
        print(f"{word}: {len(wrong)} of {args.flights}")
        for name, change, findings in wrong:
            print(f"  {name}, {change}", *findings, sep="\n    ")


if __name__ == "__main__":
    main()
