"""GNSS baseline: the direction from the primary to the secondary antenna.

It measures `z = unit(R^T l_b)` in I with noise across that direction. With a pair of sigma points,
R(+-e) R_hat = (I + even +- odd) R_hat, that is R_hat^T odd^T u and R_hat^T even^T u, u = unit(l_b);
the derivative along an offset is R_hat^T (de x u).

Noise n across a unit vector shortens its part along the direction by n^2 / 2, whose mean square is
2 sigma^4 for two axes of standard deviation sigma. It is added along the direction if sigma exceeds
`_COARSE`: the sigma points of an uncertain attitude are shortened, too, so that the filter would
attribute an innovation along the direction to the attitude.

A heading alone is a level baseline of which only the horizontal component across it was measured.
A sigma above pi says so: it adds this noise along the other two axes.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.covariance_resets import reset_heading
from quad_gym.kernels.filter.directions import direction_noise
from quad_gym.kernels.filter.rows import lever_column, put_block, put_column
from quad_gym.kernels.maths.linalg import (
    cross,
    dot,
    keep,
    load3,
    load33,
    norm,
    outer,
    rounded,
    unit_or,
)
from quad_gym.kernels.simd.lanes import any_of, select, zero_like

_COARSE = 0.05
"""Noise up to which this term is left out [rad], as in the laboratory: it makes no difference."""


@kernel
def noisy_baseline(r_b, normals, sigma_b, floor, length):
    """Measured baseline of known length, covariance |r_b|^2 sigma_b^2 (I - u u^T) + floor I.

    The symmetric root of that covariance is a (I - u u^T) + b u u^T (report equation 1, section
    3.1).
    """
    size = norm(r_b)
    u = (1.0 / size) * r_b
    b = math.sqrt(floor)
    a = math.sqrt((size * sigma_b) * (size * sigma_b) + floor)
    noisy = a * normals + r_b + rounded((b - a) * dot(u, normals) * u)
    return (length / norm(noisy)) * noisy


@kernel
def measure(flight, p, R_BI, normals, mask):
    """Measure the baseline in G, in the lanes `mask`."""
    r_b = load33(p.R_IG).T @ (R_BI.T @ load3(p.baseline))
    sigma, floor, length = p.baseline_sigma, p.direction_floor, p.baseline_length
    keep(flight.gnss_baseline, mask, noisy_baseline(r_b, normals, sigma, floor, length))


@kernel
def expect(flight, p, work, settings, k, valid):
    """Fill rows k to k + 2."""
    R_BI, u_B = load33(flight.R_hat), (1.0 / p.baseline_length) * load3(p.baseline)
    u_I, z = R_BI.T @ u_B, load33(p.R_IG) @ load3(flight.gnss_baseline)
    noise = direction_noise(u_I, p.baseline_noise * p.baseline_noise, p.direction_floor)
    white = p.baseline_sigma * p.baseline_sigma
    along = select(p.baseline_sigma > _COARSE, 2.0 * white * white, 0.0)
    noise = noise + outer(along * u_I, u_I)
    alone = p.baseline_sigma > math.pi
    if any_of(alone):
        side = unit_or((-u_I[1], u_I[0], zero_like(u_I[0])), (1.0, 0.0, 0.0))
        up = cross(u_I, side)
        noise = noise + outer(select(alone, along, 0.0) * up, up)
    put_block(work, settings, k, valid, (1.0 / norm(z)) * z, u_I, noise)
    for j in range(9):
        a, s = lever_column(flight, work, settings, j, R_BI, u_B)
        put_column(work, settings, k, j, valid, a, s)


@kernel
def reset(flight, work, states, lanes, nu):
    """Reset the heading to the sideward innovation."""
    reset_heading(work.P, load33(flight.R_hat), states, lanes, nu[0] * nu[0] + nu[1] * nu[1])
