"""A random stream per flight, counter-based: draw n of flight k is a function of (k, n).

Threefry-2x64 with 13 rounds (J. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC
2011): additions, rotations and exclusive-ors of 64-bit words, one word per lane. The key is drawn
when a flight is seeded. The first counter word counts the flight's instants, the second names the
draw within the instant, so that no result depends on other draws, made or skipped.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.numbers.elementary import log, near_zero, quarter_turns
from quad_gym.kernels.numbers.lanes import one_to_two, rotate_left, round_to_even

_PARITY = np.uint64(0x1BD11BDAA9FC1A22)
_ONE, _TWO, _THREE = np.uint64(1), np.uint64(2), np.uint64(3)


@kernel
def _mix(a, b, places):
    a = a + b
    return a, rotate_left(b, places) ^ a


@kernel
def threefry(key0, key1, counter0, counter1):
    """Two random words from a key and a counter of two words each."""
    key2 = key0 ^ key1 ^ _PARITY
    a, b = counter0 + key0, counter1 + key1
    a, b = _mix(a, b, 16)
    a, b = _mix(a, b, 42)
    a, b = _mix(a, b, 12)
    a, b = _mix(a, b, 31)
    a, b = a + key1, b + key2 + _ONE
    a, b = _mix(a, b, 16)
    a, b = _mix(a, b, 32)
    a, b = _mix(a, b, 24)
    a, b = _mix(a, b, 21)
    a, b = a + key2, b + key0 + _TWO
    a, b = _mix(a, b, 16)
    a, b = _mix(a, b, 42)
    a, b = _mix(a, b, 12)
    a, b = _mix(a, b, 31)
    a, b = a + key0, b + key1 + _THREE
    return _mix(a, b, 16)


@kernel
def uniform_pair(stream, draw):
    """Two independent numbers, uniform on [0, 1), from a draw of a stream (key0, key1, instant)."""
    a, b = threefry(stream[0], stream[1], stream[2], np.uint64(draw))
    return one_to_two(a) - 1.0, one_to_two(b) - 1.0


@kernel
def normal_pair(stream, draw):
    """Two independent standard normals from a draw (G. E. P. Box and M. E. Muller, 1958)."""
    a, b = threefry(stream[0], stream[1], stream[2], np.uint64(draw))
    radius = math.sqrt(-2.0 * log(2.0 - one_to_two(a)))  # of a number in (0, 1]
    quarters = 4.0 * (one_to_two(b) - 1.0)
    quadrant = round_to_even(quarters)  # 0 to 4; 4 is a whole turn
    angle = 1.57079632679489661923 * (quarters - quadrant)
    sine, cosine = near_zero(angle)
    sine, cosine = quarter_turns(sine, cosine, quadrant)
    return radius * cosine, radius * sine


@kernel
def stream_of(flight):
    """The random stream of a flight at its present instant."""
    return (flight.key[0], flight.key[1], flight.instant)


@kernel
def six_normals(stream, draw):
    """Two vectors of independent standard normals, from three draws."""
    a, b = normal_pair(stream, draw)
    c, d = normal_pair(stream, draw + 1)
    e, f = normal_pair(stream, draw + 2)
    return (a, b, c), (d, e, f)
