"""The barometer: altitude by static pressure.

It measures `z = r_z + b + v` with white noise v and a slow error b, as the pressure on the ground
and the sensor's temperature change: a first-order Gauss-Markov process, which is a state of the
filter (`filter/slow.py`). The model is linear, so sigma points and derivatives agree.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D, R
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.maths.random import normal_pair, stream_of
from quad_gym.kernels.sensors.aid import aid_due, begin_aid, deliver, gate_aid
from quad_gym.kernels.sensors.stage import sensor_stage
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import AID_BLOCKS, AID_GROUPS, DRAW_AID, Aid, Sensor

_S = int(Aid.BAROMETER)
_BLOCK = AID_BLOCKS + _S


@kernel
def _begin(flight, p, settings, mask):
    begin_aid(flight, p, settings, _S, mask)


@kernel
def _sample(flight, p, settings, work, stages, mask, starting):
    """Measure when due."""
    due = aid_due(flight, p, settings, _S, mask, starting)
    n, _ = normal_pair(stream_of(flight), DRAW_AID + 2 * _S)
    altitude = flight.r[2] + flight.aid_scalar[_S] + p.aid_sigma[_S] * n
    zero = 0.0 * altitude
    deliver(flight, work, settings, _S, mask, due, (altitude, zero, zero))


@kernel
def _expect(flight, p, work, settings, k):
    """Fill rows k to k + 2: the altitude, and two masked ones."""
    valid, first = flight.block_valid[_BLOCK] > 0.0, settings.aid_scalar[_S]
    variance = p.aid_sigma[_S] * p.aid_sigma[_S]
    for i in range(3):
        work.z_hat[k + i], work.z[k + i] = 0.0 * variance, 0.0 * variance
        for j in range(3):
            work.Rz[k + i, k + j] = (1.0 if i == j else 0.0) + 0.0 * variance
    work.z_hat[k] = select(valid, flight.r_hat[2] + flight.slow_hat[first], 0.0)
    work.z[k] = select(valid, flight.aid_measurement[_S, 0], 0.0)
    work.Rz[k, k] = select(valid, variance, 1.0)
    last = D + settings.slow_states - 1
    for j in range(last + 1):
        row, value = work.A[last - j], flight.L_slow[first, j]
        if j <= R + 2:
            value = value + flight.L[R + 2, j]
        row[k] = select(valid, value, 0.0)
        row[k + 1], row[k + 2] = 0.0 * variance, 0.0 * variance
    for j in range(9):
        for i in range(3):
            work.E[j, k + i] = 0.0 * variance


@kernel
def _gate(flight, p, work, settings, k):
    gate_aid(flight, p, work, settings, _S, k, 1.0)


@kernel
def _inflate(flight, p, work, settings):
    """Inflate slow error and height to the square of a rejected innovation."""
    alarm = work.alarm[AID_GROUPS + _S] > 0.0
    nu, k = flight.innovation[_BLOCK, 0], D + settings.aid_scalar[_S]
    square = select(alarm, nu * nu, 0.0)
    work.P[k, k] = maximum(work.P[k, k], square)
    work.P[R + 2, R + 2] = maximum(work.P[R + 2, R + 2], square)


barometer_stage = sensor_stage(Sensor.BAROMETER, _begin, _sample, _expect, _gate, _inflate)
