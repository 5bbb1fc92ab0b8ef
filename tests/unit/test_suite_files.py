"""Sensor suites in files: saving and reading, bases, and messages that name the mistake."""

import dataclasses
import math

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines.recipes import Plan, description
from quad_gym.commands.compare import CompareArgs, configure
from quad_gym.params.suites import ALL_SUITES
from tests import console_commands
from tests.contract.test_sweep import pretend


def read(tmp_path, text):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    return quad_gym.sensor_suite(str(file))


@pytest.mark.parametrize("name", ALL_SUITES)
def test_a_suite_is_the_same_after_saving_and_reading(name, tmp_path):
    suite = quad_gym.sensor_suite(name)
    file = suite.save(tmp_path / "mine.toml")
    assert quad_gym.sensor_suite(file) == suite
    assert quad_gym.sensor_suite(str(file)) == suite


def test_a_world_is_the_same_after_saving_and_reading(tmp_path):
    breeze = quad_gym.world_params("fresh_breeze")
    box = ((-5.0, -5.0, 0.0), (5.0, 5.0, 3.0))
    for world in (quad_gym.WorldParams(geofence=box, ground=quad_gym.GroundParams()), breeze):
        file = world.save(tmp_path / "mine.toml")
        assert quad_gym.world_params(str(file)) == world
        assert quad_gym.QuadEnv("hover", world=str(file)).flights.batch.world == world
    (tmp_path / "mine.toml").write_text('base = "breeze"\nground_effect = false\n')
    crazyflie = quad_gym.vehicle_params("crazyflie")
    near = quad_gym.world_params("breeze", crazyflie).replace(ground_effect=False)
    assert quad_gym.world_params(tmp_path / "mine.toml", crazyflie) == near
    with pytest.raises(ValueError, match="a world with obstacles cannot be saved"):
        quad_gym.world_params("slalom").save(tmp_path / "slalom.toml")


def test_numbers_that_are_hard_to_write_are_the_same_after_reading(tmp_path):
    suite = quad_gym.sensor_suite("rtk")
    rng = np.random.default_rng(0)
    suite = suite.replace(
        imu=suite.imu.replace(
            accel_noise_density=math.pi * 1e-13,
            gyro_noise_density=np.float64(1 / 3),
            lever_arm_B=rng.normal(size=3),
            accel_bias_tau=1e15,
        ),
        camera=suite.camera.replace(
            max_range=np.float64("inf"), phase=0.1, features_I=rng.normal(size=(5, 3))
        ),
        estimator=suite.estimator.replace(initial_tilt_sigma=None, kappa=-1, beta=0),
    )
    suite.save(tmp_path / "mine.toml")
    assert quad_gym.sensor_suite(str(tmp_path / "mine.toml")) == suite


def test_every_field_is_in_the_file_by_name(tmp_path):
    suite = quad_gym.sensor_suite("consumer")
    text = suite.save(tmp_path / "mine.toml").read_text()
    for part in (suite.imu, suite.gnss, suite.barometer, suite.magnetometer, suite.estimator):
        for field in dataclasses.fields(part):
            assert f"\n{field.name} = " in text
    assert 'camera = "none"' in text
    assert 'secondary_antenna_B = "none"' in text


def test_fields_missing_in_file_come_from_its_base(tmp_path):
    base = quad_gym.sensor_suite("consumer")
    mine = read(
        tmp_path,
        'base = "consumer"\nmagnetometer = "none"\n[gnss]\nvelocity_sigma = 0.4\n'
        "primary_antenna_B = [0, 0, 0.1]\n[imu]\nrate = 100",
    )
    assert mine == base.replace(
        magnetometer=None,
        gnss=base.gnss.replace(velocity_sigma=0.4, primary_antenna_B=(0.0, 0.0, 0.1)),
        imu=base.imu.replace(rate=100.0),
    )
    lacked = read(tmp_path, 'base = "rtk"\n[barometer]\nnoise_sigma = 0.3').barometer
    assert lacked == quad_gym.BarometerParams(noise_sigma=0.3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[imu", "must be a file of TOML: "),
        ('base = "consumr"', "base must be one of .* got 'consumr'; did you mean consumer?"),
        ("base = 3", "base must be one of"),
        ('base = "rtk"\n[imus]\nrate = 1', "imus is not a field of SensorSuite; did you mean imu?"),
        ('base = "rtk"\n[imu]\nrat = 1', "imu.rat is not a field of ImuParams; did you mean rate?"),
        ('base = "rtk"\n[imu]\nzzz = 1', "imu.zzz is not a field of ImuParams; it has rate, lever"),
        ('base = "rtk"\nimu = 3', "imu must be a table, got 3"),
        ('base = "rtk"\nimu = "none"', "imu must be a table, got 'none'"),
        ('base = "rtk"\n[imu]\nrate = -1', "ImuParams.rate must be greater than 0, got -1"),
        ('base = "rtk"\n[imu]\nrate = "x"', "ImuParams.rate must be a number, got 'x'"),
        ('base = "rtk"\n[imu]\nrate = "none"', "ImuParams.rate must be a number, got 'none'"),
        ('base = "rtk"\n[imu]\nrate = 2020-01-01', "ImuParams.rate must be a number"),
        ('base = "rtk"\n[imu]\nrate = nan', "ImuParams.rate must be finite"),
        ('base = "rtk"\n[imu.rate]\nx = 1', "ImuParams.rate must be a number"),
        ('base = "rtk"\n[imu]\nlever_arm_B = [1, 2]', r"lever_arm_B must have shape \(3,\)"),
        ('base = "rtk"\n[imu]\nlever_arm_B = 1', r"lever_arm_B must have shape \(3,\)"),
        ('base = "rtk"\n[gnss]\nrate = 7', "GnssParams.rate must divide the IMU rate"),
        (
            'base = "rtk"\n[camera]\nfeatures_I = []',
            "CameraParams.features_I must contain at least",
        ),
        ("[imu]\nrate = 200", r"there must be a table \[gnss\], or base = "),
        ("", r"there must be a table \[imu\]"),
    ],
)
def test_error_message_of_invalid_file_names_file_and_field(text, message, tmp_path):
    with pytest.raises(ValueError, match=f"mine.toml:? .*{message}"):
        read(tmp_path, text)


