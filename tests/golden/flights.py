"""The golden flights and their digests.

python -m tests.golden.flights            # compare with the digests in flights.json
python -m tests.golden.flights late ekf   # compare these cases
python -m tests.golden.flights --renew    # renew the digests

Flights in single precision have their own digests: `QUAD_GYM_PRECISION=single` chooses them.
"""

import argparse
import hashlib
import json
from pathlib import Path

import gymnasium
import numpy as np

import quad_gym
from quad_gym import Uniform
from quad_gym.faults import PRESETS
from quad_gym.params.sensor_table import AID_PARAMS
from quad_gym.params.suites import ALL_SUITES, SUITES
from quad_gym.records import COLUMNS, SINGLE

DIGESTS = Path(__file__).with_name("flights_single.json" if SINGLE else "flights.json")
FLIGHTS, STEPS, SEED = 8, 300, 2026
FIRST = COLUMNS["action_delay"].stop
STATES = (
    "r",
    "v",
    "q",
    "w",
    "rotor_speeds",
    "b_a",
    "b_g",
    "r_hat",
    "v_hat",
    "R_hat",
    "b_a_hat",
    "b_g_hat",
    "P",
    "filter_status",
    "faults",
    "drawn",
)
RANDOMIZATION = {
    "mass": Uniform(0.8, 1.2, relative=True),
    "center_of_mass_B": Uniform(-0.01, 0.01),
    "wind_speed": Uniform(0.0, 3.0),
    "pixel_sigma": Uniform(0.8, 1.5, relative=True),
    "start_yaw": Uniform(-0.3, 0.3),
}


AIDED = quad_gym.sensor_suite("rtk").replace(
    barometer=quad_gym.BarometerParams(latency=0.04),
    magnetometer=quad_gym.MagnetometerParams(soft_iron_sigma=0.01),
)


def _late(suite, gnss=0.1, camera=0.06):
    suite = quad_gym.sensor_suite(suite)
    late = suite.gnss.replace(latency=gnss)
    return suite.replace(gnss=late, camera=suite.camera.replace(latency=camera))


def _early(fault):
    """Return the faults of a preset, with start times before flights end in a crash."""
    return [
        single if single.start is None else single.replace(start=0.2) for single in PRESETS[fault]
    ]


def trajectories():
    """Return two trajectories with exact coefficients: a loop, and a path from rest to rest."""
    s3 = np.poly1d([1, 0, 0, 0])
    hump = s3 * np.poly1d([-1, 1]) ** 3  # s^3 (1 - s)^3
    rise = s3 * np.poly1d([-20, 70, -84, 35, 0])
    found = []
    for polynomials, options in (
        (
            (192 * hump, 256 * hump * np.poly1d([-2, 1]), 1.5 + 16 * hump, 0 * hump),
            {"closed": True},
        ),
        ((-3 * rise, 2 * rise, 1 + rise, 0 * rise), {"heading": "along"}),
    ):
        terms = np.zeros((8, 1, 4))
        for i, polynomial in enumerate(polynomials):
            shares = polynomial.c / 8.0 ** np.arange(polynomial.order, -1, -1)
            terms[8 - len(shares) :, 0, i] = shares
        options = {"heading": "toward", "point": (1.0, 5.0), **options}
        found.append(quad_gym.Trajectory(times=[0.0, 8.0], coefficients=terms, **options))
    return found


def cases():
    """Return the keywords of the environments, by name of the case."""
    return _families() | _single_cases()


