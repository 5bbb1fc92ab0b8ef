"""Conversion of parameters to numbers in the records that kernels read."""

import functools
import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import fields
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym import records
from quad_gym.configuration import FlightConfiguration
from quad_gym.faults import Fault, Span, ends
from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.aids import SlowError
from quad_gym.params.imu import ImuParams
from quad_gym.params.randomization import FEATURE_DRAWS, DrawingTable, Randomization, nominal_values
from quad_gym.params.sensor_table import READINGS, SENSOR_PARAMS
from quad_gym.params.suites import SensorSuite, delay_ticks
from quad_gym.params.task import TaskParams
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.vehicle import ActionParams, PDGains, VehicleParams
from quad_gym.params.world import BatteryParams, GroundParams, Obstacle, WorldParams
from quad_gym.records import (
    AID_NUMBERS,
    AIDS,
    COLUMNS,
    FIRST_AID,
    FIRST_BLOCK,
    FIRST_GROUP,
    FOLLOWED,
    GROUP_COUNT,
    GROUP_FREEDOMS,
    HEADING_GIVEN,
    HEADING_TOWARD,
    HEADING_VELOCITY,
    MAX_HARMONICS,
    MAX_SLOW,
    MAX_START_VELOCITY,
    NEVER,
    PARAMETERS_DRAWN,
    PARAMS,
    PARAMS_BLOCK,
    PARAMS_FIELDS,
    PATH,
    PIECE,
    SETTINGS,
    FilterForm,
    RewardTerm,
    Sensor,
    Start,
    Supply,
    TaskKind,
    aligned_zeros,
)

# --------------------------------------------------------------------------------------------------
# The form of all records, which pickled flights and filters must share with the kernels.
# --------------------------------------------------------------------------------------------------


@functools.cache
def form_of_records() -> str:
    """Return a digest of the fields of all records, and of the members of all enumerations."""
    named = {
        name: [(member.name, repr(member.value)) for member in thing]
        if isinstance(thing, type) and issubclass(thing, Enum)
        else repr(thing)
        for name, thing in vars(records).items()
        if isinstance(thing, np.dtype) or (isinstance(thing, type) and issubclass(thing, Enum))
    }
    return hashlib.sha256(repr(sorted(named.items())).encode()).hexdigest()[:16]


OTHER_FORM = (
    "an environment, batch or filter must be unpickled with the version of quad_gym, the precision "
    "and the number of lanes with which it was pickled: make it again, for example with "
    "gymnasium.make"
)
"""Message about a pickled object whose records the kernels would misread."""


class RecordsOfOneForm:
    """Flights or a filter whose records the kernels read.

    A pickle keeps the form of the records, but neither the stages, which another version may have
    under other names, nor what belongs to a process.
    """

    def _without_process(self) -> dict[str, Any]:
        """Return the attributes with addresses or threads, as a copy begins with them."""
        raise NotImplementedError

    def _choose_stages(self) -> None:
        """Set the stages that the settings need, or raise ValueError if the records do not fit."""
        raise NotImplementedError

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without stages, addresses and threads."""
        kept = self.__dict__ | self._without_process() | {"form_of_records": form_of_records()}
        del kept["_stages"]
        return kept

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled or copied state, with the stages that this version has.

        Raises:
            ValueError: If the records of the state have another form.
        """
        if state.pop("form_of_records", None) != form_of_records():
            raise ValueError(OTHER_FORM)
        self.__dict__.update(state)
        self._choose_stages()


# --------------------------------------------------------------------------------------------------
# Aiding sensors and slow errors as numbers in the records that kernels read.
# --------------------------------------------------------------------------------------------------


class SlowStates(NamedTuple):
    """Slow errors among the states of a suite's filter, in the order of the states."""

    errors: tuple[SlowError, ...]
    """slow errors, padded to a multiple of three by constants with standard deviation one"""
    estimated: int  #: number of slow errors without the padding
    drifts: bool
    """True if the first three are the drift of a sensor, which is zero at the start"""
    vectors: tuple[int, ...]
    """index of the first of an aiding sensor's three errors, in the order of `Aid`; -1: none"""
    scalars: tuple[int, ...]
    """index of an aiding sensor's single error, in the order of `Aid`; -1: none"""

    @property
    def first_sigmas(self) -> NDArray[np.float64]:
        """(n,) standard deviations at the start."""
        sigmas = np.array([error.sigma for error in self.errors])
        sigmas[: 3 * self.drifts] = 0.0
        return sigmas


