"""The flights of the page: a batch for each scene, with a flight for each controller."""

import math
from typing import Any, NamedTuple

import numpy as np

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import BENCHMARKS, TASK_DEFAULTS
from quad_gym.envs.spaces import ObservationField, layout_bounds, observation_layout
from quad_gym.faults import GyroBiasStep
from quad_gym.params.suites import SensorSuite, sensor_suite
from quad_gym.params.task import TaskParams
from quad_gym.params.vehicle import pd_gains
from quad_gym.records import Control, Source
from quad_gym.records.sizes import DELAY_SLOTS, STAMP

CONTROLLERS = 3
"""Flights of a scene: PD control, policies trained on the true state and on the estimate."""
CONTROL_RATE = 50.0
_NEVER = 1e9
"""Start of the fault [s], which a button of the page sets."""


class Scene(NamedTuple):
    """A task with its sensors."""

    title: str
    task: TaskParams
    sensors: str
    trained: str
    """name of its policies"""
    included: str
    """training of the included policy, in words"""
    magnified: int
    """factor of the errors of the estimate in pictures"""


_ENDLESS: dict[str, Any] = {"start": "hover", "duration": 0.0}
SCENES = {
    "look_around": Scene(
        "LookAround: markers on one wall, no GNSS",
        BENCHMARKS["look_around"].task.replace(**_ENDLESS),
        "one_wall",
        "look_around",
        "Estimate + standard deviation, reward for certainty",
        1,
    ),
    "circle": Scene(
        "Circle: RTK GNSS and a camera",
        TASK_DEFAULTS["circle"].replace(**_ENDLESS),
        "rtk",
        "circle",
        "Trained on the estimate",
        20,
    ),
    "consumer": Scene(
        "Circle: consumer GNSS, barometer, magnetometer",
        TASK_DEFAULTS["circle"].replace(**_ENDLESS),
        "consumer",
        "circle",
        "Trained on the estimate",
        1,
    ),
}
"""Scenes by name."""


def batch_of(name: str) -> FlightBatch:
    """Return the flights of a scene, which have never been reset."""
    scene = SCENES[name]
    suite = sensor_suite(scene.sensors)
    step = GyroBiasStep(start=_NEVER, size=math.radians(3.0), direction=(0.0, 0.0, 1.0))
    return FlightBatch(
        CONTROLLERS,
        task=scene.task,
        sensors=suite,
        source=Source.ESTIMATE,
        control=Control.CTBR,
        control_rate=CONTROL_RATE,
        bounds=layout_bounds(_table_of(suite)),
        faults=step,
        threads=1,
    )


def keys_of(seed: int) -> Any:
    """Return the keys of the random streams: flights of a scene have the same draws."""
    return np.tile(np.array([[seed, 0]], np.uint64), (CONTROLLERS, 1))


def described(name: str, batch: FlightBatch) -> dict[str, Any]:
    """Return the numbers of a scene that are not in its records."""
    suite = batch.sensors
    return {
        "title": SCENES[name].title,
        "included": SCENES[name].included,
        "tick": suite.imu.dt,
        "ticksPerStep": round(suite.imu.rate / CONTROL_RATE),
        "stamps": (DELAY_SLOTS, STAMP),
        "harmonics": int(batch._settings["harmonics"][0]),
        "features": 0 if suite.camera is None else len(suite.camera.features_I),
        "magnified": SCENES[name].magnified,
        "trained": SCENES[name].trained,
        "biasFault": int(GyroBiasStep.kind),
        "gnss": suite.gnss is not None,
        "observation": {f.name: [f.slice.start, f.slice.stop] for f in _table_of(suite)},
        "gains": vars(pd_gains("tuned")),
    }


def _table_of(suite: SensorSuite) -> tuple[ObservationField, ...]:
    """Return the table of the observations."""
    return observation_layout(sensors=suite)