def test_binary_missing_and_wrongly_named_files_are_refused(tmp_path):
    (tmp_path / "mine.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"mine.toml must be a file of TOML"):
        quad_gym.sensor_suite(str(tmp_path / "mine.toml"))
    with pytest.raises(FileNotFoundError, match=r"none\.toml"):
        quad_gym.sensor_suite(str(tmp_path / "none.toml"))
    with pytest.raises(ValueError, match=r"file must end with .toml, got 'mine.txt'"):
        quad_gym.sensor_suite("rtk").save("mine.txt")
    with pytest.raises(ValueError, match=r"or a file of a suite \(.toml\), got 'consumr'; did you"):
        quad_gym.sensor_suite("consumr")


def test_environments_take_paths_of_files(tmp_path):
    suite, vehicle = quad_gym.sensor_suite("rtk"), quad_gym.vehicle_params("crazyflie")
    world = quad_gym.WorldParams(wind_I=(1.0, 0.0, 0.0))
    given = {"sensors": suite, "vehicle": vehicle, "world": world}
    paths = {name: params.save(tmp_path / f"{name}.toml") for name, params in given.items()}
    batch = gymnasium.make("QuadGym/Hover-v0", **paths).unwrapped.flights.batch
    assert {name: getattr(batch, name) for name in given} == given


def test_a_command_takes_a_suite_in_a_file(tmp_path, capsys):
    file = quad_gym.sensor_suite("rtk").save(tmp_path / "my-suite.toml")
    line = "evaluate hover --policy pd --episodes 2 --env duration=0.2 --output"
    for name, sensors in (("preset", "rtk"), ("own", str(file))):
        words = (*line.split(), tmp_path / name, "--sensors", sensors)
        assert console_commands.run(*words).returncode == 0
    preset, own = ((tmp_path / name / "episodes.csv").read_text() for name in ("preset", "own"))
    assert own == preset
    (tmp_path / "wrong.toml").write_text('base = "rtk"\n[imus]\n')
    for name, message in (
        ("none.toml", "none.toml does not exist"),
        ("wrong.toml", "wrong.toml: imus is not a field of SensorSuite; did you mean imu?"),
    ):
        words = [*line.split(), str(tmp_path / "new"), "--sensors", str(tmp_path / name)]
        assert message in console_commands.refused(words, capsys)


def test_the_record_of_a_training_has_the_contents_of_the_file(tmp_path):
    file = quad_gym.sensor_suite("rtk").save(tmp_path / "mine.toml")
    plan = Plan(environment={"sensors": str(file)})
    before = description(plan)
    assert before["environment"] == {"sensors": str(file)}
    assert before["suite_files"][str(file)]["imu"]["rate"] == 200.0
    quad_gym.sensor_suite("consumer").save(file)
    assert description(plan) != before
    assert "suite_files" not in description(Plan(environment={"sensors": "rtk"}))


def test_comparison_refuses_duplicate_names_and_changed_suite_file(tmp_path):
    (tmp_path / "b").mkdir()
    file, other = (
        str(quad_gym.sensor_suite("rtk").save(tmp_path / folder / "mine.toml"))
        for folder in (".", "b")
    )
    with pytest.raises(ValueError, match="--sensors must have different names, got mine mine"):
        configure(CompareArgs(sensors=(file, other), engine="compiled", output=tmp_path / "out"))
    args = CompareArgs(sensors=(file,), engine="compiled", output=tmp_path / "out")
    training = configure(args).trainings[0]
    assert training.folder == tmp_path / "out/runs/mine/truth/seed_0"
    pretend(training, 0.1)
    quad_gym.sensor_suite("consumer").save(file)
    with pytest.raises(ValueError, match=r"another plan \(different: suite_files\)"):
        configure(args)


def test_deeply_nested_toml_is_refused(tmp_path):
    with pytest.raises(ValueError, match="must be a file of TOML"):
        read(tmp_path, "a = " + "[" * 100_000)
