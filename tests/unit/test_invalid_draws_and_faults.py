"""Invalid draws, distributions and faults, and the messages with which they are refused."""

import math

import pytest

import quad_gym
from quad_gym import LogUniform, Normal, Randomization, Uniform
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.faults import (
    CameraOcclusion,
    Fault,
    GnssJump,
    GnssOutage,
    RotorLoss,
    WrongAssociations,
)
from quad_gym.faults.presets import ALL, PRESETS, faults_of
from quad_gym.records import Aid, FaultKind

SUITE = quad_gym.sensor_suite("lab")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"colour": Uniform(0, 1)}, "'colour' is unknown"),
        ({3: Uniform(0, 1)}, "3 is unknown"),
        ({"masss": Uniform(0, 1)}, "'masss' is unknown.*did you mean mass"),
        ({"mass": 0.8}, "'mass' must be a distribution"),
        ({"mass": None}, "'mass' must be a distribution"),
        ({"inertia": (Uniform(1, 2), Uniform(1, 2))}, "'inertia' must be a distribution or 3"),
        ({"inertia": (Uniform(1, 2), 3.0, None)}, "'inertia' must hold distributions"),
        ({"mass": Uniform(0.0, 1.0)}, "'mass' .* bounds .* got 0: .*mass must be greater than 0"),
        ({"mass": Uniform(-0.5, 0.5, relative=True)}, "'mass' .*mass must be greater than 0"),
        ({"mass": Normal(0.8, 0.1)}, "'mass' .* got -0.03: .*mass must be greater than 0"),
        ({"mass": Uniform(1.0, 20.0, relative=True)}, "'mass' .*light enough to hover"),
        ({"max_voltage": Uniform(1.0, 12.0)}, "'max_voltage' .*light enough to hover"),
        ({"max_voltage": Uniform(4, 12), "mass": Uniform(1, 2)}, "must leave .* able to hover"),
        ({"rotor_efficiency": Uniform(0.01, 1.0)}, "able to hover"),
        ({"battery_charge": Uniform(0.5, 1.5)}, "'battery_charge' needs a battery"),
        ({"wind_up": Uniform(0.5, 1.5, relative=True)}, "nominal value is 0"),
        ({"wind_speed": Normal(3.0, 1.0)}, "'wind_speed' must stay at least 0"),
        ({"wind_speed": Uniform(0, 1), "wind_east": Uniform(0, 1)}, "not by both"),
        ([("mass", Uniform(0.5, 1.0))], "must be distributions by name"),
        ({"position_sigma_I": Uniform(1e-12, 1e-3)}, "'position_sigma_I'.* at least 1e-9 m for"),
        ({"inertia": Uniform(1e-7, 1e-6)}, "'inertia' .* inertia must be at least"),
        ({"inertia": LogUniform(0.03, 1.0, relative=True)}, "'inertia' .* with a mass of 0.78 kg"),
        ({"center_of_mass_B": Uniform(-5.0, 5.0)}, "'center_of_mass_B' .* between the rotors"),
        ({"center_of_mass_B": (Uniform(0.0, 0.21), None, None)}, "between the rotors"),
        ({"gust_wind_speed": Uniform(0.0, 201.0)}, "WorldParams.gust_wind_speed must be at most"),
        ({"wind_up": Uniform(0.0, 201.0)}, "WorldParams.wind_I must be at most 200 m/s"),
    ],
    ids=str,
)  # fmt: skip
def test_a_randomization_that_is_invalid_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        FlightBatch(1, randomization=given)


def test_numbers_of_absent_sensors_cannot_be_drawn():
    gnss = ("position_sigma_I", "baseline_sigma", "primary_antenna_B", "secondary_antenna_B")
    camera = ("pixel_sigma", "camera_rotation", "camera_position_B", "focal_length")
    for suite, names, needed in (("indoor", gnss, "GNSS"), ("consumer", camera, "a camera")):
        for name in names:
            with pytest.raises(ValueError, match=f"'{name}' needs {needed}"):
                FlightBatch(1, sensors=suite, randomization={name: Uniform(0.1, 0.2)})


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


SIGMAS = ("accel_noise_density", "gyro_noise_density", "accel_bias_sigma", "gyro_bias_sigma")
SIGMAS = (*SIGMAS, "position_sigma_I", "baseline_sigma", "pixel_sigma")


@pytest.mark.parametrize("name", SIGMAS)
def test_drawn_standard_deviation_of_zero_is_refused(name):
    with pytest.raises(ValueError, match=rf"randomization of '{name}'.*Params.{name} must be"):
        FlightBatch(1, randomization={name: Uniform(0.0, 0.0)})
    FlightBatch(1, randomization={name: Uniform(1e-6, 1e-6)})


