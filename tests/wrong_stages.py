"""Stages with mistakes, for tests of what `quad-gym compile --stage` says of them."""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.linalg import load3
from quad_gym.kernels.sensors.common import aid_stage
from quad_gym.records import Aid


@kernel
def _range(r_I, anchor_I):
    offset = r_I - anchor_I
    return offset[0] * offset[0]


@kernel
def _sum(flight):
    return _range(load3(flight.r))  # an argument is missing


@kernel
def _vertical(R_BI):
    return R_BI.T[2][2]


@stage
def missing_argument_stage(flight, world, model, settings, work, stages, flag):
    """Call a kernel with too few arguments."""
    work.spread = _sum(flight)


@stage
def missing_field_stage(flight, world, model, settings, work, stages, flag):
    """Read a field that the record does not have."""
    work.spread = flight.altitude + 1.0


@stage
def wrong_type_stage(flight, world, model, settings, work, stages, flag):
    """Pass a number where a vector is expected."""
    work.spread = _range(load3(flight.r), flight.tick)


@stage
def record_stage(flight, world, model, settings, work, stages, flag):
    """Pass a record where a matrix is expected."""
    work.spread = _vertical(settings)


@stage
def missing_name_stage(flight, world, model, settings, work, stages, flag):
    """Use a name that does not exist."""
    work.spread = flight.tick * metres  # noqa: F821


@stage
def text_stage(flight, world, model, settings, work, stages, flag):
    """Write a text into a number."""
    work.spread = "far"


@kernel
def _measure_two(flight, p, i):
    return (flight.r[2], flight.r[1]), flight.r[2] > 0.0


@kernel
def _do_nothing(flight, p, work, settings, *others):
    """Placeholder of the sensor's other kernels."""


barometer_stage = aid_stage(Aid(0), _measure_two, _do_nothing, _do_nothing)
