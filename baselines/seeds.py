"""Disjoint blocks of seeds for flights in training, validation and test.

Flight i of an environment seeded with s has the seed s + i, as is Gymnasium's convention. Trainings
with seeds 0 and 4 would therefore share most of their flights, and an evaluation with seed 0 would
use flights of the first training. Here each purpose has its own seeds:

| purpose | seeds of its flights |
|---|---|
| "test" | `seed + i`, with `seed` as given by the user, below 10^9 |
| "training" | `10^9 + 10^6 seed + i`, up to 10^6 flights at a time |
| "validation" | `10^12 + 10^6 seed + i`, up to 10^6 flights at a time |

Flights for "training" are used to fit parameters, including the search of gains; flights for
"validation" to select the best checkpoint of a training; flights for "test" for reported results.
"""

from quad_gym.params import checks as check

PURPOSES = ("training", "validation", "test")  #: purposes of flights

BLOCK = 10**6  #: number of flights in the block of one seed of a training, or of its validation

TEST_END = 10**9  #: upper limit of the seeds of tests

MAX_SEED = 99_999
"""Largest seed of a training, for which the blocks of training and validation do not overlap."""

_FIRST = {"training": TEST_END, "validation": 10**12}


def flight_seeds(purpose: str, seed: int, count: int) -> range:
    """Seeds (count,) of the flights of one training, validation or test.

    `seed` is the one of the training or, for a test, of its first flight. Raises a ValueError if
    the seeds are outside the block of the purpose.
    """
    check.choice("purpose", purpose, PURPOSES)
    testing = purpose == "test"  # from TEST_END on, seeds are for training
    check.whole("count", count, most=TEST_END if testing else BLOCK)
    check.whole("seed", seed, least=0, most=TEST_END - count if testing else MAX_SEED)
    first = seed if testing else _FIRST[purpose] + BLOCK * seed
    return range(first, first + count)


def first_seed(purpose: str, seed: int, count: int = 1) -> int:
    """Seed of the first of `count` flights, to which flight i adds i; see `flight_seeds`."""
    return flight_seeds(purpose, seed, count)[0]
