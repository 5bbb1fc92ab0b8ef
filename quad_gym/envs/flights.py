"""From the keywords of an environment to its flights: the same for all three interfaces."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.references import check_in_bounds, check_pad
from quad_gym.batch.resets import checked_start
from quad_gym.envs.config import Base, EnvConfig, Own
from quad_gym.envs.spaces import (
    ObservationField,
    layout_bounds,
    observation_layout,
    observation_space,
    policy_size,
)
from quad_gym.packing.configuration import MAX_FLIGHTS
from quad_gym.params import checks as check
from quad_gym.params.world import WorldParams
from quad_gym.records import Autoreset, Layout


class Flights:
    """The flights behind an environment, with its observation's table; see `QuadEnv`."""

    def __init__(
        self,
        task: "Own | None",
        count: int,
        autoreset: Autoreset,
        *,
        base: "Base | None" = None,
        threads: int | None = None,
        **keywords: Any,
    ) -> None:
        check.whole("num_envs", count, most=MAX_FLIGHTS)
        self.config = config = EnvConfig.of(task, base, keywords)
        seen = config.observation
        self.name, self.task, self.observation = config.name, config.task, seen.observation
        self.action, self.layout = config.vehicle.action, seen.layout
        self.control_rate, self.reward_terms = config.vehicle.control_rate, seen.reward_terms
        c = config.flights(count, autoreset, threads)
        drawn = c.randomization.names
        if c.world.ground is None and not config.tasks and "start_position_I" not in drawn:
            check_pad(c.task)  # a user-defined task may set where vehicles start
        self.table: tuple[ObservationField, ...] = observation_layout(
            seen.observation,
            None if c.layout is Layout.MEASUREMENTS else seen.layout,
            sensors=c.sensors,
            include_std=c.include_std,
            privileged=c.privileged,
            drawn=(drawn if drawn or c.world != WorldParams() else None) if c.privileged else None,
        )
        c = replace(c, bounds=layout_bounds(self.table))
        if not config.tasks:
            self.batch = FlightBatch(c)  # type: ignore[arg-type]
        else:
            from quad_gym.envs.own_task import batch_with_task

            self.batch, self.table = batch_with_task(config.tasks, c, self.table)
        if config.max_steps is not None:
            self.batch.limit(min(config.max_steps, self.batch.max_steps or config.max_steps))
        self.space = observation_space(self.table)
        self.policy_size = policy_size(self.table) if c.privileged else None

    def start(self, options: dict[str, Any] | None) -> dict[str, Any]:
        """The start values in the options of a reset, checked before anything changes."""
        chosen = start_options(options)
        position, velocity, yaw = (chosen.get(name) for name in ("position", "velocity", "yaw"))
        count, world = self.batch.count, self.batch.world
        given = checked_start(count, position, velocity, yaw, self.task, world)
        ends_by_itself = "terminated" in getattr(self.batch, "methods", ())  # a user's task
        if position is not None and given is not None and not ends_by_itself:
            check_in_bounds(self.task, given[:, :3])
        return chosen

    def split(self, observations: NDArray[np.float32]) -> Any:
        """Observations (..., n) as the space wants them: an array, or a Dict of parts."""
        if self.policy_size is None:
            return observations
        return {
            "policy": observations[..., : self.policy_size].copy(),
            "privileged": observations[..., self.policy_size :].copy(),
        }


def checked_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Actions as finite floats of a shape, clipped to [-1, 1]."""
    if _in_order(actions, shape):
        return actions
    try:
        given = np.asarray(actions)
    except ValueError:
        raise ValueError(f"action must be {shape} numbers, got {actions!r}") from None
    if given.dtype.kind not in "biuf" or np.ma.is_masked(actions):
        raise ValueError(f"action must be {shape} numbers, got {actions!r}")
    numbers = given.astype(np.float64)
    if numbers.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {numbers.shape}")
    if not np.isfinite(numbers).all():
        raise ValueError("action must be finite: it contains NaN or infinity")
    return numbers.clip(-1.0, 1.0)


def _in_order(actions: Any, shape: tuple[int, ...]) -> bool:
    """Return True if actions need no check and no clipping; NaN and infinity always do."""
    if not (type(actions) is np.ndarray and actions.dtype.kind == "f" and actions.shape == shape):
        return False
    if actions.ndim == 1:  # a few numbers are sooner looked at than handed to NumPy
        return all(-1.0 <= number <= 1.0 for number in actions.tolist())
    return bool(actions.max() <= 1.0 and actions.min() >= -1.0)


def named_options(options: Any) -> dict[str, Any]:
    """A copy of the options of a reset, which are by name; none for None."""
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options must be values by name, or None, got {options!r}")
    return dict(options or {})


def start_options(options: dict[str, Any] | None) -> dict[str, Any]:
    """The start values in the options of a reset."""
    chosen = named_options(options)
    known = ("position", "velocity", "yaw")
    unknown = sorted(set(chosen) - set(known))
    if unknown:
        raise ValueError(f"options may contain {', '.join(known)}, got {unknown[0]!r}")
    return chosen