def slow_states(sensors: SensorSuite) -> SlowStates:
    """Return the slow errors that a filter estimates if it assumes these sensors."""
    errors: list[SlowError] = []
    vectors, scalars = [-1] * AIDS, [-1] * AIDS
    for sensor in sensors.sensors.values():
        errors += sensor.drift
    for aid, params in sensors.aids.items():
        if params.assumed_vector is not None:
            vectors[aid] = len(errors)
            errors += [params.assumed_vector] * 3
    for aid, params in sensors.aids.items():
        if params.slow_scalar is not None:
            scalars[aid] = len(errors)
            errors.append(params.slow_scalar)
    count = len(errors)
    if count > MAX_SLOW:
        raise ValueError(
            f"sensors must have at most {MAX_SLOW} time-correlated errors for the filter to "
            f"estimate, got {count}"
        )
    errors += [SlowError(1.0)] * (-count % 3)
    return SlowStates(tuple(errors), count, sensors.drifts, tuple(vectors), tuple(scalars))


def blocks_of(sensors: SensorSuite) -> tuple[int, ...]:
    """Return the blocks of innovations of a suite, in the order of its readings."""
    counts = sensor_blocks(sensors)
    return tuple(
        first + k for first, count in zip(FIRST_BLOCK, counts, strict=True) for k in range(count)
    )


def sensor_blocks(sensors: SensorSuite) -> tuple[int, ...]:
    """Return the number of blocks of each sensor.

    A sensor of several readings has a block for each, also where it does not measure it, as a mark
    may give the first one.
    """
    counts = []
    for name, count in zip(SENSOR_PARAMS, GROUP_COUNT, strict=True):
        params = getattr(sensors, name)
        alone = 0 if params is None else params.measured_blocks[0]
        counts.append(count if count > 1 else alone)
    return tuple(counts)


def gate_limit(freedoms: int, false_alarm: float) -> float:
    """Return the NIS above which a measurement is rejected, a quantile of chi-square."""
    return portable.chi_square_limit(freedoms, false_alarm) if false_alarm else math.inf


def pack_aids(p: Any, sensors: SensorSuite) -> None:
    """Write the parameters of aiding sensors and slow errors into a parameter record."""
    p["slow_decay"] = p["slow_sigma"] = 1.0
    states = slow_states(sensors)
    p["slow_sigma"][: len(states.errors)] = states.first_sigmas
    for aid, params in sensors.aids.items():
        p["aid_sigma"][aid], p["aid_matrix_sigma"][aid] = params.noise_sigma, params.matrix_sigma
        for name in ("vector", "scalar"):
            slow = getattr(params, f"slow_{name}")
            if slow is not None:
                decay, drive = slow.over(1.0 / params.rate)
                p[f"aid_{name}_sigma"][aid] = slow.sigma
                p[f"aid_{name}_decay"][aid], p[f"aid_{name}_drive"][aid] = decay, drive
        if len(params.numbers) > params.rows:
            raise ValueError(
                f"{type(params).__name__}.numbers must have at most {params.rows} triples, its "
                f"rows, got {len(params.numbers)}"
            )
        for row, numbers in enumerate(params.numbers, AID_NUMBERS[aid]):
            p["aid_numbers"][row] = numbers


def pack_sensors(settings: Any, sensors: SensorSuite) -> None:
    """Write the sensors that a filter assumes into a SETTINGS record, with their slow errors."""
    states = slow_states(sensors)
    settings["slow_states"], settings["slow_errors"] = len(states.errors), states.estimated
    settings["estimates_drift"] = states.drifts
    velocity = any(params.reads_velocity for params in sensors.sensors.values())
    settings["motion_columns"] = 9 if velocity else 6
    settings["aid_vector"], settings["aid_scalar"] = states.vectors, states.scalars
    settings["by_motion"] = sensors.heading_by_motion
    heading = sensors.heading_aid
    settings["heading_sensor"] = -1 if heading is None else FIRST_AID + heading
    settings["sensor_blocks"] = sensor_blocks(sensors)
    settings["reading_blocks"] = [
        sensors.blocks_of(name) or int(sensors.gives(name)) for name in READINGS
    ]
    settings["feature_count"] = sensors.blocks_of("pixels")


