"""From the keywords of an environment to its flights: the same for all three faces."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym import validation as check
from quad_gym.envs.spaces import (
    ACTIONS,
    LAYOUTS,
    OBSERVATIONS,
    ObservationField,
    layout_bounds,
    observation_layout,
    observation_space,
    policy_size,
)
from quad_gym.fault_presets import FaultsGiven
from quad_gym.params import ActionParams, TaskParams, VehicleParams
from quad_gym.randomization import Given, Randomization
from quad_gym.records import RESULTS, Autoreset, Ending, Layout
from quad_gym.sensor_params import SensorSuite
from quad_gym.sensor_suites import sensor_suite
from quad_gym.simulation import FlightBatch
from quad_gym.world_params import WorldParams, world_params

TASK_DEFAULTS: dict[str, TaskParams] = {
    "hover": TaskParams(kind="hover", start="hover"),
    "circle": TaskParams(kind="circle", start="ground"),
    "lemniscate": TaskParams(kind="lemniscate", start="hover", radius=3.0),
    "random_trajectory": TaskParams(
        kind="random_trajectory", start="hover", radius=2.5, height=2.0, period=12.0, randomize=True
    ),
    "waypoints": TaskParams(
        kind="waypoints", start="hover", radius=3.5, height=1.5, duration=20.0, out_of_bounds=12.0
    ),
}
"""What each task is unless keywords say otherwise."""

TASK_KEYWORDS = tuple(field.name for field in fields(TaskParams) if field.name != "kind")
"""Fields of `TaskParams` that an environment takes as keywords."""


class Flights:
    """The flights behind an environment, with its observation's table.

    Args:
        task: The kind of task.
        count: Number of flights.
        autoreset: When a flight whose episode is over begins the next one.
        keywords: The environment's keywords; see `QuadEnv`.

    Raises:
        ValueError: If a keyword is unknown or its value makes no sense.
    """

    def __init__(self, task: str, count: int, autoreset: Autoreset, **keywords: Any) -> None:
        check.choice("task", task, tuple(TASK_DEFAULTS))
        given = {name: keywords.pop(name) for name in TASK_KEYWORDS if name in keywords}
        given = {name: value for name, value in given.items() if value is not None}
        self.task: TaskParams = TASK_DEFAULTS[task].replace(**given)
        self._build(count, autoreset, **keywords)

    def _build(
        self,
        count: int,
        autoreset: Autoreset,
        *,
        observation: str = "estimate",
        action: str = "ctbr",
        layout: str = "relative",
        include_covariance: bool = False,
        privileged: bool = False,
        sensors: SensorSuite | str = "lab",
        vehicle: VehicleParams | str = "lab",
        actions: ActionParams | None = None,
        camera: bool = True,
        feature_noise_across: str | None = None,
        estimator: str | None = None,
        filter_start: str = "cold",
        control_rate: float = 50.0,
        imu_rate: float | None = None,
        gnss_rate: float | None = None,
        camera_rate: float | None = None,
        substeps: int = 1,
        max_episode_steps: int | None = None,
        innovations: bool = False,
        threads: int | None = None,
        true_vehicle: VehicleParams | None = None,
        true_sensors: SensorSuite | None = None,
        world: WorldParams | str = "calm",
        randomization: Randomization | Mapping[str, Given] | None = None,
        faults: FaultsGiven = None,
        **unknown: Any,
    ) -> None:
        if unknown:
            raise ValueError(
                f"{sorted(unknown)[0]} is not a keyword of this environment; a task takes "
                f"{', '.join(TASK_KEYWORDS)} besides those of QuadEnv"
            )
        check.choice("observation", observation, tuple(OBSERVATIONS))
        check.choice("action", action, tuple(ACTIONS))
        check.choice("layout", layout, tuple(LAYOUTS))
        check.flag("camera", camera)
        check.flag("include_covariance", include_covariance)
        check.flag("privileged", privileged)
        suite = sensor_suite(sensors) if isinstance(sensors, str) else sensors
        if not isinstance(suite, SensorSuite):
            raise ValueError(f"sensors must be a SensorSuite or its name, got {sensors!r}")
        if not camera:
            suite = suite.replace(camera=None)
        if feature_noise_across is None and sensors == "lab":
            feature_noise_across = "predicted"
        if feature_noise_across is not None:
            choices = suite.estimator.replace(feature_noise_across=feature_noise_across)
            suite = suite.replace(estimator=choices)
        if estimator is not None:
            check.choice("estimator", estimator, ("ukf", "ekf"))
            suite = suite.replace(estimator=suite.estimator.replace(kind=estimator))
        suite = suite.with_rates(imu=imu_rate, gnss=gnss_rate, camera=camera_rate)

        drawn = Randomization.of(randomization)
        place = world_params(world) if isinstance(world, str) else world
        features = 0 if suite.camera is None else len(suite.camera.features_I)
        self.table: tuple[ObservationField, ...] = observation_layout(
            observation,
            layout,
            include_covariance=include_covariance,
            privileged=privileged,
            feature_count=features,
            gnss_velocity=suite.gnss is not None and suite.gnss.velocity_sigma is not None,
            drawn=drawn.names if drawn.names or place != WorldParams() else None,
        )
        self.space = observation_space(self.table)
        self._split = policy_size(self.table) if privileged else None
        self.observation, self.action, self.layout = observation, action, layout
        self.control_rate = check.positive("control_rate", control_rate)
        self.batch = FlightBatch(
            count,
            vehicle=vehicle,
            sensors=suite,
            actions=actions,
            task=self.task,
            source=OBSERVATIONS[observation],
            control=ACTIONS[action],
            control_rate=control_rate,
            substeps=substeps,
            layout=Layout.SENSORS if observation == "sensors" else LAYOUTS[layout],
            include_covariance=include_covariance,
            privileged=privileged,
            bounds=layout_bounds(self.table),
            autoreset=autoreset,
            filter_start=filter_start,
            innovations=innovations,
            threads=threads,
            true_vehicle=true_vehicle,
            true_sensors=true_sensors,
            world=place,
            randomization=drawn,
            faults=faults,
        )
        if max_episode_steps is not None:
            steps = check.whole("max_episode_steps", max_episode_steps)
            self.batch.limit(min(steps, self.batch.max_steps or steps))

    def split(self, observations: NDArray[np.float32]) -> Any:
        """Observations (..., n) as the space wants them: an array, or a Dict of parts."""
        if self._split is None:
            return observations
        return {
            "policy": observations[..., : self._split].copy(),
            "privileged": observations[..., self._split :].copy(),
        }


COLUMN = {name: column for column, name in enumerate(RESULTS)}
"""Columns of a batch's `results`, by name."""


