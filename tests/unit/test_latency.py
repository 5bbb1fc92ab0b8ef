"""Measurements that arrive late, with their time stamps."""

import numpy as np
import pytest
from scipy.linalg import block_diag

import quad_gym
from quad_gym.records import POSITION_BLOCK, WIDTH, FilterStatus, Source
from tests.field_flights import fly, measured_now, nees, small_euler_angles, steps
from tests.reference_late import Rewinding
from tests.reference_ukf import PlainEKF, PlainUKF

RTK, INDOOR = (quad_gym.sensor_suite(name).simplified() for name in ("rtk", "indoor"))
DT = RTK.imu.dt
ESTIMATE = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat", "L")


def late(suite, gnss=None, camera=None, **choices):
    """A suite whose sensors have these latencies [s]; None leaves a sensor as it is."""
    changes = {"estimator": suite.estimator.replace(**choices)}
    for name, latency in (("gnss", gnss), ("camera", camera)):
        if latency is not None:
            changes[name] = getattr(suite, name).replace(latency=latency)
    return suite.replace(**changes)


def corrected_lab(kind="ukf", quiet=False, drift=False, **latencies):
    """The sensors of `lab` at field rates, with the corrected filter and without a gate."""
    lab = quad_gym.sensor_suite("lab").with_rates(gnss=10.0, camera=25.0)
    imu = lab.imu.replace(samples="average")
    if quiet:
        noise = dict.fromkeys(("accel_noise_density", "gyro_noise_density"), 1e-7)
        imu = imu.replace(**noise, accel_bias_tau=1e7, gyro_bias_tau=1e7)
    gnss, camera = lab.gnss.replace(phase=0.15), lab.camera.replace(phase=0.5, pixel_sigma=3.0)
    if drift:
        slow = {"drift_sigma_I": (0.6, 0.6, 1.0), "position_sigma_I": (0.2, 0.2, 0.4)}
        gnss, camera = gnss.replace(**slow), None
    suite = lab.replace(imu=imu, gnss=gnss, camera=camera)
    choices = {"kind": kind, "integration": "midpoint", "attitude_reset": True}
    choices |= {"bearing_noise_at": "pinhole", "reuse_first_fix": False}
    return late(suite, **latencies, **choices)


@pytest.mark.parametrize(
    ("gnss", "camera"),
    [(0.035, 0.015), (0.1, 0.04), (0.13, 0.055), (0.2, 0.08), (0.0, 0.06), (0.11, 0.0)],
)
def test_a_measurement_arrives_after_its_latency_as_it_was_taken(gnss, camera):
    """Latencies are up to two periods. Both batches fly on the truth, with equal measurements."""
    task = {"task": "circle", "start": "hover", "source": Source.TRUTH}
    prompt, delayed = fly(RTK, 20, **task), fly(late(RTK, gnss, camera), 20, **task)
    waits = {"gnss": round(gnss / DT), "camera": round(camera / DT)}
    history, fixes, images = [], 0, 0
    for tick in range(150):
        taken = {name: prompt.record(name) for name in ("gnss_position", "gnss_baseline", "pixels")}
        taken |= {"gnss_velocity": prompt.record("gnss_velocity"), "valid": measured_now(prompt)}
        history.append(taken)
        valid = measured_now(delayed)
        for wait, blocks in ((waits["gnss"], slice(0, 3)), (waits["camera"], slice(3, None))):
            then = history[tick - wait]["valid"] if tick >= wait else np.zeros_like(valid)
            np.testing.assert_array_equal(valid[:, blocks], then[:, blocks])
        arrived = np.flatnonzero(valid[:, 0])
        then = history[max(tick - waits["gnss"], 0)]
        for name in ("gnss_position", "gnss_baseline", "gnss_velocity"):
            np.testing.assert_array_equal(delayed.record(name)[arrived], then[name][arrived])
        seen, then = valid[:, 3:], history[max(tick - waits["camera"], 0)]
        np.testing.assert_array_equal(delayed.record("pixels")[seen], then["pixels"][seen])
        fixes, images = fixes + arrived.size, images + seen.any(axis=1).sum()
        prompt.step()
        delayed.step()
    assert fixes > 20 * 4
    assert images > 20 * 10