# --------------------------------------------------------------------------------------------------
# Parameters as records: conversion of the dataclasses to numbers for kernels.
# --------------------------------------------------------------------------------------------------

_NAMES = frozenset(field.name for field in PARAMS_FIELDS)


def _copy(p: Any, part: Any, prefix: str = "") -> None:
    """Copy the parameters that have a field with their name in the record; None stays zero."""
    for name in (field.name for field in fields(part)):
        if prefix + name in _NAMES and getattr(part, name) is not None:
            p[prefix + name] = getattr(part, name)


def params_record(
    vehicle: VehicleParams,
    sensors: SensorSuite,
    gains: PDGains | None = None,
    action_params: ActionParams | None = None,
    world: WorldParams | None = None,
) -> NDArray[Any]:
    """Return a vehicle, its sensors, gains and world as one scalar record, shape (1,)."""
    record = np.zeros(1, PARAMS)
    p = record[0]
    world = WorldParams() if world is None else world
    _copy(p, sensors.estimator)
    actions = action_params or ActionParams()
    for part in (vehicle, world, actions, sensors.imu, sensors.initial_pose):
        _copy(p, part)
    _copy(p, world.ground or GroundParams())
    _copy(p, world.battery or BatteryParams(), "battery_")
    _copy(p, gains or PDGains(), "gain_")
    drawable = nominal_values(vehicle, sensors, world)[:PARAMETERS_DRAWN]
    first = record.view(np.float64)[:PARAMETERS_DRAWN]
    np.copyto(first, drawable, where=~np.isnan(drawable))
    _pack_vehicle(p, vehicle)
    _pack_imu(p, sensors, vehicle)
    for sensor in sensors.sensors.values():
        for name, value in sensor.packed.items():
            if np.ndim(value) == 2:  # as many rows as the sensor has
                p[name][: len(value)] = value
            else:
                p[name] = value
    _pack_mark(p, sensors)
    _pack_raw(p, sensors)
    pack_aids(p, sensors)
    pack_tick(p, sensors)
    _pack_filter(p, sensors)
    noisy = sensors.noisy
    p["noisy_sigma"] = (noisy.position, noisy.velocity, noisy.attitude, noisy.body_rates)
    return record


def _pack_vehicle(p: Any, vehicle: VehicleParams) -> None:
    """Write the numbers that are derived from the vehicle."""
    for name in ("effectiveness", "max_rotor_force", "hover_voltage"):
        p[name] = getattr(vehicle, name)
    p["sound_effectiveness"], p["torque_scale"] = vehicle.effectiveness, vehicle.hover_torques
    p["allocation"] = portable.inverse(vehicle.effectiveness)
    p["inertia_inverse"] = portable.inverse(vehicle.inertia)
    p["half_drag"] = 0.5 * vehicle.drag_coefficient * vehicle.disc_area * vehicle.air_density
    p["half_disc"] = 0.5 * vehicle.disc_area * vehicle.air_density


def _pack_imu(p: Any, sensors: SensorSuite, vehicle: VehicleParams) -> None:
    """Write the noise of the IMU's samples, and the noise due to vibration of the rotors."""
    imu = sensors.imu
    p["imu_lever_arm"] = imu.lever_arm_B
    hover_speed = vehicle.motor_speed_per_volt * vehicle.hover_voltage
    for sensor in ("accel", "gyro"):
        p[f"{sensor}_sigma"] = getattr(imu, f"{sensor}_noise_density") / math.sqrt(imu.dt)
        p[f"{sensor}_vibration"] = getattr(imu, f"{sensor}_vibration") / (hover_speed * hover_speed)


