"""Which sensors measure at the present instant, and when they measure next."""

from quad_gym.kernels.compiling import Stage, call_stage, kernel, stage
from quad_gym.kernels.maths.elementary import minimum
from quad_gym.kernels.maths.linalg import add, keep3, load3, load4, store3
from quad_gym.kernels.maths.random import six_normals, stream_of
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.measurements import baseline, features, position, velocity
from quad_gym.kernels.measurements.position import drift_gnss
from quad_gym.kernels.sensors.faults import gnss_heard
from quad_gym.kernels.sensors.imu import measure_imu
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import DRAW_GNSS

_DISTURB_IMU, _TURN_BASELINE = int(Stage.DISTURB_IMU), int(Stage.TURN_BASELINE)
_LIMIT_CAMERA, _HIDE_FEATURES = int(Stage.LIMIT_CAMERA), int(Stage.HIDE_FEATURES)
_SATURATE_IMU = int(Stage.SATURATE_IMU)
_FEEL_GROUND = int(Stage.FEEL_GROUND)
_CORRUPT_GNSS, _CORRUPT_FEATURES = int(Stage.CORRUPT_GNSS), int(Stage.CORRUPT_FEATURES)


@kernel
def _sample_imu(flight, world, settings, work, stages, mask, starting):
    """Sample the IMU, where `mask`."""
    measure_imu(flight, world, mask)
    work.mask = select(mask, 1.0, 0.0)
    if settings.grounded:
        call_stage(stages, _FEEL_GROUND, flight, world, world, settings, work, 0)
    if settings.imu_errs + settings.imu_vibrates > 0:
        call_stage(stages, _DISTURB_IMU, flight, world, world, settings, work, 0)
    if starting:
        keep3(flight.w_before, mask, load3(flight.w_meas))
    if settings.faults:
        call_stage(stages, _SATURATE_IMU, flight, world, world, settings, work, 0)


@kernel
def measure_gnss(flight, p, paired, mask):
    """Measure antenna position, and the baseline if there is one (`paired`), in G, where `mask`."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    n_p, n_b = six_normals(stream_of(flight), DRAW_GNSS)
    position.measure(flight, p, R_BI, n_p, mask)
    if paired:
        baseline.measure(flight, p, R_BI, n_b, mask)


@kernel
def _sample_gnss(flight, world, settings, work, stages, mask, starting):
    """Measure by GNSS where it is due, and the place of the start for the filter to start from."""
    due = mask & (flight.gnss_wait <= 0.0) & (settings.gnss_ticks > 0)
    if settings.gnss_drifts > 0 and not starting and any_of(due):
        share = minimum(flight.tick / settings.gnss_ticks, 1.0)
        drift_gnss(flight, world, due, share)
    measured = mask if starting else due
    paired = measured
    sound = starting and not settings.warm  # the fix that starts the filter
    if settings.faults and not sound:
        measured, paired = gnss_heard(flight, settings, due)
    if any_of(measured):
        measure_gnss(flight, world, settings.gnss_baseline > 0, measured)
        if settings.heading_errs:
            work.mask = select(measured, 1.0, 0.0)
            call_stage(stages, _TURN_BASELINE, flight, world, world, settings, work, 0)
        if settings.faults and not sound:
            work.mask = select(measured, 1.0, 0.0)
            call_stage(stages, _CORRUPT_GNSS, flight, world, world, settings, work, 0)
        if settings.gnss_velocity > 0:
            velocity.measure(flight, world, measured)
    wait = select(due, 1.0 * settings.gnss_ticks, flight.gnss_wait) - 1.0
    flight.gnss_wait = select(mask, wait, flight.gnss_wait)
    if settings.gnss_baseline == 0:
        paired = paired & logical_not(measured)
    fresh, alone = measured & (settings.gnss_ticks > 0), measured & logical_not(paired)
    fresh = fresh & (starting or settings.gnss_delay == 0)
    flight.position_fresh = select(fresh, 1.0, flight.position_fresh)
    flight.baseline_fresh = select(fresh, 1.0, flight.baseline_fresh)
    flight.baseline_fresh = select(fresh & alone, 0.0, flight.baseline_fresh)
    if starting and settings.reuse_first_fix == 0 and not settings.warm:
        due = due & (settings.gnss_ticks < 0)
    valid = select(due & measured, 1.0, 0.0)
    flight.position_valid = select(mask, valid, flight.position_valid)
    flight.baseline_valid = select(mask, select(alone, 0.0, valid), flight.baseline_valid)
    if settings.gnss_velocity > 0:
        flight.velocity_valid = select(mask, valid, flight.velocity_valid)


@kernel
def _sample_camera(flight, world, settings, work, stages, mask):
    """Take an image where one is due."""
    period = 1.0 * settings.camera_ticks
    due = mask & (flight.camera_wait <= 0.0)
    for i in range(settings.feature_count):
        flight.feature_valid[i] = select(mask, 0.0, flight.feature_valid[i])
    if any_of(due):
        features.measure(flight, world, settings.feature_count, due)
        if settings.camera_limited:
            work.mask = select(due, 1.0, 0.0)
            call_stage(stages, _LIMIT_CAMERA, flight, world, world, settings, work, 0)
        if settings.obstacle_count > 0:
            work.mask = select(due, 1.0, 0.0)
            call_stage(stages, _HIDE_FEATURES, flight, world, world, settings, work, 0)
        if settings.faults:
            work.mask = select(due, 1.0, 0.0)
            call_stage(stages, _CORRUPT_FEATURES, flight, world, world, settings, work, 0)
    wait = select(due, period, flight.camera_wait) - 1.0
    flight.camera_wait = select(mask, wait, flight.camera_wait)
    for i in range(settings.feature_count):
        seen = due & (flight.feature_valid[i] > 0.0) & (settings.camera_delay == 0)
        flight.feature_fresh[i] = select(seen, 1.0, flight.feature_fresh[i])


@stage
def sample_stage(flight, world, model, settings, work, stages, flag):
    """Measure at the present instant; `flag`: whether an episode begins."""
    flying, true, scratch = lanes_of(flight), lanes_of(world), lanes_of(work)
    mask, starting = scratch.mask > 0.0, flag > 0
    if starting or not settings.imu_averages:  # at its start an average has nothing behind it
        _sample_imu(flying, true, settings, scratch, stages, mask, starting)
    _sample_gnss(flying, true, settings, scratch, stages, mask, starting)
    if settings.camera_ticks > 0:
        _sample_camera(flying, true, settings, scratch, stages, mask)
    scratch.mask = select(mask, 1.0, 0.0)


@stage
def sum_imu_stage(flight, world, model, settings, work, stages, flag):
    """Add the newest IMU sample to the sum since the last step."""
    here = lanes_of(flight)
    store3(here.gyro_sum, add(load3(here.gyro_sum), load3(here.gyro)))
    store3(here.accel_sum, add(load3(here.accel_sum), load3(here.accel)))
