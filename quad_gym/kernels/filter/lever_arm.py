"""The specific force at the center of mass, from an accelerometer that is mounted elsewhere.

The accelerometer at l_B feels the acceleration of its own point (report section 2.3),

    a_l = a + d/dt [R^T (w x l)],

so that the filter takes R d/dt [R^T (w x l)] = dw x l + w x (w x l) from each sample. The gyro
tells w at the instants, and its differences tell dw. Their noise is that of R^T (w x l) at the two
ends of a tick and does not add up over ticks: it leaves |l| sigma_gyro in the velocity, which is
far below what GNSS and cameras tell about it and is not modeled.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.linalg import add, apply, apply_transposed, cross, load3, scale, sub
from quad_gym.records import FilterForm

_OF_AVERAGES, _OF_SAMPLES = int(FilterForm.LEVER_AVERAGES), int(FilterForm.LEVER_SAMPLES)
LEVER_ARM = _OF_AVERAGES | _OF_SAMPLES
"""Bits of a `FilterForm` with which there is a lever arm."""


@kernel
def lever_force(flight, p, form, half):
    """What the lever arm adds to the specific force of the tick's sample, in B.

    A sample that is the mean over the tick has the change of R^T (w x l) over it, seen from the
    attitude halfway. A sample of the tick's start has dw from the sample before.

    Args:
        flight: Record; reads w_meas and w_before.
        p: Parameters as the filter believes them.
        form: A `FilterForm`.
        half: Turn from the attitude at the start of the tick to that halfway, for means.
    """
    l_B, b_g, rate = load3(p.imu_lever_arm), load3(flight.b_g_hat), 1.0 / p.dt
    w, w_before = sub(load3(flight.w_meas), b_g), sub(load3(flight.w_before), b_g)
    if (form & _OF_AVERAGES) != 0:
        after, before = cross(w, l_B), cross(w_before, l_B)
        return scale(rate, sub(apply_transposed(half, after), apply(half, before)))
    dw = scale(rate, sub(w, w_before))
    return add(cross(dw, l_B), cross(w, cross(w, l_B)))