def pack_tick(p: Any, sensors: SensorSuite) -> None:
    """Write the numbers that depend on the duration of a tick, after gravity."""
    imu, dt = sensors.imu, sensors.imu.dt
    p["dt"], p["accel_error_noise"] = dt, imu.accel_error_noise
    biases = slow_errors_of(sensors)
    for sensor, error in zip(("accel", "gyro"), biases, strict=False):
        p[f"{sensor}_noise"] = getattr(imu, f"{sensor}_noise")
        # the vibration is given for rotors in hover, whose specific force is g
        p[f"{sensor}_thrust_noise"] = getattr(imu, f"{sensor}_vibration") / p["gravity"]
        p[f"{sensor}_bias_decay"], p[f"{sensor}_bias_drive"] = error.over(dt)
    for k, error in enumerate(biases[2:]):
        p["slow_decay"][k], p["slow_drive"][k] = error.over(dt)
        p["slow_rate"][k], p["slow_stationary"][k] = 1.0 / error.tau, error.sigma


def slow_errors_of(sensors: SensorSuite) -> list[SlowError]:
    """Return the bias of accelerometer and gyro, and the slow errors among the filter's states."""
    imu = sensors.imu
    biases = [
        SlowError(getattr(imu, f"{sensor}_bias_sigma"), getattr(imu, f"{sensor}_bias_tau"))
        for sensor in ("accel", "gyro")
    ]
    return [*biases, *slow_states(sensors).errors]


def _pack_mark(p: Any, sensors: SensorSuite) -> None:
    """Write what the mark of the start gives, as if it had been measured."""
    pose = sensors.initial_pose
    for name, kind in SENSOR_PARAMS.items():
        sensor = getattr(sensors, name)
        for field, value in kind.from_mark(sensor, pose.position_sigma, pose.heading_sigma).items():
            p[field] = value


def _pack_raw(p: Any, sensors: SensorSuite) -> None:
    """Write the units of readings in raw observations."""
    p["raw_scale"] = p["raw_span"] = 1.0
    for name, sensor in sensors.sensors.items():
        first = FIRST_GROUP[Sensor[name.upper()]]
        groups = slice(first, first + len(sensor.measured_blocks))
        p["raw_scale"][groups], p["raw_span"][groups] = sensor.raw_scales, sensor.raw_spans


def _pack_filter(p: Any, sensors: SensorSuite) -> None:
    """Write the sigma points, noise models and gates of the filter."""
    estimator = sensors.estimator
    p["sigma_spread"], p["sigma_beta"] = estimator.alpha, estimator.beta
    p["sigma_kappa"] = estimator.kappa
    p["direction_floor"] = estimator.direction_variance_floor
    p["noise_at_prediction"] = estimator.bearing_noise_at != "measured"
    p["noise_pinhole"] = estimator.bearing_noise_at == "pinhole"
    alarm = estimator.false_alarm_probability
    p["gate"] = [gate_limit(freedoms, alarm) for freedoms in GROUP_FREEDOMS]
    sigma = estimator.max_direction_sigma if sensors.has_fixes else math.inf
    p["gate_uncertainty"] = sigma * sigma


def form_of(sensors: SensorSuite, innovations: bool = False, lever_arm: int = 0) -> FilterForm:
    """Return the options of a filter as flags; it may store innovations, and model a lever arm."""
    estimator = sensors.estimator
    options = {
        FilterForm.INNOVATIONS: innovations,
        FilterForm.EKF: estimator.kind == "ekf",
        FilterForm.MIDPOINT: estimator.integration == "midpoint",
        FilterForm.TURN: estimator.attitude_reset,
        FilterForm.FIRST_ESTIMATES: sensors.flow_alone,
        FilterForm.GATE: estimator.false_alarm_probability > 0.0,
        FilterForm.GRADUAL: estimator.recursive_update_threshold is not None,
    }
    return FilterForm(sum(flag for flag, on in options.items() if on) | lever_arm)


def lever_form(imu: ImuParams, drawn: bool = False) -> FilterForm:
    """Return flags for the lever arm of the assumed accelerometer, known or drawn; 0: none."""
    if not (drawn or any(imu.lever_arm_B)):
        return FilterForm(0)
    averages = imu.samples == "average"
    return FilterForm.LEVER_AVERAGES if averages else FilterForm.LEVER_SAMPLES


