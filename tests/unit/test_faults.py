"""Faults: times and effects, against the same flights without faults. A fault changes no other
draw, so on the true state the difference between both flights is the effect of the fault."""

import math
from enum import IntEnum

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.faults import (
    ALL,
    PRESETS,
    AccelBiasStep,
    BaselineLoss,
    CameraOcclusion,
    GnssJump,
    GnssOutage,
    GnssOutliers,
    GnssRamp,
    GyroBiasStep,
    ImuSaturation,
    MagnetometerDisturbance,
    PositionJump,
    RotorLoss,
    WrongAssociations,
    faults_of,
)
from quad_gym.frames import ecef_to_enu
from quad_gym.params.sensor_table import AID_PARAMS
from quad_gym.records import (
    AID_BLOCKS,
    BASELINE_BLOCK,
    FEATURE_SLICE,
    POSITION_BLOCK,
    Aid,
    FaultKind,
    Source,
    enums,
)
from quad_gym.rotations import quaternion_to_dcm
from tests.field_flights import fly
from tests.unit.alarms import ALARM, alarm_score

LAB, RTK = quad_gym.sensor_suite("lab"), quad_gym.sensor_suite("rtk").simplified()
AIDED = RTK.replace(
    barometer=quad_gym.BarometerParams(), magnetometer=quad_gym.MagnetometerParams()
)
DT = LAB.imu.dt
BLIND = LAB.replace(camera=None)
R_IG = ecef_to_enu(LAB.gnss.reference_antenna_G)


def both(sensors, faults, count=16, **options):
    """Return flights on the true state without faults, and the same flights with faults."""
    options = {"source": Source.TRUTH, "run_filter": True, "threads": 1} | options
    return tuple(fly(sensors, count, faults=given, **options) for given in (None, faults))


def step(*batches):
    for batch in batches:
        batch.step()


def at(kind, batch, name="fault_active"):
    return batch.record(name)[:, kind]


def test_scheduled_fault_is_active_from_start_to_end():
    faults = (GnssOutage(start=0.1, duration=0.05), BaselineLoss(), ImuSaturation(start=0.2))
    batch = fly(BLIND, 3, faults=faults, threads=1)
    for tick in range(1, 61):
        batch.step()
        now = batch.active_faults()
        assert list(now) == ["gnss_outage", "baseline_loss", "imu_saturation"]
        assert (now["gnss_outage"] == (20 <= tick < 30)).all()
        assert now["baseline_loss"].all()
        assert (now["imu_saturation"] == (tick >= 40)).all()
    assert (at(FaultKind.GNSS_OUTAGE, batch, "fault_count") == 1.0).all()


def test_random_times_are_uniform_and_some_episodes_have_no_fault():
    fault = GnssOutage(start=(1.0, 3.0), duration=(0.5, 4.5), probability=0.7)
    batch = fly(BLIND, 4000, faults=fault, threads=1)
    begins, ends = (at(fault.kind, batch, f"fault_{name}") * DT for name in ("from", "until"))
    concerned = begins < 1e9
    assert stats.binomtest(concerned.sum(), 4000, 0.7).pvalue > ALARM
    assert stats.kstest(begins[concerned], stats.uniform(1.0, 2.0).cdf).pvalue > ALARM
    lengths = (ends - begins)[concerned]
    assert stats.kstest(lengths, stats.uniform(0.5, 4.0).cdf).pvalue > ALARM
    assert abs(np.corrcoef(begins[concerned], lengths)[0, 1]) * math.sqrt(2800) < alarm_score(1)


def test_a_fault_with_a_rate_comes_again_after_exponential_waits():
    fault = GnssOutage(rate=20.0, duration=(0.05, 0.15), probability=0.5)
    batch = fly(BLIND, 800, faults=fault, threads=1)
    begun = at(fault.kind, batch, "fault_from")
    concerned = begun < 1e9
    assert stats.binomtest(concerned.sum(), 800, 0.5).pvalue > ALARM
    waits = [begun[concerned] * DT]
    for _ in range(200):
        before, until = begun, at(fault.kind, batch, "fault_until")
        batch.step()
        begun = at(fault.kind, batch, "fault_from")
        anew = concerned & (begun != before)
        now = np.ceil(until[anew])  # the tick at which the next one is drawn
        waits.append((begun[anew] - now) * DT)
    np.testing.assert_array_equal(begun[~concerned], 1e18)
    waits = np.concatenate(waits)
    assert len(waits) > 2000
    assert stats.kstest(waits, stats.expon(scale=1 / 20.0).cdf).pvalue > ALARM
    counts = at(fault.kind, batch, "fault_count")
    # renewals with a mean wait of 0.05 s and a mean duration of 0.1 s, within one second
    assert 5.0 < counts[concerned].mean() < 7.5
    assert (counts[~concerned] == 0.0).all()


