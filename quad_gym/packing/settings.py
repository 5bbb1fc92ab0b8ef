"""Settings as a record: the options of a batch of flights for kernels."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.packing.aids import pack_sensors
from quad_gym.packing.configuration import FlightConfiguration
from quad_gym.packing.faults import pack_faults
from quad_gym.packing.flight import form_of, lever_form
from quad_gym.packing.world import pack_options, pack_places
from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.sensors import delay_ticks
from quad_gym.params.task import TaskParams
from quad_gym.records import (
    FOLLOWED,
    MAX_HARMONICS,
    SETTINGS,
    RewardTerm,
    Sensor,
    Start,
    TaskKind,
)

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
    _pack_sensors(s, c)
    return record


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
        *("randomize_reference", "radius", "period", "height", "preview"),
        *("max_speed", "max_acceleration", "gate_count", "gate_radius"),
        *("out_of_bounds", "min_height", "truncate_when_diverged"),
    ):
        s[name] = getattr(task, name)


def _pack_sensors(s: Any, c: FlightConfiguration) -> None:
    """Write clocks, delays and quantities of the sensors, and the errors that the filter estimates.

    Rates, phases and measured quantities of the true and the assumed sensors are the same.
    """
    assumed, true = c.sensors, c.flown_sensors
    s["imu_averages"] = assumed.imu.samples == "average"
    if assumed.gnss is not None:
        s["gnss_velocity"] = assumed.gnss.velocity_sigma is not None
    s["gnss_baseline"] = assumed.gnss is None or assumed.gnss.has_baseline
    s["gnss_drifts"] = true.drifts
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
    imu, gnss, camera = true.imu, true.gnss, true.camera
    s["imu_errs"], s["imu_vibrates"] = imu.errs, imu.vibrates
    s["heading_errs"] = gnss is not None and gnss.heading_errs
    if camera is not None:
        s["camera_limited"] = camera.limited
        s["camera_blurs"] = camera.exposure > 0.0
        s["ground_hides"] = camera.ground_hides