def params_block(record: NDArray[Any]) -> NDArray[Any]:
    """Return a scalar parameter record repeated for the flights of a block, shape (1,)."""
    block = aligned_zeros(1, PARAMS_BLOCK)
    for name in PARAMS.names or ():
        block[name][...] = record[name][..., np.newaxis]
    return block


# --------------------------------------------------------------------------------------------------
# World and randomization as numbers in the records that kernels read.
# --------------------------------------------------------------------------------------------------

FALLEN_THROUGH = 0.5  #: depth below ground that supports vehicles at which an episode ends [m]


def pack_options(
    s: Any, world: WorldParams, draws: DrawingTable, *, known: bool, limited: bool
) -> None:
    """Write the options of a world and its draws."""

    def present(name: str, *values: float) -> bool:
        return any(values) or bool(draws.kind[COLUMNS[name]].any())

    winds = [present(f"wind_{part}") for part in ("east", "north", "up", "speed", "direction")]
    s["gusts"] = present("gust_wind_speed", world.gust_wind_speed)
    drags = (present(name, *getattr(world, name)) for name in ("linear_drag_B", "rotor_drag_B"))
    s["linear_drag"], s["ground_effect"] = any(drags), world.ground_effect
    s["air"] = any(world.wind_I) or any(winds)
    s["air"] |= s["gusts"] | s["linear_drag"] | s["ground_effect"]
    s["supply"] = Supply.LIMIT if limited or present("max_voltage") else Supply.NOMINAL
    if world.battery is not None:
        s["supply"] = Supply.BATTERY
    s["observe_world"] = s["privileged"] and (world != WorldParams() or bool(draws.names))
    pack_start(s, draws)
    s["randomized"], s["known"] = bool(draws.names), known
    _pack_limits(s, world)
    for name in ("kind", "a", "b", "c", "d", "low", "high", "center", "spread"):
        s[f"draw_{name}"] = np.asarray(getattr(draws, name))


def pack_start(s: Any, draws: DrawingTable) -> None:
    """Write the variance of velocity and tilt at the start; the field `start` is already set."""
    if s["start"] == Start.MOVING:  # uniform on [-most, most]
        s["start_velocity_variance"] = MAX_START_VELOCITY**2 / 3.0
    if "start_velocity_I" in draws.names:
        s["start_velocity_variance"] += draws.mean_square("start_velocity_I")
    for i, name in enumerate(("start_roll", "start_pitch")):
        if name in draws.names:
            # no angle is more uncertain than one uniform on the circle
            s["start_tilt_variance"][i] = min(draws.mean_square(name)[0], math.pi**2 / 3.0)


def pack_places(
    s: Any, draws: DrawingTable, true_sensors: SensorSuite, sensors: SensorSuite
) -> None:
    """Write whether features are drawn, and their positions without draws, after `pack_options`."""
    s["features_drawn"] = bool(set(FEATURE_DRAWS) & set(draws.names))
    if s["features_drawn"]:
        believed = true_sensors if s["known"] else sensors
        for k, suite in enumerate((true_sensors, believed)):
            for packed in (sensor.packed for sensor in suite.sensors.values()):
                if "features" in packed:
                    s["feature_places"][k, : len(packed["features"])] = packed["features"]


def pack_obstacles(s: Any, obstacles: Sequence[Obstacle]) -> None:
    """Write obstacles into a settings record."""
    s["obstacle_count"] = len(obstacles)
    for k, obstacle in enumerate(obstacles):
        s["obstacle_shape"][k] = obstacle.shape
        s["obstacle_center"][k], s["obstacle_shift"][k] = obstacle.center_I, obstacle.shift_I
        s["obstacle_half"][k], s["obstacle_axis"][k] = obstacle.half_size, obstacle.axis
        s["obstacle_follows"][k] = -1 if obstacle.follows is None else obstacle.follows


