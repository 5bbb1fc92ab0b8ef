"""Randomizations and distributions that are refused, with what the message says."""

import math

import pytest

import quad_gym
from quad_gym import LogUniform, Normal, Randomization, Uniform
from quad_gym.batch.flight_batch import FlightBatch

SUITE = quad_gym.sensor_suite("lab")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"colour": Uniform(0, 1)}, "'colour' is unknown"),
        ({3: Uniform(0, 1)}, "3 is unknown"),
        ({"mass": 0.8}, "'mass' must be a distribution"),
        ({"mass": None}, "'mass' must be a distribution"),
        ({"inertia": (Uniform(1, 2), Uniform(1, 2))}, "'inertia' must be a distribution or 3"),
        ({"inertia": (Uniform(1, 2), 3.0, None)}, "'inertia' must hold distributions"),
        ({"mass": Uniform(0.0, 1.0)}, "'mass' must stay above 0 kg"),
        ({"mass": Uniform(-0.5, 0.5, relative=True)}, "'mass' must stay above 0"),
        ({"mass": Normal(0.8, 0.1)}, "'mass' must stay above 0"),
        ({"mass": Uniform(0.5, 20.0)}, "able to hover"),
        ({"mass": Uniform(1.0, 20.0, relative=True)}, "able to hover"),
        ({"max_voltage": Uniform(1.0, 12.0)}, "able to hover"),
        ({"rotor_efficiency": Uniform(0.01, 1.0)}, "able to hover"),
        ({"battery_charge": Uniform(0.5, 1.5)}, "'battery_charge' needs a battery"),
        ({"wind_up": Uniform(0.5, 1.5, relative=True)}, "nominal value is 0"),
        ({"wind_speed": Normal(3.0, 1.0)}, "'wind_speed' must stay at least 0"),
        ({"wind_speed": Uniform(0, 1), "wind_east": Uniform(0, 1)}, "not by both"),
        ([("mass", Uniform(0.5, 1.0))], "must be distributions by name"),
    ],
    ids=str,
)  # fmt: skip
def test_a_randomization_that_is_invalid_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        FlightBatch(1, randomization=given)


def test_gnss_that_is_not_there_cannot_be_drawn():
    for name in ("position_sigma_I", "baseline_sigma", "primary_antenna_B", "secondary_antenna_B"):
        with pytest.raises(ValueError, match=f"'{name}' needs GNSS"):
            FlightBatch(1, sensors="indoor", randomization={name: Uniform(0.1, 0.2)})
    FlightBatch(1, sensors="indoor", randomization={"pixel_sigma": Uniform(1.0, 2.0)})


def test_a_camera_that_is_not_there_cannot_be_drawn():
    for name in ("pixel_sigma", "camera_rotation", "camera_position_B", "focal_length"):
        with pytest.raises(ValueError, match=f"'{name}' needs a camera"):
            FlightBatch(
                1, sensors=SUITE.replace(camera=None), randomization={name: Uniform(1.0, 2.0)}
            )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Uniform(2.0, 1.0), "low"),
        (lambda: Uniform("a", 1.0), "low"),
        (lambda: Uniform(0.0, math.inf), "high"),
        (lambda: LogUniform(0.0, 1.0), "low"),
        (lambda: LogUniform(1.0, 2.0, offset=True), "offset"),
        (lambda: Normal(0.0, 0.0), "sigma"),
        (lambda: Normal(0.0, 1.0, low=1.0, high=0.0), "low"),
        (lambda: Normal(0.0, 1.0, low=math.nan), "low"),
        (lambda: Normal(0.0, 1.0, low=20.0), "probability"),
        (lambda: Uniform(1.0, 2.0, relative=True, offset=True), "not both"),
        (lambda: Uniform(1.0, 2.0, relative=1), "relative"),
        (lambda: Randomization({}, known="yes"), "known"),
    ],
)
def test_a_distribution_that_is_invalid_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_what_is_not_drawn_cannot_be_read():
    batch = FlightBatch(1, randomization={"mass": Uniform(0.6, 0.9)})
    with pytest.raises(ValueError, match="one of the drawn mass"):
        batch.record("inertia")
