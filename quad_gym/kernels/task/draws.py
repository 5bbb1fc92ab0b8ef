"""Domain randomization: parameters of a flight, drawn when an episode begins.

`flight.drawn` holds the drawn numbers in the order of `DRAWABLES`, which is also the order of the
first fields of a record of parameters. The other parameters are derived from them whenever flights
are stepped, so that the record alone defines a flight.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.elementary import clip, exp, log, minimum
from quad_gym.kernels.maths.random import stream_of, uniform_pair
from quad_gym.kernels.simd.blocks import numbers_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.kernels.task.derive import derive
from quad_gym.records import (
    DRAW_PARAMETERS,
    DRAWN_SIZE,
    FIXED,
    LOG_UNIFORM,
    NORMAL,
    PARAMETERS_DRAWN,
)

_FIRST = np.uint64(DRAW_PARAMETERS)
_HALF_STEP = 2.0**-53  #: moves a number on [0, 1) into (0, 1)


@kernel
def normal_quantile(p):
    """Return the x with Phi(x) = p, for p in (0, 1), to 16 digits.

    M. J. Wichura, "Algorithm AS 241: The percentage points of the normal distribution", Applied
    Statistics 37, 1988 (PPND16).
    """
    q = p - 0.5
    r = 0.180625 - q * q
    # fmt: off
    middle = q * (((((((r * 2509.0809287301226727 + 33430.575583588128105) * r
        + 67265.770927008700853) * r + 45921.953931549871457) * r
        + 13731.693765509461125) * r + 1971.5909503065514427) * r
        + 133.14166789178437745) * r + 3.387132872796366608) / (((((((r * 5226.495278852545925
        + 28729.085735721942674) * r + 39307.89580009271061) * r + 21213.794301586595867) * r
        + 5394.1960214247511077) * r + 687.1870074920579083) * r + 42.313330701600911252) * r + 1.0)
    s = math.sqrt(-log(minimum(p, 1.0 - p)))
    t = s - 1.6
    near = (((((((t * 7.7454501427834140764e-4 + 0.0227238449892691845833) * t
        + 0.24178072517745061177) * t + 1.27045825245236838258) * t
        + 3.64784832476320460504) * t + 5.7694972214606914055) * t + 4.6303378461565452959) * t
        + 1.42343711074968357734) / (((((((t * 1.05075007164441684324e-9
        + 5.475938084995344946e-4) * t + 0.0151986665636164571966) * t
        + 0.14810397642748007459) * t + 0.68976733498510000455) * t + 1.6763848301838038494) * t
        + 2.05319162663775882187) * t + 1.0)
    t = s - 5.0
    far = (((((((t * 2.01033439929228813265e-7 + 2.71155556874348757815e-5) * t
        + 0.0012426609473880784386) * t + 0.026532189526576123093) * t
        + 0.29656057182850489123) * t + 1.7848265399172913358) * t + 5.4637849111641143699) * t
        + 6.6579046435011037772) / (((((((t * 2.04426310338993978564e-15
        + 1.4215117583164458887e-7) * t + 1.8463183175100546818e-5) * t
        + 7.868691311456132591e-4) * t + 0.0148753612908506148525) * t
        + 0.13692988092273580531) * t + 0.59983220655588793769) * t + 1.0)
    # fmt: on
    tail = select(s <= 5.0, near, far)
    return select(abs(q) <= 0.425, middle, select(q < 0.0, -tail, tail))


@stage
def draw_stage(flight, world, model, settings, work, stages, flag):
    """Draw the parameters of a new episode.

    Each column has its own draw, so that a parameter does not depend on the other drawn ones.
    """
    stream, mask = stream_of(flight), work.mask > 0.0
    for k in range(DRAWN_SIZE):
        kind = settings.draw_kind[k]
        if kind != FIXED:
            u, _ = uniform_pair(stream, _FIRST + np.uint64(k))
            u = u + _HALF_STEP
            a, b = settings.draw_a[k], settings.draw_b[k]
            if kind == NORMAL:
                value = a + b * normal_quantile(settings.draw_c[k] + settings.draw_d[k] * u)
            elif kind == LOG_UNIFORM:
                value = a * exp(b * u)
            else:
                value = a + b * u
            # the bounds hold exactly
            value = clip(value, settings.draw_low[k], settings.draw_high[k])
            flight.drawn[k] = select(mask, value, flight.drawn[k])


@stage
def impose_stage(flight, world, model, settings, work, stages, flag):
    """Write the parameters of the current flights to `world`; `model`: the nominal ones."""
    own, nominal = numbers_of(world), numbers_of(model)
    for k in range(PARAMETERS_DRAWN):
        own[k] = flight.drawn[k] if settings.draw_kind[k] != FIXED else nominal[k]
    derive(world, model, settings)