def test_a_fault_that_never_comes_changes_no_bit():
    later = tuple(
        fault.replace(start=1e6, **({"size": (1.0, 2.0)} if hasattr(fault, "size") else {}))
        for fault in faults_of(ALL, AIDED)
    )
    assert len(later) == len({fault.kind for fault in later}) > 10
    calm, faulty = both(AIDED, later, source=Source.ESTIMATE)
    for _ in range(200):
        step(calm, faulty)
    for name in ("r", "v", "q", "w", "b_a", "b_g", "r_hat", "v_hat", "R_hat", "L", "pixels"):
        np.testing.assert_array_equal(calm.record(name), faulty.record(name), err_msg=name)
    assert not any(active.any() for active in faulty.active_faults().values())


def test_a_new_episode_begins_without_the_faults_of_the_last():
    faults = (GnssOutage(start=0.5), AccelBiasStep(start=0.5), RotorLoss(start=0.5, share=0.5))
    batch = fly(BLIND, 4, faults=faults, threads=1)
    for _ in range(101):
        batch.step()
    assert all(active.all() for active in batch.active_faults().values())
    assert (batch.record("rotor_gain").min(axis=1) == 0.5).all()
    batch.reset(mask=np.array([True, False, True, False]))
    for active in batch.active_faults().values():
        np.testing.assert_array_equal(active, [False, True, False, True])
    np.testing.assert_array_equal(batch.record("rotor_gain").min(axis=1), [1.0, 0.5, 1.0, 0.5])


def test_an_outage_takes_the_fixes_away_and_changes_nothing_else():
    faults = (GnssOutage(start=0.1, duration=0.1), BaselineLoss(start=0.15, duration=0.1))
    calm, faulty = both(BLIND, faults, count=3)
    for tick in range(1, 61):
        step(calm, faulty)
        heard, paired = not 20 <= tick < 40, not 20 <= tick < 50
        assert (faulty.record("block_valid")[:, POSITION_BLOCK] == heard).all()
        assert (faulty.record("block_valid")[:, BASELINE_BLOCK] == paired).all()
        assert (faulty.record("block_fresh")[:, POSITION_BLOCK] == heard).all()
        assert (faulty.record("block_fresh")[:, BASELINE_BLOCK] == paired).all()
        np.testing.assert_array_equal(calm.record("r"), faulty.record("r"))
        if heard:
            fixes = (flights.record("gnss_position") for flights in (calm, faulty))
            np.testing.assert_array_equal(*fixes)


def offsets(calm, faulty, ticks):
    """Return the errors (ticks, flights, 3) that faults add to GNSS positions, in I."""
    found = []
    for _ in range(ticks):
        step(calm, faulty)
        found.append((faulty.record("gnss_position") - calm.record("gnss_position")) @ R_IG.T)
    return np.array(found)


@pytest.mark.parametrize("name", ["lab", "consumer"])
def test_outliers_have_their_share_size_and_any_direction(name):
    suite = quad_gym.sensor_suite(name).simplified().replace(camera=None)
    suite = suite.with_rates(gnss=200.0)
    calm, faulty = both(suite, GnssOutliers(share=0.05, size=(10.0, 100.0)), count=200)
    found, told = [], []
    for _ in range(100):
        found.append(offsets(calm, faulty, 1)[0])
        told.append(faulty.record("outlier") > 0.0)
    found, told = np.concatenate(found), np.concatenate(told)
    gnss = suite.gnss
    sigma = np.hypot(gnss.position_sigma_I, gnss.drift_sigma_I)
    sizes = np.linalg.norm(found / sigma, axis=1)
    np.testing.assert_array_equal(sizes > 1e-6, told)
    assert stats.binomtest(int(told.sum()), told.size, 0.05).pvalue > ALARM
    assert stats.kstest(sizes[told], stats.uniform(10.0, 90.0).cdf).pvalue > ALARM
    directions = (found / sigma)[told] / sizes[told, np.newaxis]
    for component in directions.T:  # each is uniform for a direction uniform on the sphere
        assert stats.kstest(component, stats.uniform(-1.0, 2.0).cdf).pvalue > ALARM