def _families():
    """Return a case for each task, suite, observation, action and fault."""
    found = {}
    for task in ("Hover", "Circle", "Lemniscate", "RandomTrajectory", "Waypoints"):
        for suite in SUITES:
            found[f"{task}, {suite}"] = {"id": task, "sensors": suite, "randomize_reference": True}
    found["Circle, mixed"] = {"start": "mixed"}
    found["Hover, moving"] = {"id": "Hover", "start": "moving"}
    for observation in ("truth", "noisy", "measurements"):
        found[f"observation {observation}"] = {"observation": observation}
    for suite in SUITES:
        found[f"observation truth, {suite}"] = {
            "observation": "truth",
            "sensors": suite,
            "randomize_reference": True,
            "faults": ["rotor_loss"],
            "world": "fresh_breeze",
            "action_delay": 0.5,
        }
    for action in ("motor", "wrench", "attitude", "velocity"):
        found[f"action {action}"] = {"action": action}
    for fault in PRESETS:
        suite = "indoor" if "camera" in fault else "rtk"
        sensor = fault.removesuffix("_loss")
        suite = AIDED if getattr(AIDED, sensor, None) else suite
        suite = "consumer" if fault == "magnetometer_disturbance" else suite
        if sensor in AID_PARAMS and suite == "rtk":
            having = [name for name in ALL_SUITES if getattr(quad_gym.sensor_suite(name), sensor)]
            own = quad_gym.sensor_suite("uwb").replace(**{sensor: AID_PARAMS[sensor]()})
            suite = having[0] if having else own
        found[f"fault {fault}"] = {"sensors": suite, "faults": _early(fault), "start": "hover"}
    for task in ("LookAround", "StaleRace", "OutageDash"):
        found[task] = {"id": task}
        found[f"{task}, truth"] = {"id": task, "observation": "truth"}
    return found


def _single_cases():
    rtk = {"sensors": "rtk", "start": "hover"}
    return {
        "late": {"sensors": _late("rtk"), "start": "hover"},
        "late, not gated": {"sensors": _late("lab", 0.005, 0.005)},
        "barometer and magnetometer": {"sensors": AIDED, "innovations": True},
        "barometer alone, warm": {
            "sensors": quad_gym.sensor_suite("indoor").replace(
                barometer=quad_gym.BarometerParams()
            ),
            "filter_start": "warm",
        },
        "magnetometer, ekf, raw": {
            "sensors": quad_gym.sensor_suite("lab").replace(
                magnetometer=quad_gym.MagnetometerParams(latency=0.01)
            ),
            "estimator": "ekf",
            "observation": "measurements",
        },
        "crazyflie": {"sensors": "crazyflie", "vehicle": "crazyflie", "innovations": True},
        "crazyflie, late, ekf, warm, raw": {
            "sensors": quad_gym.sensor_suite("crazyflie").replace(
                optical_flow=quad_gym.OpticalFlowParams(latency=0.01),
                range_finder=quad_gym.RangeFinderParams(latency=0.04),
            ),
            "estimator": "ekf",
            "filter_start": "warm",
            "observation": "measurements",
        },
        "uwb": {"sensors": "uwb", "vehicle": "crazyflie", "innovations": True},
        "uwb, late, ekf, warm, raw": {
            "sensors": quad_gym.sensor_suite("uwb").replace(
                uwb_range=quad_gym.UwbRangeParams(tag_B=(0.02, 0.0, 0.01), latency=0.04)
            ),
            "estimator": "ekf",
            "filter_start": "warm",
            "observation": "measurements",
        },
        "ekf": {"estimator": "ekf", "sensors": "rtk"},
        "innovations": rtk | {"innovations": True},
        "warm": rtk | {"filter_start": "warm"},
        "breeze": rtk | {"world": "fresh_breeze"},
        "obstacles": {
            "sensors": "indoor",
            "world": quad_gym.WorldParams(
                obstacles=(
                    quad_gym.Wall(center_I=(6.0, 0.0, 1.0), shift_I=(0.5, 0.5, 0.0), yaw=0.4),
                    quad_gym.Wall(center_I=(0.0, 2.0, 1.0), shift_I=(0.5, 0.0, 0.0), follows=0),
                    quad_gym.Cylinder(center_I=(2.0, -1.0, 1.0)),
                ),
                geofence=((-6.0, -6.0, -1.0), (6.0, 6.0, 3.0)),
            ),
        },
        "features drawn": {
            "sensors": "indoor",
            "randomization": {
                "features_yaw": Uniform(-3.0, 3.0),
                "features_shift_I": Uniform(-0.5, 0.5),
                "feature_offsets_I": (None, None, Uniform(-0.2, 0.2)),
            },
        },
        "ground": {
            "sensors": "rtk",
            "world": quad_gym.WorldParams(ground=quad_gym.GroundParams(), wind_I=(2.0, 0.0, 0.0)),
        },
        "battery": rtk | {"world": quad_gym.WorldParams(battery=quad_gym.BatteryParams())},
        "randomization": rtk | {"randomization": RANDOMIZATION},
        "randomization known": rtk
        | {"randomization": quad_gym.Randomization(RANDOMIZATION, known=True)},
        "privileged": rtk | {"privileged": True, "include_std": True},
        "absolute": rtk | {"layout": "absolute"},
        "trajectories": {
            "id": "Trajectory",
            "trajectory": trajectories(),
            "randomize_reference": True,
            "sensors": "rtk",
            "layout": "absolute",
            "start": "mixed",
        },
        "many options": {
            "sensors": _late("rtk"),
            "world": "fresh_breeze",
            "randomization": RANDOMIZATION,
            "faults": [*_early("gnss_outage"), "wrong_associations"],
            "innovations": True,
        },
    }