def deviations_from_the_reference(suite, plain, seconds=1.0):
    """Worst differences of the mean, in claimed standard deviations, and of the scaled covariance,
    on a circle, from a filter that repeats all steps since the time stamp."""
    start_filter = "cold" if suite.drifts else "warm"
    batch = fly(suite, 1, task="circle", start="hover", filter_start=start_filter)
    start = plain(suite.replace(gnss=suite.gnss.replace(latency=0.0)))
    for name in ("r", "v", "R", "b_a", "b_g"):
        setattr(start, name, batch.record(f"{name}_hat")[0])
    start.P = batch.covariance()[0]
    if suite.drifts:
        start.d = batch.record("drift_hat")[0]
        start.P = block_diag(start.P, 1e-20 * np.eye(3))
    reference = Rewinding(start)
    waits = [round(s.latency / DT) if s is not None else 0 for s in (suite.gnss, suite.camera)]
    worst, arrivals = np.zeros(2), 0
    for _ in range(round(seconds / DT)):
        batch.step()
        valid = measured_now(batch)[0]
        reference.predict(batch.record("gyro")[0], batch.record("accel")[0])
        if valid[0]:
            position, baseline = (batch.record(f"gnss_{n}")[0] for n in ("position", "baseline"))
            fix = {"gnss_position_G": position, "gnss_baseline_G": baseline}
            reference.update(reference.tick - waits[0], **fix)
        if valid[3:].any():
            pixels = np.where(valid[3:5, np.newaxis], batch.record("pixels")[0, :2], np.nan)
            reference.update(reference.tick - waits[1], pixels=pixels)
        if valid.any():
            arrivals += 1
            there, sigma = reference.plain, np.sqrt(np.diag(reference.plain.P))
            vectors = ("r", "v", "b_a", "b_g")
            parts = [batch.record(f"{n}_hat")[0] - getattr(there, n) for n in vectors]
            parts.insert(2, small_euler_angles(batch.record("R_hat") @ there.R.T)[0])
            P = batch.covariance()[0]
            if suite.drifts:
                parts.append(batch.record("drift_hat")[0] - there.d)
                L = np.vstack([np.pad(batch.record("L")[0], ((0, 0), (0, 3))),
                               batch.record("L_drift")[0]])  # fmt: skip
                P = L @ L.T
            off = np.abs(P - there.P) / np.outer(sigma, sigma)
            found = np.abs(np.concatenate(parts) / sigma).max(), off.max()
            worst = np.maximum(worst, found)
    assert arrivals > 25
    return worst


@pytest.mark.parametrize(
    ("plain", "quiet", "gnss", "camera", "bounds"),
    [
        (PlainUKF, False, 0.1, 0.06, (0.15, 0.02)),
        (PlainEKF, False, 0.1, 0.06, (0.15, 0.02)),
        (PlainUKF, True, 0.1, 0.06, (0.1, 1e-3)),
        (PlainEKF, True, 0.1, 0.06, (0.1, 1e-3)),
        (PlainUKF, True, 0.2, 0.08, (0.15, 2e-3)),
        (PlainUKF, True, 0.2, 0.06, (0.15, 2e-3)),
        (PlainUKF, True, 0.1, 0.08, (0.15, 2e-3)),
        (PlainUKF, False, 0.1, None, (0.15, 0.1)),  # with GNSS that drifts
    ],
)
def test_late_measurements_agree_with_a_filter_that_repeats_all_steps(
    plain, quiet, gnss, camera, bounds
):
    """Differences are of second order, or due to IMU noise that measurements in between correct.
    With a latency of two periods, one measurement is taken when another arrives."""
    kind = "ekf" if plain is PlainEKF else "ukf"
    drift, seconds = camera is None, 1.5 if camera is None or gnss == 0.2 or camera == 0.08 else 1.0
    seconds = 3.0 if drift else seconds
    suite = corrected_lab(kind, quiet, drift, gnss=gnss, camera=camera)
    mean, covariance = deviations_from_the_reference(suite, plain, seconds)
    assert mean < bounds[0], mean
    assert covariance < bounds[1], covariance


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("name", ["rtk", "indoor"])
def test_nees_is_consistent_only_with_delay_compensation(name, kind):
    """Means over 400 flights lie within five standard deviations; longer flights test the band."""
    suite = quad_gym.sensor_suite(name)
    latencies = {"camera": 0.06} if suite.gnss is None else {"gnss": 0.11, "camera": 0.06}
    suite = late(suite, **latencies, kind=kind)
    informed = fly(suite, 400, filter_start="warm")
    fresh = late(suite, delay_compensation="none", false_alarm_probability=0.0)
    ignorant = fly(fresh, 400, filter_start="warm")
    means = {"informed": [], "ignorant": []}
    for _ in range(8):
        for label, batch in (("informed", informed), ("ignorant", ignorant)):
            steps(batch, 0.25)
            means[label].append(nees(batch).mean())
    bound = 5 * np.sqrt(2 * 15 / 400)
    assert np.abs(np.array(means["informed"]) - 15.0).max() < bound, means
    assert min(means["ignorant"][-4:]) > 15.0 + 2 * bound, means
    assert not informed.record("filter_status").any()
    assert (informed.record("rejections").sum(axis=1) > 0).mean() < 0.05


