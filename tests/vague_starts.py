"""Suites with the largest initial uncertainty that is allowed, or more."""

import math

import quad_gym
from quad_gym import Uniform
from quad_gym.batch.starts import (
    MAX_BASELINE_SIGMA,
    MAX_HEADING_SIGMA,
    MAX_HEADING_SIGMA_INDOORS,
    MAX_POSITION_SIGMA,
    MAX_START_TILT,
)
from tests.field_flights import fly, nees, steps

KINDS = ("ukf", "ekf")
BAND = (14.0, 17.0)
"""Band of the mean NEES of 15 states of a consistent filter."""


def one_antenna(suite, **changes):
    return suite.replace(gnss=suite.gnss.replace(secondary_antenna_B=None), **changes)


def with_baseline(name, sigma, **changes):
    suite = quad_gym.sensor_suite(name)
    return suite.replace(gnss=suite.gnss.replace(baseline_sigma=sigma), **changes)


def with_mark(name, **sigmas):
    suite = quad_gym.sensor_suite(name)
    return suite.replace(initial_pose=suite.initial_pose.replace(**sigmas))


def with_iron(name, heading_sigma):
    """A suite with hard iron that turns the heading by `heading_sigma`."""
    field = quad_gym.sensor_suite("consumer").magnetometer
    iron = heading_sigma * math.hypot(*field.field_I[:2])
    return one_antenna(
        quad_gym.sensor_suite(name), magnetometer=field.replace(hard_iron_sigma=iron)
    )


def vague_suites(scale=1.0):
    """Suites by the uncertain quantity, with a sigma of `scale` times its bound."""
    baseline, mark = scale * MAX_BASELINE_SIGMA, scale * MAX_HEADING_SIGMA
    indoors = scale * MAX_HEADING_SIGMA_INDOORS
    suites = {}
    for name in ("standard", "rtk"):
        suites[f"baseline, {name}"] = with_baseline(name, baseline)
        suites[f"baseline, {name} without camera"] = with_baseline(name, baseline, camera=None)
        suites[f"heading, {name}"] = one_antenna(with_mark(name, heading_sigma=mark))
    for name in ("standard", "rtk", "consumer"):
        suites[f"hard iron, {name}"] = with_iron(name, mark)
    suites["heading, indoor"] = with_mark("indoor", heading_sigma=indoors)
    position = scale * MAX_POSITION_SIGMA
    suites["position, indoor"] = with_mark("indoor", position_sigma=position)
    both = with_mark("indoor", heading_sigma=indoors, position_sigma=position)
    suites["heading and position, indoor"] = both
    return suites


def largest_tilt(name):
    """Draws of roll and pitch up to the largest that a cold filter of a suite accepts."""
    most = 0.999 * math.sqrt(3.0) * MAX_START_TILT
    if name == "consumer":
        most /= math.tan(quad_gym.sensor_suite(name).magnetometer.inclination)
    return {tilt: Uniform(-most, most) for tilt in ("start_roll", "start_pitch")}


def of_kind(suite, kind):
    return suite.replace(estimator=suite.estimator.replace(kind=kind))


def mean_nees(suite, times, count=256, **keywords):
    """The mean NEES of flights along random trajectories, at some times after their start."""
    batch, found = fly(suite, count, **keywords), []
    for since, time in zip((0.0, *times), times, strict=False):
        steps(batch, time - since)
        found.append(float(nees(batch).mean()))
    return found
