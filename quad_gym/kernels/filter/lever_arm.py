"""The specific force at the center of mass, from an accelerometer that is mounted elsewhere.

The accelerometer at l_B measures the acceleration of that point (report section 2.3),

    a_l = a + d/dt [R^T (w x l)],

so that the filter subtracts R d/dt [R^T (w x l)] = dw x l + w x (w x l) from each sample. The gyro
measures w at the instants, and its differences give dw. Their noise is the noise of R^T (w x l) at
the two ends of a tick and does not add up over ticks: it leaves |l| sigma_gyro in the velocity,
which is far below the accuracy of GNSS and cameras, and is not modeled.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.linalg import cross, load3
from quad_gym.records import FilterForm

LEVER_ARM = int(FilterForm.LEVER_AVERAGES | FilterForm.LEVER_SAMPLES)
"""Bits of a `FilterForm` with which there is a lever arm."""


@kernel
def lever_force(flight, p, form, half):
    """Specific force that the lever arm adds to the tick's sample, in B.

    A sample that is the mean over the tick contains the change of R^T (w x l), in the body frame
    halfway: `half` rotates from the attitude at the tick's start to it. For a sample of the tick's
    start, dw comes from the sample before.
    """
    l_B, b_g, rate = load3(p.imu_lever_arm), load3(flight.b_g_hat), 1.0 / p.dt
    w, w_before = load3(flight.w_meas) - b_g, load3(flight.w_before) - b_g
    if (form & FilterForm.LEVER_AVERAGES.value) != 0:
        return rate * (half.T @ cross(w, l_B) - half @ cross(w_before, l_B))
    dw = rate * (w - w_before)
    return cross(dw, l_B) + cross(w, cross(w, l_B))
