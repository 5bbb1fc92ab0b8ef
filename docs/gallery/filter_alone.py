"""
Run the filter on a log, step by step
=====================================

``UnscentedKalmanFilter`` filters any log of measurements. Here ``FlightBatch`` makes a log, and the
filter alone reproduces the estimate of that flight.
"""

import matplotlib.pyplot as plt
import numpy as np

import quad_gym
from quad_gym.analysis.metrics import chi_square_band, nees, state_error
from quad_gym.estimation import UnscentedKalmanFilter
from quad_gym.frames import ecef_to_enu

# %%
# A log
# -----
#
# One flight of the circle, under PD control, with GNSS ten times a second and no camera. It steps
# once per IMU sample, 200 times a second. ``read`` returns a quantity of all flights; ``[0]``
# takes the only one. It has fixes in the inertial frame I, and NaN where there was none; the filter
# takes them in the Earth-centered frame G, relative to the reference antenna.

suite = quad_gym.sensor_suite("standard")
suite = suite.replace(gnss=suite.gnss.replace(rate=10.0), camera=None)
batch = quad_gym.FlightBatch(1, sensors=suite, gains="tuned")
batch.reset(seeds=[3])


def read(*names):
    """Some quantities of the flight."""
    return {name: batch.read(name)[0] for name in names}


GNSS = ("gnss_position", "gnss_baseline")
TRUTH = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias")
log = [read(*GNSS, *TRUTH)]
for _ in range(2000):
    batch.step()
    log.append(read("gyro", "accel", *GNSS, *TRUTH, "estimated_position"))

# %%
# The filter
# ----------
#
# It starts from the first fix. From then on, ``predict`` takes each IMU sample, and ``update``
# takes the available measurements.

ukf = UnscentedKalmanFilter(sensors=suite)
R_IG = ecef_to_enu(suite.gnss.reference_antenna_G)
ukf.initialize(*(log[0][name] @ R_IG for name in GNSS))
positions, sigmas, squares, differences = [], [], [], []
for row in log[1:]:
    ukf.predict(row["gyro"], row["accel"])
    if np.isfinite(row["gnss_position"]).all():
        ukf.update(
            gnss_position_G=row["gnss_position"] @ R_IG,
            gnss_baseline_G=row["gnss_baseline"] @ R_IG,
        )
    truth = {name: row[name] for name in TRUTH}
    estimate = {name: getattr(ukf, name) for name in truth}
    squares.append(nees(state_error(truth, estimate), ukf.covariance))
    positions.append(row["position"] - ukf.position)
    sigmas.append(np.sqrt(np.diag(ukf.covariance)[:3]))
    differences.append(np.abs(row["estimated_position"] - ukf.position).max())
print(f"largest difference from the estimate of the flight: {max(differences):.1e} m")

# %%
# Error and standard deviation
# ----------------------------

time = np.arange(1, len(log)) * suite.imu.dt
figure, axes = plt.subplots(4, 1, sharex=True, figsize=(7, 7))
for axis, name in enumerate(("east", "north", "up")):
    error, sigma = 1e3 * np.array(positions)[:, axis], 1e3 * np.array(sigmas)[:, axis]
    axes[axis].fill_between(time, -3 * sigma, 3 * sigma, color="C1", alpha=0.25, linewidth=0)
    axes[axis].plot(time, error, color="C0")
    axes[axis].set(ylabel=f"{name} [mm]", ylim=(-80, 80))
axes[0].set_title("Error of the position within 3 sigma")
band = chi_square_band(15)
axes[3].axhspan(band.low, band.high, color="0.9", label="95 % of a consistent filter")
axes[3].plot(time, squares)
axes[3].set(xlabel="time [s]", ylabel="NEES")
axes[3].legend(loc="upper right")

# %%
# A real log works the same way. Make a suite with the noise and geometry of your sensors (see
# :doc:`sensor_suite`), and let :doc:`replay` read the log.
