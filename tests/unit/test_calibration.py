"""Calibration finds the numbers with which a log was simulated."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import quad_gym
from quad_gym import estimation
from quad_gym.commands import calibrate as command
from quad_gym.estimation import calibrate, read_log, replay
from quad_gym.logs.calibrating import search as search_module
from quad_gym.logs.calibrating.calibration import turn_on_biases
from quad_gym.logs.calibrating.likelihood import (
    NU,
    SETTLING,
    SPACING,
    Likelihood,
    in_flight,
    tails,
    validate,
)
from quad_gym.logs.calibrating.search import (
    MAX_SPREAD,
    NUMBERS,
    NumberSearch,
    spread_between,
    widening,
)
from quad_gym.logs.formats import Log, Stream
from quad_gym.logs.replaying.results import Finding, Severity, correlation_time
from quad_gym.params.range_finder import RangeFinderParams
from quad_gym.params.sensor_table import AID_PARAMS, SENSOR_PARAMS
from quad_gym.params.suites import ALL_SUITES, CONSUMER
from quad_gym.rotations import euler_to_dcm, quaternion_to_dcm
from tests.console_commands import run
from tests.logged_flights import Recorded, flown
from tests.many_logs import logs_of

DELAY, MOUNTING = 0.15, (0.05, -0.04, 0.0)
PRIOR = CONSUMER.with_rates(imu=100.0)
TRUE = PRIOR.replace(
    imu=PRIOR.imu.replace(accel_noise_density=0.02, gyro_noise_density=0.002),
    gnss=CONSUMER.gnss.replace(velocity_sigma=0.3),
    magnetometer=CONSUMER.magnetometer.replace(noise_sigma=2e-6),
)
"""A consumer vehicle whose sensors are four to ten times as noisy as their data sheets."""


@pytest.fixture(scope="module")
def table():
    """A log whose GNSS stamps are late, and whose IMU is mounted askew."""
    columns = Recorded(flown(TRUE, 24.0), TRUE, lost=0.0, jitter=0.0, max_ticks=9).table()
    fixes = np.isfinite(columns["gnss_east"])
    columns["time"] = columns["time"] + DELAY * fixes
    columns["received"] = np.maximum(columns["received"], columns["time"])
    for name in ("gyro", "accel"):
        axes = [f"{name}_{axis}" for axis in "xyz"]
        turned = np.column_stack([columns[axis] for axis in axes]) @ euler_to_dcm(MOUNTING)
        columns.update(zip(axes, turned.T, strict=True))
    order = np.argsort(columns["received"], kind="stable")
    absent = ("pixel", "barometer")
    return {name: column[order] for name, column in columns.items() if not name.startswith(absent)}


@pytest.fixture(scope="module")
def found(table):
    """The calibration, by a shorter search than usual."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search_module, "_MIN_GAIN", 1.0)
        patch.setattr(search_module, "_COARSE", np.arange(-0.3, 0.31, 0.15))
        patch.setattr(search_module, "_FEW_STEPS", 2)
        patch.setattr(search_module, "_STEPS", 3)
        return calibrate(table, sensors=PRIOR, rotation=True)


@pytest.mark.parametrize(
    ("name", "true"),
    [
        ("imu.accel_noise_density", TRUE.imu.accel_noise * TRUE.imu.dt**0.5),
        ("imu.gyro_noise_density", TRUE.imu.gyro_noise * TRUE.imu.dt**0.5),
        ("gnss.velocity_sigma", TRUE.gnss.velocity_sigma),
        ("magnetometer.noise_sigma", TRUE.magnetometer.noise_sigma),
    ],
)
def test_noise_of_a_simulated_log_is_found(found, name, true):
    """Within the interval widened by a half: errors that are no white noise count as noise, too.
    Vibration and density of the IMU are one white noise, which seven seconds hardly determine."""
    (number,) = (n for n in found.numbers if n.number.name == name)
    assert number.determined or name.startswith("imu")
    assert number.low / 1.5 < true < 1.5 * number.high, number


