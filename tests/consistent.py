"""Check of the NEES, NIS and innovations of a filter over many flights; a start for it."""

import numpy as np

from quad_gym import records
from quad_gym.analysis.consistency import FIELDS, PARTS
from quad_gym.analysis.metrics import STATE_DIMENSION
from quad_gym.rotations import euler_to_dcm, quaternion_to_dcm

STATE = ("state", "attitude", "accel_bias", "gyro_bias")
"""Parts of the state with errors that hardly change in 10 s."""

NEGLIGIBLE = 0.03
"""Largest relative error of a mean NEES or NIS that matters to nobody. It is 1.5 % of a standard
deviation. With enough flights any filter of a nonlinear model has a significant error."""


def assert_consistent(nees, nis, whiteness, apart=()):
    """Check that all NEES and NIS are in their bands, and that innovations are white.

    A part passes with 90 % of its instants in the 95 % band. If errors are correlated over time,
    the instants may all be outside by chance; then the mean over all instants decides. It must be
    off by less than 3.5 standard deviations of one instant for errors that last as long as the
    flights (`STATE`), and by less than one, or `NEGLIGIBLE`, with 80 % of the instants in the
    band, for others.

    Args:
        nees: `MeanSquare` by part.
        nis: `MeanSquare` by sensor.
        whiteness: `Whiteness` by sensor.
        apart: Sensors to skip, because the filter does not model all of their errors.
    """
    found = nees | {f"NIS of {name}": part for name, part in nis.items() if name not in apart}
    for name, part in found.items():
        deviation = np.mean(part.high - part.low) / (2.0 * 1.96)
        error = abs(part.overall - part.dimension)
        off = error / deviation
        negligible = error < NEGLIGIBLE * part.dimension
        by_mean = (off < 1.0 or negligible) and part.share_inside >= 0.8
        lasting = name in STATE and off < 3.5
        message = f"{name}: {part.share_inside:.3f} inside, off by {off:.2f} sigma"
        assert part.consistent or by_mean or lasting, message
    for name, white in whiteness.items():
        assert white.white or name in apart, f"{name}: autocorrelation {white.largest:.3f}"


def start_matched(batch, seed):
    """Give all filters of flights that have just been reset errors drawn from their covariances.

    After a first fix, errors and covariance do not match: a level attitude is assumed with an
    assumed uncertainty, which matters for as long as tilt and accelerometer bias cannot be
    distinguished. Here the estimates become the truth minus errors drawn from each filter's
    covariance.
    """
    flights, factor = batch.count, batch.record("L")
    draws = np.random.default_rng(seed).normal(size=(flights, STATE_DIMENSION, 1))
    errors = (factor @ draws)[..., 0]
    estimates = {
        f"{field}_hat": batch.record(field) - errors[:, PARTS[name]]
        for name, field in FIELDS.items()
    }
    turned = np.swapaxes(euler_to_dcm(errors[:, PARTS["attitude"]]), 1, 2)
    estimates["R_hat"] = turned @ quaternion_to_dcm(batch.record("q"))
    blocks, flight = batch.snapshot(), np.arange(flights)
    for name, values in estimates.items():
        blocks[name][flight // records.WIDTH, ..., flight % records.WIDTH] = values
    batch.restore(blocks)
