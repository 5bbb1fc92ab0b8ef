"""Whether a filter's NEES and NIS over many flights are those of a consistent filter."""

import numpy as np

STATE = ("state", "attitude", "accel_bias", "gyro_bias")
"""Parts whose errors hardly change in 10 s."""


def assert_consistent(nees, nis, whiteness, apart=()):
    """NEES of all parts and NIS of all sensors in their bands, innovations white.

    In the band of 95 % are 90 % of the instants, or the mean over all instants tells: where errors
    last, the instants are all in the band or all out of it, by chance. That mean is off by less
    than 3.5 deviations of one instant's if errors last as long as the flights, and by less than one
    if they last for a second or so, with 80 % of the instants in the band still.

    Args:
        nees: `MeanSquare` by part.
        nis: `MeanSquare` by sensor.
        whiteness: `Whiteness` by sensor.
        apart: Sensors whose innovations are not as in a filter that models everything.
    """
    found = nees | {f"NIS of {name}": part for name, part in nis.items() if name not in apart}
    for name, part in found.items():
        deviation = np.mean(part.high - part.low) / (2.0 * 1.96)
        off = abs(part.overall - part.dimension) / deviation
        by_mean = off < 1.0 and part.share_inside >= 0.8
        lasting = name in STATE and off < 3.5
        message = f"{name}: {part.share_inside:.3f} inside, {off:.2f} deviations off"
        assert part.consistent or by_mean or lasting, message
    for name, white in whiteness.items():
        assert white.white or name in apart, f"{name}: autocorrelation {white.largest:.3f}"