def test_late_stamps_of_a_simulated_log_are_found(found):
    """To twice the standard deviation for seven seconds of GNSS with 0.3 m/s of noise."""
    assert found.delays["gnss"] == pytest.approx(DELAY, abs=0.05)
    assert found.suite.log_delays.gnss == found.delays["gnss"]


def test_intervals_contain_delay_and_mounting_of_a_simulated_log(found):
    """Intervals widened by a half: three standard deviations for seven seconds in flight."""
    numbers = {number.number.name: number for number in found.numbers}
    true = {f"log_rotation[{k}]": angle for k, angle in enumerate(MOUNTING)}
    for name, value in (true | {"log_delays.gnss": DELAY}).items():
        low, high = numbers[name].low, numbers[name].high
        assert abs(value - 0.5 * (low + high)) < 0.75 * (high - low), numbers[name]
    assert np.linalg.norm(np.subtract(found.suite.log_rotation, MOUNTING)) < 0.06


def test_replay_rotates_imu_samples_into_body_axes(table):
    columns = dict(table)
    for name in ("gyro", "accel"):
        axes = [f"{name}_{axis}" for axis in "xyz"]
        turned = np.column_stack([columns[axis] for axis in axes]) @ euler_to_dcm(MOUNTING).T
        columns.update(zip(axes, turned.T, strict=True))
    body = replay(columns, sensors=TRUE)
    askew = replay(table, sensors=TRUE.replace(log_rotation=MOUNTING))
    np.testing.assert_allclose(askew.quaternion, body.quaternion, atol=1e-6)


def test_calibrated_suite_fits_the_validation_part_of_the_log(found):
    """GNSS velocity is too noisy by half: its noise is found from the seven seconds in flight."""
    for name, fit in found.after.sensors.items():
        assert 0.3 < fit.mean_nis < 1.5, name
        assert fit.rejected < 0.01
    assert found.before.sensors["gnss_velocity"].mean_nis > 5.0
    assert not found.after.problems
    assert 0.3 < found.after.held_out_nis < 3.0
    assert all(0.1 < ratio < 5.0 for ratio in found.after.held_out_ratios)


def test_suite_has_the_values_of_the_numbers_found(found):
    for each in found.numbers:
        assert each.number.of(found.suite) == each.value, each.number.name


@pytest.mark.parametrize("name", ["log_delays.gnss", "log_rotation[2]"])
def test_undetermined_number_keeps_its_prior_if_the_prior_is_as_likely(
    table, found, name, monkeypatch
):
    """Both count as undetermined here; the true delay differs from its prior, the rotation not."""
    logs = [read_log(table).until(found.split)]
    search = NumberSearch(logs, found.prior, [{}], delays=True, rotation=True)
    search.x = np.array([n.number.coordinate(n.prior, n.value) for n in found.numbers])
    k = [n.number.name for n in found.numbers].index(name)
    before = float(search.x[k])
    assert before != 0.0
    loose = [n._replace(determined=i != k) for i, n in enumerate(found.numbers)]
    if name == "log_delays.gnss":
        assert not search.keep_priors(loose)
        assert search.x[k] == before
    else:
        monkeypatch.setattr(search_module, "_FEW_STEPS", 1)
        assert search.keep_priors(loose)
        assert found.numbers[k].number.of(search.suite(search.x)) == 0.0
        assert search.kept[k]


def test_uncertain_sigma_is_at_most_twice_its_most_likely_value(found):
    """The most likely one is in the middle of its interval, in logarithms."""
    noise = {n.number.name: n for n in found.numbers if n.number.noise}
    factors = {name: n.value / np.sqrt(n.low * n.high) for name, n in noise.items()}
    assert max(factors.values()) == pytest.approx(2.0), "the log determines all of them"
    assert min(factors.values()) < 1.1
    widths = {name: n.high / n.low for name, n in noise.items()}
    assert factors[min(widths, key=widths.get)] < factors[max(widths, key=widths.get)]