def test_a_ramp_grows_with_time_and_a_jump_stays():
    ramp = GnssRamp(start=0.1, duration=0.2, speed=(0.5, 1.0))
    jump = GnssJump(start=0.5, duration=0.1, size=2.0, direction=(0.0, 3.0, 4.0))
    calm, faulty = both(BLIND, (jump, ramp), count=200)
    found = offsets(calm, faulty, 130)
    during = found[19:59]  # ticks 20 to 59
    speeds = np.linalg.norm(during[-1], axis=1) / (39 * DT)
    assert stats.kstest(speeds, stats.uniform(0.5, 0.5).cdf).pvalue > ALARM
    expected = during[-1] * np.arange(40)[:, np.newaxis, np.newaxis] / 39
    np.testing.assert_allclose(during, expected, rtol=0.0, atol=1e-8)
    steady = np.broadcast_to([0.0, 1.2, 1.6], (20, 200, 3))
    np.testing.assert_allclose(found[99:119], steady, rtol=0.0, atol=1e-8)
    for quiet in (found[:19], found[59:99], found[119:]):
        np.testing.assert_allclose(quiet, 0.0, atol=1e-8)


def test_occlusion_hides_the_same_features_while_it_lasts():
    suite = quad_gym.sensor_suite("indoor").simplified().with_rates(camera=200.0)
    calm, faulty = both(suite, CameraOcclusion(start=0.1, duration=0.1, share=0.4), count=300)
    for tick in range(1, 51):
        step(calm, faulty)
        seen, left = (b.record("block_valid")[:, FEATURE_SLICE] for b in (calm, faulty))
        hidden = faulty.record("feature_hidden") * (20 <= tick < 40)
        np.testing.assert_array_equal(left, seen * (1.0 - hidden))
        if tick == 20:
            first = hidden
            assert stats.binomtest(int(hidden.sum()), hidden.size, 0.4).pvalue > ALARM
        elif 20 < tick < 40:
            np.testing.assert_array_equal(hidden, first)


@pytest.mark.parametrize("how", ["swap", "copy"])
def test_wrong_associations_swap_or_copy_visible_features(how):
    suite = quad_gym.sensor_suite("indoor").simplified().with_rates(camera=200.0)
    calm, faulty = both(suite, WrongAssociations(share=0.3, how=how), count=100)
    images = changed = 0
    places = []
    for _ in range(50):
        step(calm, faulty)
        seen = faulty.record("block_valid")[:, FEATURE_SLICE] > 0.0
        np.testing.assert_array_equal(seen, calm.record("block_valid")[:, FEATURE_SLICE] > 0.0)
        right, wrong = calm.record("pixels"), faulty.record("pixels")
        mistaken = faulty.record("feature_mistaken") > 0.0
        for i in np.flatnonzero(seen.sum(axis=1) >= 2):
            differs = seen[i] & (right[i] != wrong[i]).any(axis=1)
            np.testing.assert_array_equal(differs, mistaken[i])
            images += 1
            if not differs.any():
                continue
            changed += 1
            which = np.flatnonzero(differs)
            assert len(which) == (2 if how == "swap" else 1)
            if how == "swap":
                np.testing.assert_array_equal(wrong[i, which], right[i, which[::-1]])
            else:
                sources = (right[i] == wrong[i, which[0]]).all(axis=1) & seen[i]
                assert sources.sum() == 1
            places.append((np.flatnonzero(seen[i]).tolist().index(which[0]), seen[i].sum()))
    assert images > 1000
    assert stats.binomtest(changed, images, 0.3).pvalue > ALARM
    three = [place for place, count in places if count == 3]
    if how == "copy" and three:  # each visible one is equally likely
        assert stats.chisquare(np.bincount(three, minlength=3)).pvalue > ALARM


