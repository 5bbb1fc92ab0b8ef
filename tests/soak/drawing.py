"""Random suites, faults and configurations of environments, which cases of several kinds fly.

Not every combination has a meaning: environments refuse the others by name.
"""

import math

import numpy as np

import quad_gym
from quad_gym import LogUniform, Normal, Randomization, Uniform
from quad_gym.envs.config import BENCHMARKS, with_effect
from quad_gym.faults import PRESETS, MagnetometerDisturbance, possible
from quad_gym.params.suites import ALL_SUITES
from tests.contract.comparing import ACTIONS, LAYOUTS, OBSERVATIONS
from tests.contract.configurations import DRAWS, FEATURES, GROUND, OBSTACLES, PATHS
from tests.estimators import Certain, Simple
from tests.tasks.tasks import Chase, Near

MODES = ("NextStep", "SameStep", "Disabled")
FAULTS = (
    *(fault for preset in PRESETS.values() for fault in preset),
    MagnetometerDisturbance(how="iron"),
    MagnetometerDisturbance(how="frozen"),
)
WORLDS = ("calm", "breeze", "fresh_breeze", "slalom", GROUND, OBSTACLES)
_RELATIVE = {
    "thrust_coefficient": Uniform(0.9, 1.1, relative=True),
    "torque_coefficient": Uniform(0.8, 1.2, relative=True),
    "max_voltage": Uniform(0.9, 1.1, relative=True),
    "gyro_noise_density": LogUniform(0.3, 10.0, relative=True),
    "accel_bias_sigma": LogUniform(0.3, 10.0, relative=True),
    "gyro_bias_tau": LogUniform(0.1, 10.0, relative=True),
    "lever_arm_B": Normal(0.0, 0.01, offset=True),
    "pixel_sigma": LogUniform(0.5, 3.0, relative=True),
    "focal_length": Uniform(0.99, 1.01, relative=True),
    "start_position_I": Uniform(-0.4, 0.4),
    "start_body_rates": Normal(0.0, 1.0),
    "start_roll": Uniform(-0.3, 0.3),
    "start_yaw": Uniform(-math.pi, math.pi),
    "action_delay": Uniform(0.0, 3.0),
}
DISTRIBUTIONS = DRAWS | FEATURES | _RELATIVE


def pick(rng, choices):
    """One of some choices."""
    return choices[int(rng.integers(len(choices)))]


def chance(rng, share):
    """True with a probability."""
    return bool(rng.random() < share)


