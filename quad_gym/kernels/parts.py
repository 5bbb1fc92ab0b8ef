"""Entries that run one part of a tick on a range of blocks: for timing, not for flying."""

from enum import IntEnum

from quad_gym.kernels.batch import _write_rows
from quad_gym.kernels.compiling import entry
from quad_gym.kernels.filter.predict import predict
from quad_gym.kernels.filter.update import update
from quad_gym.kernels.sensors.measure import (
    drift_biases,
    measure_features,
    measure_gnss,
    measure_imu,
)
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.kernels.task.observation import observe
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.kernels.task.reward import judge
from quad_gym.kernels.vehicle.control import act
from quad_gym.kernels.vehicle.dynamics import integrate


class Part(IntEnum):
    """A part of a tick; the filter has entries of its own."""

    CONTROL = 0
    """the reference, and the report's controller"""
    DYNAMICS = 1
    """Runge-Kutta step of the true state"""
    SENSORS = 2
    """biases, IMU, GNSS and camera with their random numbers"""
    TASK = 3
    """reward, endings and observation"""


@entry
def run_part(blocks, part, world, model, settings, work, low, high, observations):
    """Run a part of a tick once for every block.

    Args:
        blocks: (n_blocks,) FLIGHT_BLOCK.
        part: A `Part`.
        world, model, settings, work, low, high, observations: As for `fly`.
    """
    true, believed = lanes_of(world[0]), lanes_of(model[0])
    todo, scratch = settings[0], lanes_of(work[0])
    for index in range(len(blocks)):
        flight = lanes_of(blocks[index])
        everyone = flight.tick >= 0.0
        if part == Part.CONTROL:
            reference = evaluate_reference(flight, flight.tick * believed.dt)
            act(flight, believed, todo.control, reference)
        elif part == Part.DYNAMICS:
            integrate(flight, true, todo.substeps)
        elif part == Part.SENSORS:
            drift_biases(flight, true)
            measure_imu(flight, true, everyone)
            measure_gnss(flight, true, everyone)
            measure_features(flight, true, todo.feature_count, everyone)
        else:
            judge(flight, believed, todo, everyone)
            observe(flight, believed, todo, scratch.observation)
            scratch.begins = select(everyone, 1.0, 0.0)
            _write_rows(work[0].observation, low, high, observations, index, work[0].begins)


@entry
def filter_cycle_of_blocks(blocks, model, work, feature_count, form):
    """Update and predict the filters of every block, eight flights at a time."""
    believed, scratch = lanes_of(model[0]), lanes_of(work[0])
    for index in range(len(blocks)):
        flight = lanes_of(blocks[index])
        update(flight, believed, scratch, feature_count, flight.tick >= 0.0, form)
        predict(flight, believed, scratch, form)


@entry
def filter_cycle_of_flights(flights, model, work, feature_count, form):
    """Update and predict the filter of every flight: the scalar instance of the same kernels."""
    for index in range(len(flights)):
        update(flights[index], model[0], work[0], feature_count, True, form)
        predict(flights[index], model[0], work[0], form)