def test_a_bias_step_is_part_of_the_true_bias_while_it_lasts():
    steps = (
        AccelBiasStep(start=0.1, duration=0.3, size=(0.05, 0.2)),
        GyroBiasStep(start=0.2, duration=0.3, size=0.01, direction=(1.0, 0.0, 0.0)),
    )
    calm, faulty = both(BLIND, steps, count=100)
    for tick in range(1, 121):
        step(calm, faulty)
        gap_a, gap_g = (faulty.record(name) - calm.record(name) for name in ("b_a", "b_g"))
        if tick == 20:
            first = gap_a
            sizes = np.linalg.norm(gap_a, axis=1)
            assert stats.kstest(sizes, stats.uniform(0.05, 0.15).cdf).pvalue > ALARM
        np.testing.assert_allclose(gap_a, first if 20 <= tick < 80 else 0.0, atol=1e-12)
        wanted = [0.01, 0.0, 0.0] if 40 <= tick < 100 else [0.0, 0.0, 0.0]
        np.testing.assert_allclose(gap_g, np.tile(wanted, (100, 1)), atol=1e-13)
        sensed = faulty.record("accel") - calm.record("accel")
        np.testing.assert_allclose(sensed, gap_a, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("sensors", [BLIND, RTK], ids=["instant", "average"])
def test_saturation_clips_imu_samples_to_their_ranges(sensors):
    ranges = ImuSaturation(start=0.1, accel_range=9.5, gyro_range=0.3)
    calm, faulty = both(sensors, ranges, count=50)
    clipped = 0
    for tick in range(1, 101):
        step(calm, faulty)
        a, w = (9.5, 0.3) if tick >= 20 + (sensors is RTK) else (np.inf, np.inf)
        np.testing.assert_array_equal(faulty.record("accel"), calm.record("accel").clip(-a, a))
        np.testing.assert_array_equal(faulty.record("gyro"), calm.record("gyro").clip(-w, w))
        np.testing.assert_array_equal(faulty.record("w_meas"), calm.record("w_meas").clip(-w, w))
        clipped += (abs(calm.record("accel")) > a).any() + (abs(calm.record("gyro")) > w).any()
    assert clipped > 50


def test_a_position_jump_displaces_the_vehicle_once():
    jump = PositionJump(start=0.1, size=(1.0, 2.0))
    calm, faulty = both(BLIND, jump, count=200)
    for _ in range(19):
        step(calm, faulty)
    np.testing.assert_array_equal(calm.record("r"), faulty.record("r"))
    step(calm, faulty)
    gap = faulty.record("r") - calm.record("r")
    np.testing.assert_array_equal(calm.record("v"), faulty.record("v"))
    assert stats.kstest(np.linalg.norm(gap, axis=1), stats.uniform(1.0, 1.0).cdf).pvalue > ALARM
    for component in (gap / np.linalg.norm(gap, axis=1)[:, np.newaxis]).T:
        assert stats.kstest(component, stats.uniform(-1.0, 2.0).cdf).pvalue > ALARM
    step(calm, faulty)
    np.testing.assert_allclose(faulty.record("r") - calm.record("r"), gap, atol=5e-3)


@pytest.mark.parametrize("randomization", [None, {"mass": quad_gym.Uniform(0.7, 0.9)}])
@pytest.mark.parametrize("rotor", [None, 2])
def test_a_weak_rotor_takes_its_share_of_thrust_and_torque_away(rotor, randomization):
    loss = RotorLoss(start=0.5, share=(0.2, 1.0), rotor=rotor)
    calm, faulty = both(BLIND, loss, count=100, task="hover", randomization=randomization)
    for _ in range(100):
        step(calm, faulty)
    np.testing.assert_array_equal(calm.record("w"), faulty.record("w"))
    speeds, z_I = calm.record("rotor_speeds"), quaternion_to_dcm(calm.record("q"))[:, 2]
    step(calm, faulty)
    vehicle, gain = calm.vehicle, faulty.record("rotor_gain")
    which, lost = gain.argmin(axis=1), 1.0 - gain.min(axis=1)
    assert (gain.max(axis=1) == 1.0).all()
    assert stats.kstest(lost, stats.uniform(0.2, 0.8).cdf).pvalue > ALARM
    if rotor is None:
        assert stats.chisquare(np.bincount(which, minlength=4)).pvalue > ALARM
    else:
        assert (which == rotor).all()
    each = np.arange(100)
    force = vehicle.thrust_coefficient * speeds[each, which] ** 2 * lost
    mass = vehicle.mass if randomization is None else calm.read("mass")
    dv = -(force / mass * DT)[:, np.newaxis] * z_I
    np.testing.assert_allclose(faulty.record("v") - calm.record("v"), dv, rtol=0.05, atol=2e-3)
    arm = np.array(vehicle.rotor_positions_B)[which]
    torque = np.stack([-arm[:, 1] * force, arm[:, 0] * force], axis=1)
    dw = torque / np.diag(vehicle.inertia)[:2] * DT
    measured = (faulty.record("w") - calm.record("w"))[:, :2]
    np.testing.assert_allclose(measured, dw, rtol=0.05, atol=5e-3)


def test_sensor_without_a_fault_that_silences_it_is_refused(monkeypatch):
    more = IntEnum("Aid", [(aid.name, int(aid)) for aid in Aid] + [("DEPTH", len(Aid))])
    monkeypatch.setattr(enums, "Aid", more)
    number = len(FaultKind)
    with pytest.raises(ValueError, match=f"FaultKind must have DEPTH_LOSS = {number} behind"):
        enums._losses()


def test_fault_presets_are_found_by_name():
    assert faults_of(None, LAB) == faults_of("none", LAB) == faults_of((), LAB) == ()
    kinds = {fault.kind for preset in PRESETS.values() for fault in preset}
    assert kinds <= set(FaultKind)  # some faults have no name
    named = faults_of("rotor_loss+gnss_outage", LAB)
    assert [type(fault) for fault in named] == [GnssOutage, RotorLoss]
    assert named == faults_of(["rotor_loss", PRESETS["gnss_outage"][0]], LAB)
    camera = AIDED.camera.replace(features_I=AIDED.camera.features_I[:2])
    every = AIDED.replace(camera=camera, **{name: kind() for name, kind in AID_PARAMS.items()})
    assert len(faults_of(ALL, every)) == len(kinds)
    assert len(faults_of(ALL, RTK)) == len(kinds) - len(Aid) - 1  # no aid, nor its disturbance
    for suite in ("consumer", "indoor"):
        assert 0 < len(faults_of(ALL, quad_gym.sensor_suite(suite))) < len(FaultKind)


@pytest.mark.parametrize("latency", [0.0, 0.04])
def test_disturbed_magnetometer_is_turned_near_iron_or_frozen(latency):
    suite = AIDED.replace(magnetometer=quad_gym.MagnetometerParams(rate=50.0, latency=latency))
    times, late = {"start": 0.2, "duration": 0.4}, latency + 1e-9
    found = {}
    for how in ("turned", "iron", "frozen"):
        size = {"turned": {"angle": 0.5}, "iron": {"iron": 2e-5, "direction": (0.0, 3.0, 4.0)}}
        fault = MagnetometerDisturbance(how=how, **size.get(how, {}), **times)
        calm, faulty = both(suite, fault, count=4)
        fields = []
        for _ in range(200):
            step(calm, faulty)
            measured = (batch.record("measurement")[:, AID_BLOCKS:] for batch in (calm, faulty))
            fields.append([rows[:, Aid.MAGNETOMETER] for rows in measured])
        found[how] = np.array(fields)
    t = DT * np.arange(1, 201)
    during = (t > 0.23 + late) & (t < 0.59 + late)
    for fields in found.values():
        outside = (t < 0.2 + late - DT) | (t > 0.63 + late)
        np.testing.assert_array_equal(fields[outside, 0], fields[outside, 1])
    np.testing.assert_allclose(
        found["iron"][during, 1] - found["iron"][during, 0],
        np.broadcast_to([0.0, 1.2e-5, 1.6e-5], (during.sum(), 4, 3)),
        atol=1e-15,
    )
    before, after = (found["turned"][during, k] for k in (0, 1))
    np.testing.assert_allclose(after[..., 2], before[..., 2], atol=1e-18)
    levels = [values[..., 0] + 1j * values[..., 1] for values in (before, after)]
    angles = np.angle(levels[1] / levels[0])
    np.testing.assert_allclose(np.abs(angles), 0.5, rtol=1e-9)
    assert (angles == angles[0]).all() or np.ptp(angles, axis=0).max() < 1e-9
    frozen = found["frozen"][during, 1]
    assert (frozen == frozen[0]).all()
    assert (np.ptp(found["frozen"][during, 0], axis=0) > 0.0).all()


def test_direction_of_a_turned_magnetometer_is_refused():
    with pytest.raises(ValueError, match="direction must be given with how"):
        MagnetometerDisturbance(direction=(1.0, 0.0, 0.0))