def test_calibrated_suite_flies_after_saving_and_loading(found, tmp_path):
    again = quad_gym.sensor_suite(found.suite.save(tmp_path / "mine.toml"))
    assert again == found.suite
    env = quad_gym.QuadEnv("circle", sensors=str(tmp_path / "mine.toml"))
    env.reset(seed=0)
    assert np.isfinite(env.step(env.action_space.sample())[0]).all()


def test_command_writes_suite_page_and_summary(found, tmp_path, monkeypatch):
    asked = []

    def found_before(log, **options):
        asked.append((log, options["sensors"], options["delays"]))
        return found

    monkeypatch.setattr(estimation, "calibrate", found_before)
    names = ["time", *(f"{name}_{axis}" for name in ("gyro", "accel") for axis in "xyz")]
    rows = [f"0.{k},0,0,0,0,0,9.8" for k in range(3)]
    (tmp_path / "flight.csv").write_text("\n".join([",".join(names), *rows]))
    options = ["--no-delays", "--output", "mine", "--vehicle", "body.toml", "--body", "frd"]
    ended = run("calibrate", "flight.csv", *options, where=tmp_path, figures=True)
    assert ended.returncode == 0, ended.stderr
    assert "Wrote no body.toml: the log has no motor voltages" in ended.stdout
    assert (
        "Next: quad-gym replay flight.csv --sensors mine/suite.toml --no-reported-noise --body frd"
        in ended.stdout
    )
    assert asked == [(Path("flight.csv"), "field", False)]
    summary = json.loads((tmp_path / "mine/calibration.json").read_text())
    absent = ("camera", *(name for name in AID_PARAMS if name != "magnetometer"))
    without = ("gnss.baseline", "gnss.primary_antenna", "log_compass_rotation", *absent)
    without += tuple(f"log_delays.{name}" for name in absent)
    assert set(summary["numbers"]) == {n.name for n in NUMBERS if not n.name.startswith(without)}
    assert summary["after"]["measurements"]["gnss_velocity"]["mean_nis"] > 0.0
    assert (tmp_path / "mine/report.html").stat().st_size > 10_000
    assert quad_gym.sensor_suite(tmp_path / "mine/suite.toml").gnss.rate == 10.0


def test_calibration_without_a_heading_is_refused(table):
    without = {name: c for name, c in table.items() if not name.startswith("magnet")}
    with pytest.raises(ValueError, match="must know the heading at the start"):
        calibrate(without, sensors=CONSUMER.replace(magnetometer=None))


def test_calibration_with_too_short_a_log_is_refused(table):
    short = {name: column[table["received"] < 8.0] for name, column in table.items()}
    with pytest.raises(ValueError, match="at least 50 measurements in flight"):
        calibrate(short, sensors="consumer")


def test_correlation_time_of_an_autoregression_is_the_closed_form():
    """An AR(1) process with coefficient a has (1 + a) / (1 - a)."""
    rng = np.random.default_rng(0)
    for a in (0.0, 0.5, 0.8):
        values = np.zeros(40_000)
        for k in range(1, len(values)):
            values[k] = a * values[k - 1] + rng.normal()
        assert correlation_time(values) == pytest.approx((1 + a) / (1 - a), rel=0.15)


def autoregression(count, rng):
    """An AR(1) process (count, 1) with coefficient 0.5, unit variance and tau = 3."""
    values = np.zeros((count, 1))
    for k in range(1, len(values)):
        values[k] = 0.5 * values[k - 1] + np.sqrt(0.75) * rng.normal()
    return values


def test_noise_is_widened_for_correlated_innovations():
    rng = np.random.default_rng(4)
    values = autoregression(40_000, rng)
    assert widening(values, 2.0) == pytest.approx(np.sqrt(3.0), rel=0.1)
    assert widening(values, 1.5) == 1.5
    assert widening(0.2 * values, 2.0) == pytest.approx(widening(values, 2.0))
    assert widening(rng.normal(size=(40_000, 3)), 2.0) == 1.0