def log_uniform(rng, low, high):
    """A number between two positive ones, uniform in its logarithm."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def suite(rng):
    """A built-in suite, in half of all cases with another filter, other rates and latencies."""
    found = quad_gym.sensor_suite(pick(rng, ALL_SUITES))
    if chance(rng, 0.5):
        return found
    filtered = found.estimator.replace(
        kind=pick(rng, ("ukf", "ekf")),
        false_alarm_probability=pick(rng, (0.0, 1e-4, 0.01)),
        delay_compensation=pick(rng, ("retrodict", "none")),
        max_rejections=int(rng.integers(1, 8)),
        reset_timeout=log_uniform(rng, 0.1, 5.0),
    )
    changed = {"estimator": filtered}
    for name, sensor in found.sensors.items():
        rate = pick(rng, [rate for rate in (5.0, 10.0, 20.0, 25.0, 50.0) if rate <= sensor.rate])
        ticks = int(rng.integers(0, 1 + 2 * round(found.imu.rate / rate)))
        latency = ticks / found.imu.rate if chance(rng, 0.5) else 0.0
        changed[name] = sensor.replace(rate=rate, latency=latency)
    return found.replace(**changed)


def _scaled(rng, value):
    """A size of a fault, or its range, times a factor of at most 30."""
    factor = log_uniform(rng, 0.1, 30.0)
    return tuple(factor * end for end in value) if isinstance(value, tuple) else factor * value


def fault(rng, given):
    """A fault with other times, probability and sizes."""
    changed = {"probability": pick(rng, (1.0, 0.5))}
    if chance(rng, 0.5):
        changed |= {"start": 0.0, "rate": log_uniform(rng, 0.2, 10.0)}
        changed["duration"] = tuple(sorted(rng.uniform(0.01, 1.0, 2).tolist()))
    else:
        changed["start"] = tuple(sorted(rng.uniform(0.0, 1.0, 2).tolist()))
        changed["duration"] = pick(rng, (math.inf, float(rng.uniform(0.01, 1.0))))
    for name in ("size", "speed", "iron", "accel_range", "gyro_range"):
        if hasattr(given, name):
            changed[name] = _scaled(rng, getattr(given, name))
    if hasattr(given, "share"):
        low, high = sorted(rng.uniform(0.0, 1.0, 2).tolist())
        changed["share"] = (low, high) if isinstance(given.share, tuple) else high
    if hasattr(given, "direction") and getattr(given, "how", "iron") == "iron" and chance(rng, 0.3):
        changed["direction"] = tuple(rng.normal(size=3).tolist())
    return given.replace(**changed)


def faults(rng, sensors, most=4):
    """Some faults that a suite can have, or a preset; at least one."""
    fitting = [given for given in FAULTS if possible(given, sensors)]
    if chance(rng, 0.3):
        return pick(rng, ["all", *(name for name in PRESETS if possible(name, sensors))])
    chosen = {}
    for _ in range(int(rng.integers(1, most + 1))):
        given = pick(rng, fitting)
        chosen[given.kind] = fault(rng, given)
    return tuple(chosen.values())


def _sensing(rng):
    found = {"observation": pick(rng, OBSERVATIONS)}
    if found["observation"] != "measurements":
        found["layout"] = pick(rng, LAYOUTS)
    for name, share in (
        ("include_std", 0.3),
        ("privileged", 0.3),
        ("reward_terms", 0.2),
        ("innovations", 0.2),
    ):
        if chance(rng, share):
            found[name] = True
    if found["observation"] in ("truth", "noisy") and chance(rng, 0.3):
        found["run_filter"] = True
    if chance(rng, 0.15):
        found["camera"] = False
    return found


def _acting(rng):
    found = {"action": pick(rng, ACTIONS)}
    if chance(rng, 0.3):
        found["control_rate"] = pick(rng, (10.0, 25.0, 50.0, 100.0, 200.0))
    if chance(rng, 0.2):
        found["action_delay"] = float(rng.uniform(0.0, 3.0))
    if chance(rng, 0.15):
        found["vehicle"] = "crazyflie"
    if chance(rng, 0.1):
        found["substeps"] = int(rng.integers(1, 4))
    return found


def _episodes(rng, base):
    found = {}
    if chance(rng, 0.5):
        found["start"] = pick(rng, ("ground", "hover", "mixed", "moving"))
    if chance(rng, 0.2) and base not in ("hover", "waypoints", "stale_race", "outage_dash"):
        found["randomize_reference"] = True
    if base == "trajectory":
        found["trajectory"] = pick(rng, (PATHS, *([path] for path in PATHS)))
    if chance(rng, 0.8):
        found["max_episode_steps"] = int(rng.integers(1, 60))
    if chance(rng, 0.5):
        found["max_tilt"] = float(rng.uniform(0.3, 2.0))
    if chance(rng, 0.2):
        found["truncate_when_diverged"] = True
    return found


def _conditions(rng, sensors):
    found = {}
    if chance(rng, 0.4):
        found["faults"] = faults(rng, sensors)
    if chance(rng, 0.4):
        found["world"] = pick(rng, WORLDS)
    if chance(rng, 0.4):
        names = rng.permutation(sorted(DISTRIBUTIONS))[: int(rng.integers(1, 6))].tolist()
        drawn = {name: DISTRIBUTIONS[name] for name in names if _can_draw(name, sensors, found)}
        found["randomization"] = Randomization(drawn, known=chance(rng, 0.3))
    return found


def _can_draw(name, sensors, found):
    """True if a parameter exists that is drawn."""
    of_camera = ("pixel", "camera", "focal", "feature")
    if name.startswith(of_camera):
        return sensors.camera is not None
    if name.startswith(("position_sigma", "primary_antenna")):
        return sensors.gnss is not None
    return name != "battery_charge" or found.get("world") in ("breeze", "fresh_breeze")


def configuration(rng):
    """Base and keywords of an environment."""
    base = pick(rng, sorted(quad_gym.IDS.values()))
    sensors = suite(rng)
    found = _sensing(rng) | _acting(rng) | _episodes(rng, base)
    if base not in BENCHMARKS or chance(rng, 0.3):
        found["sensors"] = sensors
    else:
        sensors = quad_gym.sensor_suite(BENCHMARKS[base].keywords["sensors"])
    found |= _conditions(rng, sensors)
    if chance(rng, 0.3):
        own = Certain if "include_std" in found else Simple()
        found["estimator"] = pick(rng, ("ukf", "ekf", "ekf", own, Certain))
    if chance(rng, 0.2):
        found["filter_start"] = "warm"
    if chance(rng, 0.15):
        found |= _own_task(rng, found, sensors)
    return base, with_effect(found)


def _own_task(rng, found, sensors):
    """A task that can fly with these options, if there is one: `Near` observes a feature."""
    seen = sensors.camera is not None and found.get("camera", True)
    free = found.get("world") not in ("slalom", OBSTACLES)
    fitting = [*([Near()] if seen else []), *([Chase()] if free else [])]
    return {"task": pick(rng, fitting)} if fitting else {}


def actions(rng, steps, count):
    """Random actions (steps, count, 4): white, held, extreme, leaning and gentle ones by flight."""
    noise = rng.uniform(-1.0, 1.0, (steps, count, 4))
    held = np.repeat(noise[::10], 10, axis=0)[:steps]
    leaning = np.clip(0.6 * noise + rng.uniform(-0.5, 0.5, (count, 4)), -1.0, 1.0)
    styles = rng.integers(0, 5, (1, count, 1))
    chosen = np.choose(styles, [noise, held, np.sign(noise), leaning, 0.1 * noise])
    return chosen.astype(np.float32)
