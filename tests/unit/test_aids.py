"""Barometer and magnetometer in flights: values, times, latency, loss, observation and info."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import BarometerParams, MagnetometerParams
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.faults import SensorLoss
from quad_gym.records import AID_BLOCK, AID_BLOCKS, Aid
from tests.field_flights import attitudes, fly, steps

LAB = quad_gym.sensor_suite("standard").replace(camera=None)
BAROMETER, MAGNETOMETER = int(Aid.BAROMETER), int(Aid.MAGNETOMETER)
AIDED_BLOCKS = slice(AID_BLOCKS, AID_BLOCKS + 2)
AIDED = LAB.replace(
    barometer=BarometerParams(phase=0.0), magnetometer=MagnetometerParams(phase=0.0)
)


def field_B(batch, magnetometer, declination_error=0.0, soft_iron=0.0):
    """Return the field in B by NumPy, from strength, inclination, declination and soft iron."""
    level = magnetometer.strength * np.cos(magnetometer.inclination)
    angle = np.pi / 2 - magnetometer.declination - declination_error  # from east toward north
    down = np.full_like(angle, magnetometer.strength * np.sin(magnetometer.inclination))
    field_I = np.stack([level * np.cos(angle), level * np.sin(angle), -down], axis=-1)
    seen = np.einsum("nij,nj->ni", attitudes(batch.record("q")), field_I)
    return seen + np.einsum("nij,nj->ni", soft_iron + np.zeros((batch.count, 3, 3)), seen)


def test_a_barometer_measures_height_bias_and_white_noise():
    batch = fly(AIDED, 2000, task="hover")
    steps(batch, 0.02)
    assert batch.record("block_valid")[:, AIDED_BLOCKS].all()
    z = batch.record("measurement")[:, AID_BLOCKS:][:, BAROMETER]
    bias = batch.record("aid_scalar")[:, BAROMETER]
    noise = z[:, 0] - batch.record("r")[:, 2] - bias
    assert noise.std() == pytest.approx(AIDED.barometer.noise_sigma, rel=0.07)
    assert abs(noise.mean()) < 5.0 * AIDED.barometer.noise_sigma / np.sqrt(2000)
    assert bias.std() == pytest.approx(AIDED.barometer.bias_sigma, rel=0.07)
    assert (z[:, 1:] == 0.0).all()


def test_bias_of_a_barometer_is_a_gauss_markov_process():
    suite = AIDED.replace(barometer=BarometerParams(bias_tau=0.5, rate=20.0, phase=0.0))
    batch = fly(suite, 4000, task="hover")
    before = batch.record("aid_scalar")[:, BAROMETER]
    steps(batch, 0.25)
    after, sigma = batch.record("aid_scalar")[:, BAROMETER], suite.barometer.bias_sigma
    assert after.std() == pytest.approx(sigma, rel=0.05)
    assert (before * after).mean() == pytest.approx(sigma**2 * np.exp(-0.5), rel=0.1)


def test_hard_iron_that_changes_is_a_gauss_markov_process():
    suite = LAB.replace(magnetometer=MagnetometerParams(hard_iron_tau=0.5, rate=20.0, phase=0.0))
    batch = fly(suite, 2000, task="hover")
    before = batch.record("aid_vector")[:, MAGNETOMETER]
    steps(batch, 0.25)
    after, sigma = batch.record("aid_vector")[:, MAGNETOMETER], suite.magnetometer.hard_iron_sigma
    np.testing.assert_allclose(after.std(axis=0), sigma, rtol=0.08)
    expected = sigma**2 * np.exp(-0.5) * np.eye(3)
    np.testing.assert_allclose(before.T @ after / 2000, expected, atol=0.1 * sigma**2)


def test_a_magnetometer_measures_the_field_with_its_errors():
    magnetometer = MagnetometerParams(phase=0.0, soft_iron_sigma=0.02, declination_sigma=0.05)
    batch = fly(LAB.replace(magnetometer=magnetometer), 2000, task="hover")
    declination = batch.record("aid_scalar")[:, MAGNETOMETER]
    hard_iron = batch.record("aid_vector")[:, MAGNETOMETER]
    soft_iron = batch.record("aid_matrix")[:, MAGNETOMETER]
    expected = field_B(batch, magnetometer, declination, soft_iron) + hard_iron
    noise = batch.record("measurement")[:, AID_BLOCKS:][:, MAGNETOMETER] - expected
    assert noise.std() == pytest.approx(magnetometer.noise_sigma, rel=0.05)
    assert (abs(noise.mean(axis=0)) < 5.0 * magnetometer.noise_sigma / np.sqrt(2000)).all()
    assert hard_iron.std() == pytest.approx(magnetometer.hard_iron_sigma, rel=0.05)
    assert soft_iron.std() == pytest.approx(0.02, rel=0.05)
    assert declination.std() == pytest.approx(0.05, rel=0.07)
    steps(batch, 0.1)
    np.testing.assert_array_equal(batch.record("aid_vector")[:, MAGNETOMETER], hard_iron)
    np.testing.assert_array_equal(batch.record("aid_scalar")[:, MAGNETOMETER], declination)


def test_measurements_are_zero_beyond_their_own_numbers():
    """A range or an altitude has one of three, a flow two: others would count as innovations."""
    suite = quad_gym.sensor_suite("uwb").replace(
        barometer=BarometerParams(rate=100.0),
        range_finder=quad_gym.RangeFinderParams(rate=100.0),
        optical_flow=quad_gym.OpticalFlowParams(rate=100.0),
    )
    batch = fly(suite, 8, task="hover", start="hover")
    steps(batch, 0.1)
    values, fresh = batch.record("measurement"), batch.record("block_fresh")
    for aid, length in (("BAROMETER", 1), ("RANGE_FINDER", 1), ("UWB_RANGE", 1),
                        ("OPTICAL_FLOW", 2)):  # fmt: skip
        block = AID_BLOCK[Aid[aid]]
        assert fresh[:, block].any()
        assert values[:, block, :length].any()
        assert not values[:, block, length:].any()


@pytest.mark.parametrize("phase", [0.0, 0.5, None])
def test_sensors_measure_at_their_rates_and_phases(phase):
    suite = LAB.replace(
        barometer=BarometerParams(rate=20.0, phase=phase),
        magnetometer=MagnetometerParams(rate=50.0, phase=phase),
    )
    batch = fly(suite, 64, task="hover")
    valid = [batch.record("block_valid")[:, AIDED_BLOCKS]]
    for _ in range(40):
        batch.step()
        valid.append(batch.record("block_valid")[:, AIDED_BLOCKS])
    valid = np.array(valid) > 0.0  # (ticks, flights, aids)
    for aid, period in ((BAROMETER, 10), (MAGNETOMETER, 4)):
        first = valid[:, :, aid].argmax(axis=0)
        assert (first < period).all()
        if phase is None:
            assert len(set(first)) == period
        else:
            assert (first == round(phase * period)).all()
        ticks = np.arange(41)[:, np.newaxis]
        np.testing.assert_array_equal(
            valid[:, :, aid], (ticks >= first) & ((ticks - first) % period == 0)
        )


@pytest.mark.parametrize("periods", [1, 2])
def test_late_measurements_arrive_with_values_of_their_measurement_time(periods):
    """The latency is one period, or two periods, the longest possible."""
    waits = {"phase": 0.0, "latency": periods * 0.02}
    late = LAB.replace(barometer=BarometerParams(**waits), magnetometer=MagnetometerParams(**waits))
    prompt, delayed = fly(AIDED, 16, task="hover"), fly(late, 16, task="hover")
    delay, noise, truth = 4 * periods, [], []
    for tick in range(60):
        # both fly on estimates, which differ: only the noise is common to both
        noise.append(
            prompt.record("measurement")[:, AID_BLOCKS:][:, BAROMETER, 0] - undisturbed(prompt)
        )
        truth.append(undisturbed(delayed))
        if tick % 4 == 0:
            assert (delayed.record("block_valid")[:, AIDED_BLOCKS] == (tick >= delay)).all()
        if tick % 4 == 0 and tick >= delay:
            arrived = (
                delayed.record("measurement")[:, AID_BLOCKS:][:, BAROMETER, 0] - truth[tick - delay]
            )
            np.testing.assert_allclose(arrived, noise[tick - delay], atol=1e-9)
        prompt.step()
        delayed.step()


def undisturbed(batch):
    """Return the current measurement of a barometer without white noise."""
    return batch.record("r")[:, 2] + batch.record("aid_scalar")[:, BAROMETER]


def test_sensor_loss_stops_only_its_sensor_while_active():
    faults = (
        SensorLoss(sensor="barometer", start=0.1, duration=0.2),
        SensorLoss(sensor="magnetometer", start=0.2, duration=0.2),
    )
    batch = fly(AIDED, 8, task="hover", faults=faults)
    heard = [batch.record("block_valid")[:, AIDED_BLOCKS]]
    for _ in range(100):
        batch.step()
        heard.append(batch.record("block_valid")[:, AIDED_BLOCKS])
    heard, due = np.array(heard).all(axis=1)[::4], np.arange(26) * 0.02
    np.testing.assert_array_equal(heard[:, BAROMETER], (due < 0.1 - 1e-9) | (due > 0.3 - 1e-9))
    np.testing.assert_array_equal(heard[:, MAGNETOMETER], (due < 0.2 - 1e-9) | (due > 0.4 - 1e-9))
    with pytest.raises(ValueError, match="SensorLoss needs a barometer"):
        FlightBatch(1, sensors=LAB, faults=(SensorLoss(sensor="barometer"),))


def test_sensors_can_be_switched_off_and_on():
    batch = fly(AIDED, 8, task="hover")
    batch.switch_sensors(barometer=False)
    steps(batch, 0.02)
    assert not batch.record("block_valid")[:, AIDED_BLOCKS][:, BAROMETER].any()
    assert batch.record("block_valid")[:, AIDED_BLOCKS][:, MAGNETOMETER].all()
    batch.switch_sensors(barometer=True)
    steps(batch, 0.005)
    assert batch.record("block_valid")[:, AIDED_BLOCKS][:, BAROMETER].all()
    with pytest.raises(ValueError, match="switch_sensors"):
        fly(LAB, 1, task="hover").switch_sensors(barometer=False)
    with pytest.raises(ValueError, match="barometer if sensors has"):
        FlightBatch(1, sensors=AIDED, true_sensors=AIDED.replace(barometer=None))
    with pytest.raises(ValueError, match="magnetometer rate"):
        FlightBatch(1, sensors=AIDED, true_sensors=AIDED.with_rates(magnetometer=25.0))


def test_observation_and_info_contain_aid_measurements():
    shown = {"observation": "measurements", "innovations": True, "control_rate": 50}
    env = gymnasium.make("QuadGym/Hover-v0", sensors=AIDED, **shown)
    observation, _ = env.reset(seed=3)
    flights = env.unwrapped.flights
    table = {field.name: field.slice for field in flights.table}
    for _ in range(3):
        observation, _, _, _, info = env.step(np.zeros(4, np.float32))
        measured = flights.batch.record("measurement")[0, AID_BLOCKS:]
        np.testing.assert_allclose(observation[table["barometer"]], measured[0, :1], rtol=1e-6)
        scaled = measured[1] / AIDED.magnetometer.strength
        np.testing.assert_allclose(observation[table["magnetometer"]], scaled, rtol=1e-6)
        assert observation[table["barometer_valid"]] == 1
        assert observation[table["magnetometer_valid"]] == 1
    found = info["innovations"]
    assert found["nis"].shape == (5,)  # position, baseline, velocity, barometer, magnetometer
    assert found["measured"][3:].all()
    ratio = found["innovation"][3, 0] / found["sigma"][3, 0]
    assert found["nis"][3] == pytest.approx(ratio**2, rel=1e-9)
    assert np.isfinite(found["innovation"][4]).all()
    env.close()
