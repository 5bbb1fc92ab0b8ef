"""Which flights training, validation and test may fly: blocks of seeds that never overlap.

Flight i of an environment seeded with s is flight 0 of one seeded with s + 1, as is Gymnasium's
convention. Trainings with seeds 0 and 4 would therefore share most of their flights, and an
evaluation with seed 0 would fly what the first of them was trained on. Here each purpose has
seeds of its own:

| purpose | seeds of its flights |
|---|---|
| "test" | `seed + i`, as they are given and documented, below 10^9 |
| "training" | `10^9 + 10^6 seed + i`, up to 10^6 flights at a time |
| "validation" | `10^12 + 10^6 seed + i`, likewise |

"training" is all that a choice of parameters is fitted to, the search of gains included;
"validation" says which checkpoint of a training is kept; "test" is what is reported.
"""

from quad_gym.params import checks as check

PURPOSES = ("training", "validation", "test")
"""What flights are for."""

BLOCK = 10**6
"""Flights that belong to one seed of a training, or of its validation."""

TEST_END = 10**9
"""Seeds below are for tests."""

MAX_SEED = 99_999
"""Largest seed of a training: its flights end well before those of validations begin."""

_FIRST = {"training": TEST_END, "validation": 10**12, "test": 0}


def flight_seeds(purpose: str, seed: int, count: int) -> range:
    """The seeds of the flights of one training, validation or test.

    Args:
        purpose: One of PURPOSES.
        seed: Of the training; of a test, that of its first flight.
        count: Number of flights.

    Returns:
        (count,) one seed per flight.

    Raises:
        ValueError: If the purpose is unknown, or the seeds would leave those of the purpose.
    """
    check.choice("purpose", purpose, PURPOSES)
    check.whole("seed", seed, least=0)
    check.whole("count", count)
    if purpose == "test":
        if seed + count > TEST_END:
            raise ValueError(
                f"seed must be at most {TEST_END - count}, as those from {TEST_END} on are for "
                f"training, got {seed}"
            )
        return range(seed, seed + count)
    if seed > MAX_SEED:
        raise ValueError(f"seed must be at most {MAX_SEED}, got {seed}")
    if count > BLOCK:
        raise ValueError(f"count must be at most {BLOCK} flights, got {count}")
    first = _FIRST[purpose] + BLOCK * seed
    return range(first, first + count)


def first_seed(purpose: str, seed: int, count: int = 1) -> int:
    """The seed of the first of `count` flights; flight i has this plus i. See `flight_seeds`."""
    return flight_seeds(purpose, seed, count)[0]
