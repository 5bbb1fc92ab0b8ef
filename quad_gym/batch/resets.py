"""Arguments of a reset: random streams, flights, and their initial states."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.seeding import stream_keys
from quad_gym.batch.surroundings import require_room
from quad_gym.params import checks as check
from quad_gym.params.task import TaskParams
from quad_gym.params.world import WorldParams

MAX_SPEED = 1e4
"""Largest initial speed [m/s]: several times faster than any bullet, with drag still integrable."""


def checked_keys(
    count: int, seeds: Sequence[int | None] | None, keys: ArrayLike | None
) -> NDArray[np.uint64] | None:
    """Return keys (count, 2): of the seeds if given, else `keys`; None without either."""
    if seeds is not None:
        if isinstance(seeds, str) or not hasattr(seeds, "__len__"):  # type: ignore[unreachable]
            raise ValueError(f"seeds must contain {count} seeds, got {seeds!r}")
        if len(seeds) != count:
            raise ValueError(f"seeds must contain {count} seeds, got {len(seeds)}")
        return stream_keys(seeds)
    if keys is None:
        return None
    words = np.asarray(keys)
    if words.shape != (count, 2) or words.dtype != np.uint64:
        raise ValueError(
            f"keys must be uint64 of shape ({count}, 2), got {words.dtype} of {words.shape}"
        )
    return words


def checked_start(
    count: int,
    position: ArrayLike | None,
    velocity: ArrayLike | None,
    yaw: ArrayLike | None,
    task: TaskParams,
    world: WorldParams | None = None,
    chosen: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64] | None:
    """Return initial values (count, 7), NaN where they are to be drawn; None if all are.

    Positions of `chosen` flights (count,) have to be free of the world's obstacles. Starts from
    which no flight can begin are refused, as are speeds above MAX_SPEED and yaws beyond a turn.
    """
    if position is None and velocity is None and yaw is None:
        return None
    given = np.full((count, 7), np.nan)
    for name, value, columns in (
        ("position", position, slice(0, 3)),
        ("velocity", velocity, slice(3, 6)),
        ("yaw", yaw, slice(6, 7)),
    ):
        if value is None:
            continue
        width = columns.stop - columns.start
        try:
            if np.asarray(value).dtype.kind not in "iuf":
                raise TypeError
            numbers = np.asarray(value, np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"{name} must be numbers, got {value!r}") from None
        if name == "yaw":
            numbers = numbers[..., np.newaxis]
        if numbers.shape not in ((width,), (count, width)):
            shapes = "a number or (n,)" if name == "yaw" else "(3,) or (n, 3)"
            raise ValueError(f"{name} must have shape {shapes}, got {np.shape(value)}")
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name} must be finite, got {value!r}")
        given[:, columns] = numbers
    reach = 1.5 * task.radius + 1.3 * task.height  # of any reference from the origin
    reach = max((path.reach for path in task.trajectories), default=reach)
    farthest = task.out_of_bounds + reach
    with np.errstate(over="ignore"):  # infinite lengths are refused like others; NaN never is
        distance, speed = (np.linalg.norm(given[:, k : k + 3], axis=1).max() for k in (0, 3))
    if distance > farthest:
        raise ValueError(
            f"position must be within {farthest:g} m of the origin: farther, a start is beyond "
            f"out_of_bounds={task.out_of_bounds:g} m of the reference, got {distance:g} m"
        )
    if world is not None and position is not None:
        require_room("position", given[:, :3] if chosen is None else given[chosen, :3], world)
    if speed > MAX_SPEED:
        raise ValueError(f"velocity must be at most {MAX_SPEED:g} m/s, got {speed:g} m/s")
    if yaw is not None:
        check.angle("yaw", float(given[np.abs(given[:, 6]).argmax(), 6]))
    return given


def checked_mask(count: int, mask: ArrayLike | None) -> NDArray[np.bool_]:
    """Return the mask (count,) of flights; all of them without a mask."""
    if mask is None:
        return np.ones(count, bool)
    chosen = np.asarray(mask)
    if chosen.shape != (count,) or chosen.dtype != bool:
        raise ValueError(
            f"mask must be {count} booleans, got shape {chosen.shape} of {chosen.dtype}"
        )
    return chosen