@pytest.mark.parametrize(("factor", "wider"), [(1.0, False), (0.2, True)])
def test_wider_noise_stays_if_fixes_left_out_are_more_likely_with_it(
    table, found, monkeypatch, factor, wider
):
    """Noise of velocity is wider by the square root of three if it is a fifth of the true one."""
    search = NumberSearch([read_log(table)], found.prior, [{}], delays=True, rotation=True)
    search.x = np.array([n.number.coordinate(n.prior, n.value) for n in found.numbers])
    noise = [n.number.name for n in found.numbers].index("gnss.velocity_sigma")
    number, prior = found.numbers[noise].number, found.numbers[noise].prior
    search.x[noise] = number.coordinate(prior, factor * TRUE.gnss.velocity_sigma)
    before = search.x[noise]
    correlated = np.tile(autoregression(2000, np.random.default_rng(3)), 3)
    monkeypatch.setattr(search, "describe", lambda: {"gnss_velocity": correlated})
    monkeypatch.setattr(search, "fit", lambda: None)
    search.adapt()
    ratio = number.value(prior, search.x[noise]) / number.value(prior, before)
    assert ratio == pytest.approx(np.sqrt(3.0) if wider else 1.0, rel=0.1)
    assert (search.low[noise] == search.x[noise]) == wider


def test_loss_counts_every_measurement_of_sensors_with_white_innovations():
    """The loss grows by the terms of Student's t, minus one in each half second."""
    late = Recorded(flown(TRUE, 16.0), TRUE, lost=0.0, jitter=0.0).table()
    order = np.argsort(late["time"], kind="stable")
    log = read_log({name: c[order] for name, c in late.items()} | {"received": late["time"][order]})
    suite = TRUE.replace(estimator=TRUE.estimator.replace(false_alarm_probability=0.0))
    measured = replay(log, sensors=suite, reported_noise=False).measured

    def loss(*white):
        return float(Likelihood(log, suite, {}, {}, white, 0.2).losses([suite]).sum())

    def terms(m):
        rows = in_flight(log, m.received) & (m.received > log.gnss.received[0] + SETTLING)
        nis, sigma = m.nis[rows], m.sigma[rows]
        rows = m.received[rows] <= log.imu.time[-1] - 0.2
        d = sigma.shape[1]
        some = 0.5 * (NU[0] + d) * np.log1p(nis / (NU[0] - 2.0)) + np.log(sigma).sum(axis=1)
        return float(some[rows].sum())

    for name in ("barometer", "magnetometer"):
        others = set(measured) - {name}
        share = (loss(*measured) - loss(*others)) / terms(measured[name])
        every = math.ceil(SPACING * getattr(suite, name).rate)  # of which one counts in any case
        assert share == pytest.approx(1.0 - 1.0 / every, abs=0.03)


def test_log_in_other_units_is_refused_before_the_search(table):
    in_g = {n: c / 9.8 if n.startswith("accel") else c for n, c in table.items()}
    with pytest.raises(ValueError, match=r"SI units: median specific force .* in g\?"):
        calibrate(in_g, sensors="consumer")


def test_suite_that_does_not_describe_the_validation_part_exits_with_one(
    found, tmp_path, monkeypatch
):
    text = "GNSS velocity: NIS per degree of freedom 53, 1 expected"
    finding = Finding(quantity="position", severity=Severity.LOST, text=text)
    after = replace(found.after, findings=(finding,))
    wrong = replace(found, after=after, suite=found.suite.replace(range_finder=RangeFinderParams()))
    monkeypatch.setattr(estimation, "calibrate", lambda log, **options: wrong)
    monkeypatch.setattr(command, "write_page", lambda *_: [])
    (tmp_path / "flight 1.csv").write_text("time")
    ended = run("calibrate", "flight 1.csv", "--output", "mine", where=tmp_path)
    assert ended.returncode == 1
    assert f"Not usable, because position: {text}." in ended.stdout
    assert "The log has no range finder: the suite keeps its own." in ended.stdout
    assert "Next" not in ended.stdout
    assert (tmp_path / "mine/suite.toml").is_file()


