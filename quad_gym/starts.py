"""What a reset is given: random streams, which flights, and where they start."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray


def stream_key(rng: np.random.Generator) -> NDArray[np.uint64]:
    """Draw the key of a flight's random stream, (2,) words."""
    return rng.integers(0, 2**64, size=2, dtype=np.uint64, endpoint=False)


def stream_keys(seeds: Sequence[int | None]) -> NDArray[np.uint64]:
    """Keys for flights seeded one by one, as Gymnasium seeds; None takes fresh entropy."""
    return np.array([stream_key(np.random.Generator(np.random.PCG64(seed))) for seed in seeds])


def checked_keys(
    count: int, seeds: Sequence[int | None] | None, keys: ArrayLike | None
) -> NDArray[np.uint64] | None:
    """(count, 2) keys, those of the seeds if there are any; None if there are neither."""
    if seeds is not None:
        if len(seeds) != count:
            raise ValueError(f"seeds must hold {count} seeds, got {len(seeds)}")
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
    count: int, position: ArrayLike | None, velocity: ArrayLike | None, yaw: ArrayLike | None
) -> NDArray[np.float64] | None:
    """(count, 7) start values, NaN where they are to be drawn; None if all are."""
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
            numbers = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"{name} must be numbers, got {value!r}") from None
        if name == "yaw":
            numbers = numbers[..., np.newaxis]
        if numbers.shape not in ((width,), (count, width)):
            shapes = "a number or (n,)" if name == "yaw" else "(3,) or (n, 3)"
            raise ValueError(f"{name} must have shape {shapes}, got {np.shape(value)}")
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name} must be finite, got {value!r}")
        given[:, columns] = numbers
    return given


def checked_mask(count: int, mask: ArrayLike | None) -> NDArray[np.bool_]:
    """(count,) which flights; all without a mask."""
    if mask is None:
        return np.ones(count, bool)
    chosen = np.asarray(mask)
    if chosen.shape != (count,) or chosen.dtype != bool:
        raise ValueError(
            f"mask must be {count} booleans, got shape {chosen.shape} of {chosen.dtype}"
        )
    return chosen