@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        ("primary_antenna_B", "GnssParams.primary_antenna_B"),
        ("secondary_antenna_B", "GnssParams.secondary_antenna_B"),
        ("lever_arm_B", "ImuParams.lever_arm_B"),
        ("camera_position_B", "CameraParams.position_B"),
    ],
)
def test_drawn_place_off_the_vehicle_is_refused(name, parameter):
    for far in (Uniform(0.0, 101.0), (None, Uniform(-1e15, 0.0), None), Normal(0.0, 20.0)):
        with pytest.raises(ValueError, match=rf"{parameter} must be on the vehicle, within 100 m"):
            FlightBatch(1, randomization={name: far})
    FlightBatch(1, randomization={name: Normal(0.0, 1e-4, offset=True)})


def test_antennas_whose_draws_may_come_together_are_refused():
    gnss, near = SUITE.gnss, Uniform(-0.1, 0.1, offset=True)
    there = tuple(Uniform(x, x) for x in gnss.primary_antenna_B)
    for draws in (
        {"secondary_antenna_B": there},
        {"primary_antenna_B": near, "secondary_antenna_B": near},
    ):
        with pytest.raises(ValueError, match=r"secondary_antenna_B.* must be apart"):
            FlightBatch(1, randomization=draws)
    FlightBatch(1, randomization={"primary_antenna_B": near})


LAB, FIELD = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("rtk").simplified()
AIDED = FIELD.replace(
    barometer=quad_gym.BarometerParams(),
    magnetometer=quad_gym.MagnetometerParams(),
    optical_flow=quad_gym.OpticalFlowParams(),
    range_finder=quad_gym.RangeFinderParams(),
)
ONE_FEATURE = LAB.replace(camera=LAB.camera.replace(features_I=((0.0, 0.0, 0.0),)))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: GnssOutage(start=(3.0, 1.0)), r"GnssOutage.start must be \(low, high\)"),
        (lambda: GnssOutage(start=(1.0, 2.0, 3.0)), r"must be a number or \(low, high\)"),
        (lambda: GnssOutage(duration=0.0), "GnssOutage.duration must be greater than 0"),
        (lambda: GnssOutage(start=1.0, rate=0.1), "start or rate, not both"),
        (lambda: GnssOutage(probability=1.5), "GnssOutage.probability must be at most 1"),
        (lambda: GnssJump(direction=(0.0, 0.0, 0.0)), "GnssJump.direction must not be zero"),
        (lambda: WrongAssociations(how="mix"), "WrongAssociations.how must be one of swap, copy"),
        (lambda: RotorLoss(share=1.2), "RotorLoss.share must be at most 1"),
        (lambda: RotorLoss(rotor=4), "RotorLoss.rotor must be 0, 1, 2 or 3"),
        (lambda: Fault(), "of a kind"),
        (lambda: faults_of("gnss_outtage", LAB), "faults must be one of none, gnss_outage"),
        (lambda: faults_of(3, LAB), "faults must be faults or names of presets, got 3"),
        (lambda: faults_of([3], LAB), "faults must be faults or names of presets, got 3"),
        (lambda: faults_of([GnssOutage(), "gnss_outage"], LAB), "one of each kind, got two Gnss"),
        (lambda: faults_of(GnssOutage(), quad_gym.sensor_suite("indoor")), "needs GNSS"),
        (lambda: faults_of(CameraOcclusion(), LAB.replace(camera=None)), "needs a camera"),
        (lambda: faults_of(WrongAssociations(), ONE_FEATURE), "two features"),
    ],
)
def test_invalid_faults_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_fault_presets_are_found_by_name():
    assert faults_of(None, LAB) == faults_of("none", LAB) == faults_of((), LAB) == ()
    kinds = {fault.kind for preset in PRESETS.values() for fault in preset}
    assert kinds <= set(FaultKind)  # some faults have no name
    named = faults_of("rotor_loss+gnss_outage", LAB)
    assert [type(fault) for fault in named] == [GnssOutage, RotorLoss]
    assert named == faults_of(["rotor_loss", PRESETS["gnss_outage"][0]], LAB)
    assert len(faults_of(ALL, AIDED)) == len(kinds)
    assert len(faults_of(ALL, FIELD)) == len(kinds) - len(Aid)
    for suite in ("consumer", "indoor"):
        assert 0 < len(faults_of(ALL, quad_gym.sensor_suite(suite))) < len(FaultKind)
