"""Input that is refused, by interface: calls, and the message of the error, which names the input.

Fields of parameters are in `tests/unit/test_limits.py`, command lines in `test_refusals.py`.
"""

from functools import partial

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym import (
    FlightBatch,
    LogUniform,
    Normal,
    QuadEnv,
    Randomization,
    TaskParams,
    Uniform,
    UnscentedKalmanFilter,
)
from quad_gym.configuration import FlightConfiguration
from quad_gym.faults import (
    CameraOcclusion,
    Fault,
    GnssJump,
    GnssOutage,
    PositionJump,
    RotorLoss,
    WrongAssociations,
    faults_of,
)
from quad_gym.records import Control, Source
from tests.builders import MAKERS, single_env

LAB, RTK = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("rtk").simplified()
SCALES = quad_gym.ActionParams()
AVERAGED = LAB.replace(imu=LAB.imu.replace(samples="average"))
ONE_FEATURE = LAB.replace(camera=LAB.camera.replace(features_I=((0.0, 0.0, 0.0),)))
NEAR = Uniform(-0.1, 0.1, offset=True)
TURNED = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]

NONSENSE = [
    {"frameskip": 1},
    {"world": "storm"},
    {"world": {"wind_I": (1.0, 0.0, 0.0)}},
    {"faults": "storm"},
    {"faults": 3.0},
    {"faults": GnssOutage(), "sensors": "indoor"},
    {"randomization": {"colour": Uniform(0.0, 1.0)}},
    {"randomization": {"mass": Uniform(1.0, 30.0)}},
    {"observations": "truth"},
    {"observation": "camera"},
    {"action": "rates"},
    {"layout": "flat"},
    {"sensors": "phone"},
    {"vehicle": "balloon"},
    {"action_params": "fast"},
    {"include_std": "yes"},
    {"privileged": 1},
    {"camera": None},
    {"control_rate": 30},
    {"control_rate": 400},
    {"substeps": 0},
    {"randomize_reference": "yes"},
    {"true_vehicle": "lab"},
    {"true_sensors": 1},
    {"render_mode": "sketch"},
]
"""Keywords that every interface refuses by the name of the first one."""


@pytest.mark.parametrize("keywords", NONSENSE, ids=repr)
@pytest.mark.parametrize("maker", MAKERS)
def test_keywords_that_make_no_sense_are_refused_by_name(maker, keywords):
    if maker != "make_sb3_vec_env" and "render_mode" in keywords:
        pytest.skip("Gymnasium itself handles this keyword")
    with pytest.raises(ValueError, match=next(iter(keywords))) as error:
        MAKERS[maker](**keywords)
    if "frameskip" in keywords:  # the error that TorchRL expects
        assert isinstance(error.value, TypeError)
        assert "unexpected keyword argument" in str(error.value)


NO_SENSORS = r"faults has no effect on sensors \(GnssOutage\) where no filter runs"
MISPLACED = [
    ({"contrl_rate": 1}, "contrl_rate is not a keyword .* did you mean control_rate?"),
    ({"gate_count": 3}, r"gate_count has no effect .* \(only on waypoints\)"),
    ({"camera": True, "sensors": "consumer"}, "camera must not be True"),
    ({"observation": "truth", "faults": "gnss_outage"}, NO_SENSORS),
    ({"observation": "noisy", "faults": "gnss_outage"}, NO_SENSORS),
    ({"observation": "truth", "faults": (RotorLoss(), GnssOutage())}, NO_SENSORS),
    ({"observation": "noisy", "faults": (RotorLoss(), GnssOutage())}, NO_SENSORS),
]
PLACED = [
    {"camera": False, "sensors": "consumer"},
    {"camera": True, "sensors": "rtk"},
    {"observation": "truth", "faults": (RotorLoss(), PositionJump())},
    {"observation": "noisy", "faults": "gnss_outage", "innovations": True},
    {"observation": "measurements", "faults": "gnss_outage"},
]