def _pack_limits(s: Any, world: WorldParams) -> None:
    """Write obstacles, geofence and ground into a settings record."""
    pack_obstacles(s, world.obstacles)
    s["vehicle_radius"] = world.vehicle_radius
    if world.geofence is not None:
        s["fenced"], s["fence"] = True, world.geofence
    if world.ground is not None:
        s["grounded"], s["friction"] = True, world.ground.friction
        # ground contact ends an episode by a crash only; a vehicle far below has fallen through
        s["min_height"] = min(s["min_height"], world.ground_height - FALLEN_THROUGH)
        s["hard_speed"] = world.ground.max_touchdown_speed
        s["hard_up"] = portable.cos(world.ground.max_touchdown_tilt)
    s["contacts"] = bool(world.obstacles) or world.geofence is not None


def world_settings(world: WorldParams) -> NDArray[Any]:
    """Return a settings record that holds only the options of a world, shape (1,)."""
    settings = np.zeros(1, SETTINGS)
    draws = DrawingTable(Randomization({}), VehicleParams(), SensorSuite(), world)
    pack_options(settings[0], world, draws, known=False, limited=False)
    return settings


# --------------------------------------------------------------------------------------------------
# Faults as numbers in the settings record that kernels read.
# --------------------------------------------------------------------------------------------------


def pack_faults(s: Any, faults: Iterable[Fault], dt: float) -> None:
    """Write faults, at most one of each kind, into a settings record; `dt` is the tick [s]."""
    for fault in faults:
        k = fault.kind
        s["faults"], s["fault_on"][k] = True, True
        s["fault_rate"][k] = fault.rate * dt
        s["fault_start"][k] = _ticks(fault.start, dt)
        s["fault_duration"][k] = _ticks(fault.duration, dt, least=1.0)
        s["fault_probability"][k] = fault.probability
        for name, value in fault.numbers.items():
            if name == "size":
                low, high = ends(value)
                s["fault_size"][k] = low, high - low
            elif name in ("share", "direction"):
                s[f"fault_{name}"][k] = value
            else:
                s[name] = value


def _ticks(value: Span, dt: float, least: float = 0.0) -> tuple[float, float]:
    """Return the lower end and the length of a span of time [s] in ticks; a number is rounded."""
    low, high = ends(value)
    if math.isinf(high):
        return NEVER, 0.0
    if low == high:
        return max(float(round(low / dt)), least), 0.0
    return low / dt, (high - low) / dt


# --------------------------------------------------------------------------------------------------
# Trajectories as the records that kernels look up.
# --------------------------------------------------------------------------------------------------

_RULES = {"given": HEADING_GIVEN, "along": HEADING_VELOCITY, "toward": HEADING_TOWARD}