def test_outage_of_a_log_is_no_second_left_out(table):
    """Predictions over three seconds of outage do not count in any of the five replays."""
    gone = (table["time"] > 16.0) & (table["time"] < 19.0)
    outage = {name: c.copy() for name, c in table.items()}
    for name in outage:
        if name.startswith("gnss"):
            outage[name][gone] = np.nan
    suite = TRUE.replace(log_delays=TRUE.log_delays.replace(gnss=DELAY), log_rotation=MOUNTING)
    whole, short = (
        validate(read_log(each), suite, {}, 12.0).held_out_error for each in (table, outage)
    )
    assert short[0] < 1.3 * whole[0]


def test_validation_on_a_whole_log_predicts_fixes_after_the_start(table):
    suite = TRUE.replace(log_delays=TRUE.log_delays.replace(gnss=DELAY), log_rotation=MOUNTING)
    late, whole = (validate(read_log(table), suite, {}, split) for split in (12.0, -math.inf))
    assert whole.sensors["gnss_position"].measurements > late.sensors["gnss_position"].measurements
    assert whole.held_out_error[0] == pytest.approx(late.held_out_error[0], rel=0.5)
    assert 0.3 < whole.held_out_nis < 3.0


def test_lever_arm_moves_both_antennas_by_the_same_distance():
    lever = next(n for n in NUMBERS if n.name == "gnss.primary_antenna_B[2]")
    suite = quad_gym.sensor_suite("mocap")
    moved = lever.put(suite, 0.2).gnss
    assert moved.primary_antenna_B[2] == 0.2
    assert moved.baseline_B == pytest.approx(suite.gnss.baseline_B, abs=1e-15)


def test_sensor_that_stops_early_does_not_stop_a_calibration(table, found):
    stopped = {name: c.copy() for name, c in table.items()}
    for name in stopped:
        if name.startswith("magnet"):
            stopped[name][table["time"] > 4.5] = np.nan
    search = NumberSearch([read_log(stopped)], found.prior, [{}], delays=True, rotation=True)
    low = search.widened(search.describe())
    noise = [n.name for n in search.numbers].index("magnetometer.noise_sigma")
    assert low[noise] == search.low[noise]
    assert "magnetometer" not in search.white


def test_search_near_the_largest_delay_and_inclination_stays_below_it():
    for number in NUMBERS:
        if math.isfinite(number.limit):
            prior = 0.9 * number.limit
            low, high = number.ends(prior)
            assert number.value(prior, high) == pytest.approx(number.limit)
            if not number.noise:  # noise has a lower end of its own
                assert number.value(prior, low) == pytest.approx(prior + number.spread * low)
                assert low == -MAX_SPREAD


@pytest.mark.parametrize("name", ALL_SUITES)
def test_suite_accepts_both_ends_of_every_number_of_a_search(name):
    suite, tried = quad_gym.sensor_suite(name), 0
    for number in NUMBERS:
        if number.part(suite) is None or getattr(number.part(suite), number.field) is None:
            continue
        prior = number.of(suite)
        if number.positive and prior <= 0.0:
            continue
        for end in number.ends(prior):
            changed = number.put(suite, number.value(prior, end))
            assert number.of(changed) == number.value(prior, end)
            tried += 1
    assert tried >= 20


def at_rest_for(rest, total=75.0):
    """A log that rests, and then vibrates."""
    rng, time = np.random.default_rng(0), np.arange(0.0, total, 0.01)
    accel = rng.normal([0.0, 0.0, 9.8], 0.05, (len(time), 3))
    accel += (time > rest)[:, np.newaxis] * rng.normal(0.0, 1.0, (len(time), 3))
    gyro = rng.normal(0.0, 0.002, (len(time), 3))
    return Log(imu=Stream(time, time, {"accel": accel, "gyro": gyro}))