def checked_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Actions as floats, clipped to [-1, 1].

    Raises:
        ValueError: If the shape is another or a number is not finite.
    """
    if _in_order(actions, shape):
        return actions  # type: ignore[no-any-return]
    try:
        given = np.asarray(actions)
    except ValueError:
        raise ValueError(f"action must be {shape} numbers, got {actions!r}") from None
    if given.dtype.kind not in "biuf":
        raise ValueError(f"action must be {shape} numbers, got {actions!r}")
    numbers = given.astype(np.float64)
    if numbers.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise ValueError("action must be finite, got NaN or infinity among its numbers")
    return numbers.clip(-1.0, 1.0)


def _in_order(actions: Any, shape: tuple[int, ...]) -> bool:
    """Whether actions need neither a check nor clipping; NaN and infinity are not within bounds."""
    return (
        isinstance(actions, np.ndarray)
        and actions.dtype.kind == "f"
        and actions.shape == shape
        and bool(np.abs(actions).max() <= 1.0)
    )


def start_options(options: dict[str, Any] | None) -> dict[str, Any]:
    """The start values in the options of a reset.

    Raises:
        ValueError: If an option is unknown.
    """
    chosen = dict(options or {})
    known = ("position", "velocity", "yaw")
    unknown = sorted(set(chosen) - set(known))
    if unknown:
        raise ValueError(f"options may hold {', '.join(known)}, got {unknown[0]!r}")
    return chosen


def drawn_info(drawn: dict[str, NDArray[np.float64]], flight: int) -> dict[str, Any]:
    """What `info` says of one flight's draws: "drawn", by name; nothing where nothing is drawn."""
    values = {name: flights[flight] for name, flights in drawn.items()}
    numbers = {name: float(v) if v.ndim == 0 else v for name, v in values.items()}
    return {"drawn": numbers} if numbers else {}


ENDINGS = tuple(ending.name.lower() for ending in Ending)
"""Names of the endings that `info["ending"]` reports, by their number."""
