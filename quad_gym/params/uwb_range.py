"""Ranges to anchors by ultra-wideband radio, and their errors."""

from functools import partial
from typing import Annotated, ClassVar

from quad_gym.params import checks as check
from quad_gym.params.aids import AidParams

MOST_ANCHORS = 8  #: as in the Crazyflie firmware


class UwbRangeParams(AidParams):
    """A radio that measures its distances to anchors of known places, such as a DWM1000.

    It measures `|r_I + R_BI^T tag_B - a_I| + noise` to each anchor a in turn, within milliseconds,
    as in two-way ranging of the Crazyflie's Loco positioning system: one instant for all. The
    filter accepts or rejects each range by itself.
    """

    rate: float = 25.0
    """rate of the ranges to each anchor [Hz]; a two-way range takes some milliseconds, and four of
    them, one after the other, a few more; engineering judgment"""
    noise_sigma: check.Positive = 0.1
    """standard deviation of the white noise [m]; Decawave DWM1000 data sheet: 10 cm. The Crazyflie
    firmware assumes 0.25 m for two-way ranges (lpsTwrTag.c)"""
    anchors_I: Annotated[check.Matrix, partial(check.places, most=MOST_ANCHORS)] = (
        (-5.0, -5.0, 0.2),
        (5.0, -5.0, 3.0),
        (5.0, 5.0, 0.2),
        (-5.0, 5.0, 3.0),
    )
    """(n, 3) places of the anchors in I [m], at most eight, as in the Crazyflie firmware; corners
    of a hall of 10 m, low and high in turn"""
    tag_B: check.Place = (0.0, 0.0, 0.0)
    """(3,) place of the radio's antenna in B [m]; near the center of mass of a small vehicle"""
    max_range: check.Positive = 60.0
    """longest range [m]; engineering judgment, for a line of sight"""
    outlier_probability: Annotated[float, check.between(0.0, 1.0)] = 0.01
    """share of ranges that are longer than the distance, as the signal takes a detour where the
    direct path is blocked; the filter does not model them; engineering judgment"""
    outlier_size: check.NonNegative = 1.0
    """longest detour, which is uniform from zero on [m]; engineering judgment"""

    _ideal: ClassVar = {"latency": 0.0, "outlier_probability": 0.0}
    most_blocks, rows, observes = MOST_ANCHORS, 2 + MOST_ANCHORS, ("position", "height", "velocity")
    reads_velocity = False
    words, unit, frame, meaning = "ranges to anchors", "m", "-", "distances to the anchors"
    raw = ("m", "-", 100.0)

    @property
    def blocks(self) -> int:
        """Number of the anchors."""
        return len(self.anchors_I)

    @property
    def places_I(self) -> check.Matrix:
        """Places of the anchors (n, 3) in I [m]."""
        return self.anchors_I

    @property
    def numbers(self) -> check.Matrix:
        """The antenna; the longest range, probability and size of outliers; the anchors."""
        limits = (self.max_range, self.outlier_probability, self.outlier_size)
        return (self.tag_B, limits, *self.anchors_I)