@pytest.mark.parametrize("rest", [30.0, 45.0, 75.0])
def test_vehicle_at_rest_is_not_in_flight_for_any_share_of_the_log(rest):
    log = at_rest_for(rest)
    flying, time = in_flight(log, log.imu.time), log.imu.time
    assert not flying[time < rest - 1.0].any()
    assert flying[time > rest + 1.0].all()


def test_calm_flight_without_vibration_is_in_flight():
    """Noise as at rest, and slow turns of 3 degrees, from the beginning to the end."""
    rng, time = np.random.default_rng(3), np.arange(0.0, 40.0, 0.01)
    turns = 0.15 * np.sin(1.5 * time)[:, np.newaxis] * [1.0, 0.5, 0.0]
    values = {
        "gyro": turns + rng.normal(0.0, 0.002, (len(time), 3)),
        "accel": rng.normal([0.0, 0.0, 9.8], 0.02, (len(time), 3)),
    }
    log = Log(imu=Stream(time, time, values))
    assert in_flight(log, time).mean() > 0.95


def test_vehicle_with_stopped_motors_is_not_in_flight():
    log = at_rest_for(30.0)
    commands = np.where(log.imu.time > 50.0, 0.6, 0.05)[:, np.newaxis] * np.ones(4)
    motors = Stream(log.imu.time, log.imu.time, {"commands": commands})
    flying = in_flight(replace(log, motors=motors), log.imu.time)
    assert not flying[log.imu.time < 49.0].any()
    assert flying[log.imu.time > 51.0].all()


def test_turn_on_biases_of_a_flight_are_found_and_subtracted():
    """Of 0.06 rad/s and 1.2 m/s^2, beyond four standard deviations of the suite."""
    suite, biases = CONSUMER, {"gyro": [0.0, 0.06, 0.0], "accel": [1.2, 0.0, 0.0]}
    log, truth = next(logs_of("consumer", 1, 30.0, seed=3))
    biased = log | {name: log[name] + bias for name, bias in biases.items()}
    found = turn_on_biases(read_log(biased), {}, suite)
    for name, error in (("gyro", 0.005), ("accel", 0.15)):
        true = truth[f"{name}_bias"].mean(axis=0) + biases[name]
        np.testing.assert_allclose(found[name], true, atol=error)
    means = {f"log_{name}_bias": tuple(biases[name]) for name in biases}
    clean, corrected = replay(log, sensors=suite), replay(biased, sensors=suite.replace(**means))
    np.testing.assert_allclose(corrected.position, clean.position, atol=1e-6)
    assert not any(np.any(b) for b in turn_on_biases(read_log(log), {}, suite).values())


def test_replay_rotates_the_compass_into_body_axes():
    log, _ = next(logs_of("consumer", 1, 10.0, seed=4))
    turned = log | {"magnetometer": log["magnetometer"] @ euler_to_dcm((0.1, -0.1, 0.3))}
    suite = CONSUMER.replace(log_compass_rotation=(0.1, -0.1, 0.3))
    body, askew = replay(log, sensors=CONSUMER), replay(turned, sensors=suite)
    np.testing.assert_allclose(askew.quaternion, body.quaternion, atol=1e-9)


def test_spread_between_flights_is_the_variance_of_their_numbers():
    """Quadratic losses of ten logs with other minima, plus noise in their parts."""
    rng, parts, spread = np.random.default_rng(5), 200, 0.6
    h, losses = np.array([0.1]), []
    for best in spread * rng.normal(size=10):
        centers = best + rng.normal(0.0, 1.0, parts)
        losses.append(np.stack([0.5 * (x - centers) ** 2 for x in (0.0, 0.1, -0.1)], axis=1))
    found = spread_between(np.concatenate(losses), h, [parts] * 10, 10)
    assert found[0] == pytest.approx(spread**2, rel=0.6)
    same = [np.stack([0.5 * (x - rng.normal(0.0, 1.0, parts)) ** 2 for x in (0.0, 0.1, -0.1)], 1)]
    assert spread_between(np.concatenate(same), h, [parts], 10)[0] == 0.0


