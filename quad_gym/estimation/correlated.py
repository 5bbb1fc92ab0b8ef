"""Positions with correlated errors, for filters with standard deviations along the axes of I.

With the covariance C = T^T diag(s^2) T the errors are independent along the rows of T. The state is
therefore rotated into the frame of T (r, v, the drift of GNSS, R_BI; error angles and biases are in
B already), updated with the standard deviations s, and rotated back. Nothing is approximated.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from quad_gym.estimation.engine import Engine, Floats
from quad_gym.estimation.samples import Measurement
from quad_gym.estimation.starts import lower_factor
from quad_gym.records import POSITION_BLOCK


def in_principal_axes(covariance: Floats) -> tuple[Floats, Floats]:
    """Return the rotation T and the standard deviations s of a covariance T^T diag(s^2) T."""
    variances, axes = np.linalg.eigh(covariance)
    T = axes.T
    if np.linalg.det(T) < 0.0:
        T[0] = -T[0]
    return T, np.sqrt(variances)


def turn_state(engine: Engine, T: Floats) -> None:
    """Rotate all parts of the estimate that are in I, and the rotation of GNSS positions to I."""
    drifts = bool(engine.settings["estimates_drift"][0])
    for name in ("r_hat", "v_hat"):
        engine.write(name, engine.read(name) @ T.T)
    engine.write("R_hat", engine.read("R_hat") @ T.T)
    R_IG = engine.params["R_IG"]
    engine.params["R_IG"] = np.einsum("ij,bjkl->bikl", T, R_IG)
    if drifts:
        slow = engine.read("slow_hat")
        slow[:, :3] = slow[:, :3] @ T.T
        engine.write("slow_hat", slow)
    joint = engine.factors()
    for first in (0, 3, *((15,) if drifts else ())):
        joint[:, first : first + 3] = T @ joint[:, first : first + 3]
    engine.write_factors(np.array([lower_factor(root) for root in joint]))


def update_with_correlated(
    engine: Engine,
    condition: Callable[[Measurement], None],
    measurement: Measurement,
    covariance: Floats,
) -> None:
    """Update with a single position whose errors have a (3, 3) covariance in I [m^2]."""
    T, sigmas = in_principal_axes(covariance)
    expected = _innovation_sigmas(engine, covariance)
    R_IG = engine.params["R_IG"].copy()
    turn_state(engine, T)
    noise = {**measurement.noise, "position_sigma_I": sigmas}
    condition(dataclasses.replace(measurement, noise=noise))
    turn_state(engine, T.T)
    engine.params["R_IG"] = R_IG
    if len(expected) != engine.lanes:  # one heading is left
        expected = expected[:1].repeat(engine.lanes, axis=0)
    for name, of_position in (
        ("innovation", engine.read("innovation")[:, POSITION_BLOCK] @ T),
        ("innovation_sigma", expected),
    ):
        kept = engine.read(name)
        kept[:, POSITION_BLOCK] = of_position
        engine.write(name, kept)


def _innovation_sigmas(engine: Engine, covariance: Floats) -> Floats:
    """Return the standard deviations (lanes, 3) of a position's innovation in I, to first order."""
    gnss, L, R_BI = engine.sensors.gnss, engine.read("L"), engine.read("R_hat")
    assert gnss is not None
    x, y, z = gnss.primary_antenna_B
    turned = R_BI.swapaxes(1, 2) @ np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    root = L[:, 0:3] - turned @ L[:, 6:9]
    if engine.settings["estimates_drift"][0]:
        rows = engine.read("L_slow")[:, :3]
        rows[:, :, :15] += root
        root = rows
    variances = (root**2).sum(axis=2) + np.diag(covariance)
    return np.sqrt(variances)