@pytest.mark.parametrize("maker", MAKERS)
def test_keywords_that_cannot_be_combined_are_refused_in_every_interface(maker):
    for keywords, message in MISPLACED:
        with pytest.raises(ValueError, match=message):
            MAKERS[maker](**keywords)
    for keywords in PLACED:
        MAKERS[maker](**keywords)


HOVER = [
    ({"observation": "measurements", "layout": "relative"}, "^layout has no effect"),
    ({"observation": "measurements", "layout": "absolute"}, "^layout has no effect"),
    ({"observation": "truth", "estimator": "ekf"}, "^estimator has no effect"),
    ({"observation": "truth", "filter_start": "cold"}, "^filter_start has no effect"),
    ({"observation": "noisy", "filter_start": "warm"}, "^filter_start has no effect"),
    (
        {"observation": "truth", "truncate_when_diverged": True},
        "^truncate_when_diverged has no effect",
    ),
    ({"observation": "truth", "faults": "gnss_outage"}, NO_SENSORS),
    ({"action": "motor", "action_params": SCALES}, "^action_params has no effect"),
    ({"action": "wrench", "action_params": SCALES}, "^action_params has no effect"),
    ({"render_size": (64, 64)}, "^render_size needs"),
    ({"gate_count": 3}, "^gate_count has no effect"),
    ({"threads": 2}, "threads is not a keyword of a single environment"),
    ({"duration": 0.001}, "duration must be 0"),
    ({"duration": 0.0099}, "duration must be 0"),
    ({"base": "hover"}, "choose the id of hover"),
    ({"sensors": AVERAGED}, "integration='midpoint'"),
]
"""Keywords of a hovering environment, some without effect."""
BATCHES = [
    ({"gains": "tuned", "control": Control.CTBR}, "gains has no effect with Control.CTBR"),
    ({"action_params": SCALES}, "action_params has no effect with Control.PD"),
    (
        {"source": Source.TRUTH, "filter_start": "warm"},
        "filter_start has no effect where no filter runs",
    ),
    (
        {"run_filter": False, "innovations": True},
        "run_filter must not be False where .* innovations need",
    ),
    (
        {"run_filter": False, "include_std": True},
        "run_filter must not be False where .* include_std",
    ),
    ({"task": TaskParams(duration=0.001)}, "duration must be 0"),
    ({"sensors": AVERAGED}, "integration='midpoint'"),
    ({"threads": 1025}, "threads must be at most 1024"),
]
TRUE_SENSORS = [
    ("gnss", {"rate": 5.0}, r"GNSS rate \[Hz\] of sensors, 10\.0, got 5\.0"),
    ("gnss", {"velocity_sigma": None}, "number of gnss_velocity measurements"),
    ("gnss", {"phase": 0.5}, "GNSS phase of sensors, None, got 0.5"),
    ("camera", {"rate": 50.0}, r"camera rate \[Hz\] of sensors, 25\.0, got 50\.0"),
    ("camera", {"phase": 0.0}, "camera phase of sensors, None, got 0.0"),
    (
        "camera",
        {"features_I": ((1.0, 2.0, 0.0),)},
        "number of feature measurements of sensors, 12, got 1",
    ),
    ("imu", {"rate": 400.0}, "IMU rate"),
    ("imu", {"samples": "instant"}, "IMU samples"),
]
DRAWS = [
    ({"colour": Uniform(0, 1)}, "'colour' is unknown"),
    ({3: Uniform(0, 1)}, "3 is unknown"),
    ({"masss": Uniform(0, 1)}, "'masss' is unknown.*did you mean mass"),
    ({"mass": 0.8}, "'mass' must be a distribution"),
    ({"mass": None}, "'mass' must be a distribution"),
    ({"inertia": (Uniform(1, 2), Uniform(1, 2))}, "'inertia' must be a distribution or 3"),
    ({"inertia": (Uniform(1, 2), 3.0, None)}, "'inertia' must be distributions"),
    ({"inertia": [Uniform(1e-3, 2e-3)] * 2 + [Uniform(4.1e-3, 5e-3)]}, "of 'inertia'"),
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
    (
        {"secondary_antenna_B": tuple(Uniform(x, x) for x in LAB.gnss.primary_antenna_B)},
        "secondary_antenna_B.* must be apart",
    ),
    ({"primary_antenna_B": NEAR, "secondary_antenna_B": NEAR}, "antenna_B.* must be apart"),
    *(
        ({name: Uniform(0.0, 0.0)}, f"randomization of '{name}'.*Params.{name} must be")
        for name in (
            "accel_noise_density",
            "gyro_noise_density",
            "accel_bias_sigma",
            "gyro_bias_sigma",
            "position_sigma_I",
            "baseline_sigma",
            "pixel_sigma",
        )
    ),
    *(
        ({name: far}, f"{field} must be on the vehicle, within 100 m")
        for name, field in (
            ("primary_antenna_B", "GnssParams.primary_antenna_B"),
            ("secondary_antenna_B", "GnssParams.secondary_antenna_B"),
            ("lever_arm_B", "ImuParams.lever_arm_B"),
            ("camera_position_B", "CameraParams.position_B"),
        )
        for far in (Uniform(0.0, 101.0), (None, Uniform(-1e15, 0.0), None), Normal(0.0, 20.0))
    ),
]
ABSENT = [
    (suite, name, needed)
    for suite, needed, names in (
        ("indoor", "GNSS", "position_sigma_I baseline_sigma primary_antenna_B secondary_antenna_B"),
        ("consumer", "a camera", "pixel_sigma camera_rotation camera_position_B focal_length"),
    )
    for name in names.split()
]
OTHERS = [
    # ---- distributions
    (lambda: Uniform(2.0, 1.0), "low"),
    (lambda: Normal(0.0, 1.0, low=1.0, high=0.0), "low"),
    (lambda: Uniform(1.0, 2.0, relative=True, offset=True), "not both"),
    (lambda: Randomization({}, known="yes"), "known"),
    # ---- faults
    (lambda: GnssOutage(start=1.0, rate=0.1), "start or rate, not both"),
    (lambda: GnssJump(direction=(0.0, 0.0, 0.0)), "GnssJump.direction must not be zero"),
    (lambda: Fault(), "of a kind"),
    (lambda: faults_of("gnss_outtage", LAB), "faults must be one of none, gnss_outage"),
    (lambda: faults_of(3, LAB), "faults must be faults or names of presets, got 3"),
    (lambda: faults_of([3], LAB), "faults must be faults or names of presets, got 3"),
    (lambda: faults_of([GnssOutage(), "gnss_outage"], LAB), "one of each kind, got two Gnss"),
    (lambda: faults_of(GnssOutage(), quad_gym.sensor_suite("indoor")), "needs GNSS"),
    (lambda: faults_of(CameraOcclusion(), LAB.replace(camera=None)), "needs a camera"),
    (lambda: faults_of(WrongAssociations(), ONE_FEATURE), "two features"),
    # ---- names and ids
    (lambda: quad_gym.WorldParams(wnd=1.0), "wnd is not a keyword of WorldParams.*wind_I"),
    (lambda: quad_gym.SensorSuite().replace(gns=None), "gns is not a keyword.*gnss"),
    (lambda: Uniform(0.0, heigh=1.0), "heigh is not a keyword of Uniform.*high"),
    (lambda: GnssOutage(begin=1.0), "begin is not a keyword of GnssOutage"),
    (lambda: quad_gym.register_task("A/B-v0", "a:B", obsevation=1), "mean observation"),
    (lambda: gymnasium.make("QuadGym/Circle-v0", task="hover"), "quad_gym.Task.* id of hover"),
    (lambda: QuadEnv("hovr"), r"task must be one of .*did you mean hover"),
    (lambda: QuadEnv(base="hovr"), r"base must be one of .*did you mean hover"),
    (lambda: MAKERS["make_sb3_vec_env"](num_envs=2), "num_envs is n_envs here"),
    *(
        (partial(quad_gym.make_sb3_vec_env, env_id), "env_id")
        for env_id in ("QuadGym/Square-v0", "QuadGym/Circle-v1", "Circle", "")
    ),
    *(
        (partial(MAKERS["make_vec"], autoreset_mode=mode), "autoreset_mode must be one of NextStep")
        for mode in ("Sometimes", None, 1, "same", "NEXT_STEP")
    ),
    (partial(QuadEnv, estimator=quad_gym.Estimator), "estimator must define update"),
    (partial(TaskParams, kind="hover", gate_count=3), "gate_count has no effect on the task hover"),
    (partial(TaskParams, start="hover", pad=False), 'pad has no effect with start="hover"'),
    (partial(QuadEnv, "hover", min_height=1.01), "min_height must be at most 1 m"),
    (partial(QuadEnv, start="ground", min_height=0.01), "min_height must be at most 0 m"),
    # ---- others
    (
        lambda: quad_gym.observation_layout("measurements", layout="relative"),
        "^layout has no effect",
    ),
    (lambda: quad_gym.observation_layout(drawn=("mass",)), "^drawn has no effect"),
    (lambda: UnscentedKalmanFilter(AVERAGED), "integration='midpoint'"),
    *(
        (partial(quad_gym.VehicleParams, inertia=(J + J.T) / 2.0), "must belong to a body")
        for J in (np.diag([1.0, 2.0, 3.001]), TURNED @ np.diag([1.0, 1.0, 2.1]) @ TURNED.T)
    ),
    # ---- PD control
    (lambda: PDPolicy(QuadEnv("hover", observation="measurements")), "measurements"),
    (lambda: PDPolicy(QuadEnv("hover", action="velocity")), "absolute"),
    (lambda: PDPolicy(QuadEnv("hover", action="velocity", observation="truth")), "absolute"),
    (lambda: PDPolicy(gymnasium.make("Pendulum-v1")), "QuadGym"),
    (lambda: PDPolicy(QuadEnv("hover"), gains="huge"), "gains"),
    (lambda: PDPolicy(QuadEnv("hover"), gains=5), "gains must be a PDGains, got"),
    (lambda: PDPolicy(QuadEnv("hover"), gains={"positon": 3}), "gains must be a PDGains, got"),
]
REFUSED = [
    *((partial(QuadEnv, "hover", **keywords), message) for keywords, message in HOVER),
    *((partial(FlightBatch, 1, **keywords), message) for keywords, message in BATCHES),
    *((partial(FlightBatch, 1, randomization=draws), message) for draws, message in DRAWS),
    *(
        (
            partial(make, sensors=RTK, true_sensors=RTK.replace(**{part: true})),
            f"true_sensors must have the .*{message}",
        )
        for part, changes, message in TRUE_SENSORS
        for true in [getattr(RTK, part).replace(**changes)]
        for make in (partial(FlightBatch, 1), partial(QuadEnv, "hover"))
    ),
    *(
        (
            partial(FlightBatch, 1, sensors=suite, randomization={name: Uniform(0.1, 0.2)}),
            f"'{name}' needs {needed}",
        )
        for suite, name, needed in ABSENT
    ),
    (partial(FlightBatch, FlightConfiguration(1), threads=1), "count must be a number"),
    *OTHERS,
]
ACCEPTED = [
    partial(FlightBatch, FlightConfiguration(1)),
    lambda: QuadEnv("hover", observation="truth", include_std=True, filter_start="warm"),
    lambda: QuadEnv("hover", observation="noisy", innovations=True, filter_start="warm"),
    lambda: QuadEnv("hover", observation="truth", estimator=None),
    lambda: QuadEnv("hover", action="ctbr", action_params=SCALES),
    lambda: FlightBatch(1, sensors=AVERAGED, source=Source.TRUTH),  # no filter runs
    lambda: FlightBatch(1, randomization={"inertia": Uniform(0.8, 1.2, relative=True)}),
    lambda: FlightBatch(1, randomization={"inertia": [Uniform(1e-3, 2e-3)] * 3}),
    lambda: FlightBatch(1, randomization={"accel_noise_density": Uniform(1e-6, 1e-6)}),
    lambda: FlightBatch(1, randomization={"lever_arm_B": Normal(0.0, 1e-4, offset=True)}),
    lambda: FlightBatch(1, randomization={"primary_antenna_B": NEAR}),
    lambda: quad_gym.VehicleParams(inertia=np.diag([1.0, 2.0, 3.0])),
    lambda: quad_gym.VehicleParams(inertia=np.diag([1e-3, 1.0, 1.0])),
]