def made(case, flights=FLIGHTS, threads=None):
    """Return the environment of a case."""
    keywords = dict(case)
    task = keywords.pop("id", "Circle")
    name = f"QuadGym/{task}-v0"
    if task == "Circle":  # most cases take off; the default start is a separate case
        keywords.setdefault("start", "ground")
    return gymnasium.make_vec(name, num_envs=flights, threads=threads, **keywords)


def fly(case, flights=FLIGHTS, threads=None):
    """Return the digest of a case's first FLIGHTS flights; it must not depend on the others."""
    env = made(case, flights, threads)
    digest = hashlib.sha256()
    observations, _ = env.reset(seed=SEED)
    rng, batch = np.random.default_rng(SEED), env.unwrapped.flights.batch
    for step in range(STEPS):
        actions = np.resize(rng.uniform(-0.1, 0.1, (FLIGHTS, 4)), (flights, 4))
        observations, rewards, *_ = env.step(actions)
        if step % 30 == 29:
            parts = observations.values() if isinstance(observations, dict) else (observations,)
            # only the oldest columns of "drawn"
            states = [
                batch.record(name)[:, :FIRST] if name == "drawn" else batch.record(name)
                for name in STATES
            ]
            for part in (*parts, rewards, *states):
                digest.update(np.ascontiguousarray(part[:FLIGHTS]).tobytes())
    env.close()
    return digest.hexdigest()[:16]


def differing(names):
    """Return those of some cases whose flights differ from the golden flights."""
    golden, known = json.loads(DIGESTS.read_text()), cases()
    return [name for name in names if fly(known[name]) != golden.get(name)]


def main():
    parser = argparse.ArgumentParser(description="Compare flights with the golden ones.")
    parser.add_argument("--renew", action="store_true", help="renew the digests instead")
    parser.add_argument("cases", nargs="*", help="compare only these")
    args = parser.parse_args()
    names = args.cases or list(cases())
    if unknown := set(names) - cases().keys():
        parser.error(f"unknown cases: {', '.join(sorted(unknown))}")
    if args.renew:
        digests = {name: fly(case) for name, case in cases().items()}
        DIGESTS.write_text(json.dumps(digests, indent=1) + "\n")
    elif changed := differing(names):
        raise SystemExit(f"these flights have changed, or have no digest: {', '.join(changed)}")
    else:
        print(f"{len(names)} golden flights are as they were")


if __name__ == "__main__":
    main()