def test_search_in_all_logs_begins_where_the_search_in_some_has_ended(table, found):
    """The first of all logs has no magnetometer, so that the numbers have another order."""
    without = {name: c for name, c in table.items() if not name.startswith("magnet")}
    logs = [read_log(without), read_log(table)]
    some, every = (
        NumberSearch(each, found.prior, [{}] * len(each), delays=True, rotation=True)
        for each in (logs[1:], logs)
    )
    assert [n.name for n in every.numbers] != [n.name for n in some.numbers]
    some.x = np.array([n.number.coordinate(n.prior, n.value) for n in found.numbers])
    every.take(some)
    assert every.suite(every.x) == some.suite(some.x)


@pytest.mark.parametrize(("name", "sensor"), [("crazyflie", "range_finder"), ("uwb", "uwb_range")])
def test_delay_of_an_aiding_sensor_has_its_best_likelihood_at_the_true_delay(name, sensor):
    """Of a grid with steps of 50 ms, with all other numbers as simulated."""
    suite = quad_gym.sensor_suite(name).with_rates(imu=100.0)
    flight = flown(suite, 12.0, task="random_trajectory")
    columns = Recorded(flight, suite, lost=0.0, jitter=0.0, max_ticks=1).table()
    log = read_log(columns)
    late = getattr(log, sensor)
    received = np.maximum(late.received, late.time + 0.1)
    log = replace(log, **{sensor: Stream(late.time + 0.1, received, late.values)})
    x_I = quaternion_to_dcm(flight["quaternion"][0])[0]
    start = {"position": flight["position"][0], "heading": math.atan2(x_I[1], x_I[0])}
    search = NumberSearch([log], suite, [start], delays=True, rotation=False)
    (k,) = (k for k, n in enumerate(search.numbers) if n.name == f"log_delays.{sensor}")
    delays = np.arange(-0.1, 0.31, 0.05)
    x = np.array([n.coordinate(v, v) for n, v in zip(search.numbers, search.values, strict=True)])
    spread = search.numbers[k].spread
    points = [np.where(np.arange(len(x)) == k, delay / spread, x) for delay in delays]
    assert delays[np.argmin(search.total(points))] == pytest.approx(0.1)


def test_every_sensor_has_a_delay_that_a_calibration_finds():
    found = {number.field for number in NUMBERS if number.sensor == "log_delays"}
    assert found == set(vars(quad_gym.LogDelays())) == set(SENSOR_PARAMS)


@pytest.mark.slow
def test_calibration_on_two_flights_describes_a_third():
    """Flights with velocity noise that differs by a factor of two, judged on another one."""
    logs = [log for log, _ in logs_of("consumer", 3, 25.0, seed=6)]
    rng = np.random.default_rng(7)
    for log, sigma in zip(logs, (0.15, 0.3, 0.2), strict=True):
        log["gnss_velocity_enu"] += rng.normal(0.0, sigma, log["gnss_velocity_enu"].shape)
    result = calibrate(logs, sensors="consumer", share=0.7)
    assert result.used == 2
    assert result.verdict.startswith("usable"), result.verdict
    assert 0.3 < result.after.sensors["gnss_velocity"].mean_nis < 1.5


def test_tails_of_normal_and_of_heavy_tailed_innovations_differ():
    """One sample is Gaussian with another variance, the other is Student's t with nu = 4."""
    rng = np.random.default_rng(2)
    normal = rng.normal(size=(1000, 3))
    heavy = normal / np.sqrt(rng.chisquare(4, size=(1000, 1)) / 4.0)
    assert tails(0.3 * (normal**2).sum(axis=1), 3) > 10.0
    assert tails(0.3 * (heavy**2).sum(axis=1), 3) == 5.0
