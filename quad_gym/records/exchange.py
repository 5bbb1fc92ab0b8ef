"""Fields that kernels exchange with a user's estimator at every tick, apart from the flights.

Flights are large, and at most ticks a user's estimator needs no more than these numbers.
"""

from quad_gym.records.sizes import Field

SAMPLES = ("gyro", "accel", "w_meas")
"""Fields of flights that are copied to the exchange after a tick."""

ESTIMATED = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat", "w_hat")
"""Fields of flights that are copied from the exchange before they are observed."""

EXCHANGE_FIELDS = tuple(
    Field(name, (3, 3) if name == "R_hat" else (3,), "mixed", "as in a flight")
    for name in (*SAMPLES, *ESTIMATED)
)