@pytest.mark.parametrize(
    "seconds",
    [
        60,
        # three hours of flight take a minute
        pytest.param(3 * 3600, marks=pytest.mark.slow),
    ],
)
def test_estimated_attitude_with_late_measurements_remains_a_rotation(seconds):
    """It is multiplied by the sums of the IMU at each update, which must not drift off either."""
    batch = fly(quad_gym.sensor_suite("rtk"), WIDTH, task="hover", control_rate=50.0)
    for _ in range(50 * seconds):
        batch.step()
    for name in ("R_hat", "imu_turn"):
        R = batch.record(name)
        assert np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12, name
    assert np.abs(batch.record("imu_position")).max() < 10.0
    assert not batch.record("filter_status").any()


def test_failed_late_measurement_leaves_the_estimate():
    suite = late(RTK.replace(gnss=RTK.gnss.replace(phase=0.25), camera=None), gnss=0.05)
    batch = fly(suite, 10, task="hover")
    steps(batch, 6 * DT)  # one fix is still to arrive, at tick 15
    bad, none = batch.snapshot(), batch.snapshot()
    assert (bad["waiting_valid"][:, POSITION_BLOCK, 0] == 1.0).any()
    bad["waiting"][0, POSITION_BLOCK, 0, 1, ::2] = np.nan
    bad["corrected"], bad["corrected_variance"] = 1.0, 1e9
    none["waiting_valid"][0, :3, 0, ::2] = 0.0
    after, failed = [], np.isin(np.arange(10), np.arange(0, WIDTH, 2))
    for start in (bad, none):
        batch.restore(start)
        steps(batch, 9 * DT)
        after.append({name: batch.record(name) for name in ESTIMATE})
        expected = FilterStatus.UPDATE_FAILED * (failed & (start is bad))
        np.testing.assert_array_equal(batch.record("filter_status"), expected)
        if start is bad:
            for name in ("corrected", "corrected_variance"):
                np.testing.assert_array_equal((batch.record(name) == 0.0).all(axis=1), failed)
    for name in ESTIMATE:
        np.testing.assert_array_equal(after[0][name], after[1][name], err_msg=name)


def test_delay_compensation_has_no_effect_without_latency():
    flown = [fly(late(RTK, delay_compensation=choice), 20) for choice in ("retrodict", "none")]
    for batch in flown:
        steps(batch, 0.5)
    one, other = (batch.snapshot() for batch in flown)
    for name in set(one.dtype.names) - {"configuration"}:
        assert one[name].tobytes() == other[name].tobytes(), name


def test_episode_begins_without_pending_measurements():
    suite = late(RTK.replace(gnss=RTK.gnss.replace(phase=0.25)), gnss=0.1, camera=0.06)
    batch = fly(suite, 4)
    for _ in range(2):
        for _ in range(24):
            batch.step()
            assert not batch.record("block_valid")[:, POSITION_BLOCK].any()
        batch.step()
        assert batch.record("block_valid")[:, POSITION_BLOCK].all()
        steps(batch, 0.7)
        batch.reset()


def test_invalid_latencies_are_refused():
    for params, label in ((RTK.gnss, "GnssParams"), (RTK.camera, "CameraParams")):
        for latency in (-0.1, np.nan, "soon"):
            with pytest.raises(ValueError, match=rf"{label}\.latency"):
                params.replace(latency=latency)
    with pytest.raises(ValueError, match=r"GnssParams\.latency must be at most 2 per.* 0\.2 s"):
        late(RTK, gnss=0.21)
    with pytest.raises(ValueError, match=r"CameraParams\.latency must be at most 2 periods"):
        late(INDOOR, camera=0.06).with_rates(camera=50.0)
    with pytest.raises(ValueError, match=r"true_sensors must have the GNSS rate"):
        fly(RTK.with_rates(gnss=20.0), 1, true_sensors=late(RTK, gnss=0.15))
    with pytest.raises(ValueError, match="delay_compensation must be one of retrodict, none"):
        RTK.estimator.replace(delay_compensation="drop")
