"""Anti-aliasing: halving a picture by the mean of two by two pixels."""

import numpy as np

from quad_gym.kernels import entries
from quad_gym.kernels.compiling import entry
from quad_gym.kernels.compiling.signatures import signature_of

_EVEN, _HALF = np.uint32(0x00FF00FF), np.uint32(0x00020002)
_TWO, _EIGHT = np.uint32(2), np.uint32(8)


@entry(signature=signature_of(entries.halve))
def halve(large, small):
    """Write the rounded means of two by two pixels.

    A pixel is a word of four bytes, of which two at a time are summed in the halves of a word.

    Args:
        large: Picture to halve, (2 height, 2 width) uint32.
        small: Result, (height, width) uint32, overwritten.
    """
    for i in range(small.shape[0]):
        for j in range(small.shape[1]):
            a, b = large[2 * i, 2 * j], large[2 * i, 2 * j + 1]
            c, d = large[2 * i + 1, 2 * j], large[2 * i + 1, 2 * j + 1]
            even = (a & _EVEN) + (b & _EVEN) + (c & _EVEN) + (d & _EVEN) + _HALF
            odd = ((a >> _EIGHT) & _EVEN) + ((b >> _EIGHT) & _EVEN)
            odd += ((c >> _EIGHT) & _EVEN) + ((d >> _EIGHT) & _EVEN) + _HALF
            small[i, j] = ((even >> _TWO) & _EVEN) | (((odd >> _TWO) & _EVEN) << _EIGHT)