def pack_paths(trajectories: Sequence[Trajectory]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the paths (n,) of PATH and all their segments (m,) of PIECE."""
    paths = aligned_zeros(len(trajectories), PATH)
    counts = [len(trajectory.times) - 1 for trajectory in trajectories]
    pieces = aligned_zeros(sum(counts), PIECE)
    first = 0
    for path, trajectory, count in zip(paths, trajectories, counts, strict=True):
        path["first"], path["pieces"] = first, count
        path["closed"], path["duration"] = trajectory.closed, trajectory.duration
        path["heading"], path["point"] = _RULES[trajectory.heading], trajectory.point
        path["begin_heading"], path["end_heading"] = trajectory.end_headings
        own = slice(first, first + count)
        pieces["begin"][own] = trajectory.times[:-1]
        pieces["terms"][own] = np.moveaxis(trajectory.coefficients, 1, 0)
        first += count
    return paths, pieces


# --------------------------------------------------------------------------------------------------
# Settings as a record: the options of a batch of flights for kernels.
# --------------------------------------------------------------------------------------------------

_HARMONICS = {
    TaskKind.HOVER: 0,
    TaskKind.CIRCLE: 1,
    TaskKind.LEMNISCATE: 2,
    TaskKind.WAYPOINTS: 0,
    TaskKind.TRAJECTORY: FOLLOWED,
}
"""Terms in the series of a task's reference, for tasks that do not use all of them."""


def settings_record(c: FlightConfiguration) -> NDArray[Any]:
    """Return the settings of a batch as one scalar record, shape (1,)."""
    record = np.zeros(1, SETTINGS)
    s, task, assumed = record[0], c.task, c.sensors
    s["substeps"], s["ticks_per_step"] = c.clocks.substeps, c.clocks.ticks_per_step
    s["source"], s["control"], s["layout"] = c.source, c.control, c.layout
    s["include_std"], s["privileged"] = c.include_std, c.privileged
    s["run_filter"], s["reuse_first_fix"] = c.filters, assumed.estimator.reuse_first_fix
    s["own_estimator"] = c.estimator is not None
    draws_lever = {"lever_arm_B", "center_of_mass_B"} & set(c.randomization.names)
    lever_arm = lever_form(assumed.imu, c.randomization.known and bool(draws_lever))
    s["form"] = form_of(assumed, c.keeps_innovations, lever_arm)
    _pack_task(s, task)
    s["reward_scale"] = c.clocks.control_rate if task.reward_per == "step" else 1.0
    s["max_steps"] = round(task.duration * c.clocks.control_rate)
    limited = c.flown_vehicle.max_voltage < c.vehicle.max_voltage
    pack_options(s, c.world, c.draws, known=c.randomization.known, limited=limited)
    s["action_delays"] = c.longest_delay
    pack_places(s, c.draws, c.flown_sensors, assumed)
    pack_faults(s, c.possible_faults, assumed.imu.dt)
    _pack_sensors(s, c.sensors, c.flown_sensors)
    return record


def sensor_settings(sensors: SensorSuite) -> NDArray[Any]:
    """Return a settings record that holds only the options of sensors, shape (1,)."""
    settings = np.zeros(1, SETTINGS)
    settings["run_filter"] = True
    _pack_sensors(settings[0], sensors, sensors)
    return settings


def _pack_task(s: Any, task: TaskParams) -> None:
    """Write reference, start, reward and endings of a task."""
    kind = TaskKind[task.kind.upper()]
    s["task"], s["start"] = kind, Start[task.start.upper()]
    s["pad"] = task.pad and task.may_start_on_ground
    weights = task.reward_params
    s["reward_weight"] = [getattr(weights, term.name.lower()) for term in RewardTerm]
    s["near_decay"], s["fine_decay"] = weights.near_decay, weights.fine_decay
    s["harmonics"] = _HARMONICS.get(kind, MAX_HARMONICS)
    s["path_count"] = len(task.trajectories)
    s["min_up"] = portable.cos(task.max_tilt)
    for name in (
        "randomize_reference",
        "radius",
        "period",
        "height",
        "preview",
        "max_speed",
        "max_acceleration",
        "gate_count",
        "gate_radius",
        "out_of_bounds",
        "min_height",
        "truncate_when_diverged",
    ):
        s[name] = getattr(task, name)


def _pack_sensors(s: Any, assumed: SensorSuite, true: SensorSuite) -> None:
    """Write clocks, delays and quantities of the sensors, and the errors that the filter estimates.

    Rates, phases and measured quantities of the true and the assumed sensors are the same.
    """
    s["imu_averages"] = assumed.imu.samples == "average"
    pack_sensors(s, assumed)
    for name, sensor in true.sensors.items():
        place, label = Sensor[name.upper()], type(sensor).__name__
        ticks = check.ticks(f"{label}.rate", sensor.rate, true.imu.rate)
        s["sensor_ticks"][place] = ticks
        phase = sensor.phase  # in ticks, fewer than a period; -1: drawn in each episode
        s["sensor_phase"][place] = -1 if phase is None else min(round(phase * ticks), ticks - 1)
        delay = delay_ticks(f"{label}.latency", sensor.latency, sensor.rate, true.imu.rate)
        s["sensor_delay"][place], s["under_way"][place] = delay, -(-delay // ticks)
    s["late"] = s["sensor_delay"].max() > 0
    s["rewinds"] = assumed.estimator.delay_compensation == "retrodict"
    # the errors that the true sensors have
    s["imu_errs"], s["imu_vibrates"] = true.imu.errs, true.imu.vibrates
    for sensor in true.sensors.values():
        for name, on in sensor.options.items():
            s[name] = on