@pytest.mark.parametrize(
    ("call", "message"), REFUSED, ids=lambda part: part if isinstance(part, str) else "call"
)
def test_input_is_refused_by_name(call, message):
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert not isinstance(error.value, gymnasium.error.Error)
    if "is not a keyword" in str(error.value):
        assert isinstance(error.value, TypeError)


def test_similar_valid_input_is_accepted():
    for call in ACCEPTED:
        call()


@pytest.mark.parametrize("env_id", ["QuadGym/Square-v0", "QuadGym/Circle-v1", "Circle", ""])
def test_unknown_ids_are_refused_by_gymnasium(env_id):
    with pytest.raises(gymnasium.error.Error):
        gymnasium.make(env_id)


def test_options_of_a_reset_are_refused_without_effect():
    for env in (single_env(seed=1), quad_gym.QuadVectorEnv(2, "hover")):
        env.reset(seed=1)
        before = env.flights.batch.snapshot(), env.np_random.bit_generator.state
        for options, message in (
            ({"position": [1e12, 0.0, 0.0]}, "position must be .* out_of_bounds=1.6 m"),
            ({"position": [1e300, 0.0, 0.0]}, "position must be .* out_of_bounds=1.6 m"),
            ({"velocity": [0.0, 1e9, 0.0]}, "velocity must be at most"),
            ({"yaw": 1e300}, "yaw must be at most"),
            ({"yaw": 90.0}, r"yaw must be in rad, .* got 90; did you mean 1\.571\?"),
            ({"position": ["1", "2", "3"]}, "position must be numbers"),
        ):
            with pytest.raises(ValueError, match=message):
                env.reset(seed=5, options=options)
            assert env.flights.batch.snapshot().tobytes() == before[0].tobytes()
            assert env.np_random.bit_generator.state == before[1]
    wide = QuadEnv("hover", out_of_bounds=1e6)
    assert np.isfinite(wide.reset(seed=1, options={"position": [9e5, 0.0, 0.0]})[0]).all()


@pytest.mark.parametrize("seed", [1.5, "a", -1, True, (), {}])
def test_seeds_are_refused_by_name(seed):
    for env in (QuadEnv("hover"), quad_gym.QuadVectorEnv(2, "hover")):
        with pytest.raises(ValueError, match="seed must be"):
            env.reset(seed=seed)
    with pytest.raises(ValueError, match="seed must be"):
        quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", seed=seed)
    for seeds, message in (([seed, 1], "seeds must be"), (seed, "seeds must contain 2")):
        with pytest.raises(ValueError, match=message):
            FlightBatch(2).reset(seeds=seeds)
    if seed != ():
        with pytest.raises(ValueError, match="seed must be"):
            quad_gym.QuadVectorEnv(1, "hover").reset(seed=[seed])
    first = QuadEnv("hover").reset(seed=np.int64(7))[0]
    np.testing.assert_array_equal(first, QuadEnv("hover").reset(seed=7)[0])
