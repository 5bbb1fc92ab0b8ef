"""Rules of the filter, driven stage by stage: eight flights at once, each beside another limit."""

import numpy as np

from quad_gym.kernels.entries import FILTER_ENTRIES, FILTER_STAGES, linked_table, run_stage
from quad_gym.kernels.stages import needed_stages
from quad_gym.packing import form_of
from quad_gym.records import joint_covariance, lower_triangle
from tests.lane_filter import EIGHT, LaneFilter

NEVER = -1e9


class LaneRules(LaneFilter):
    """EIGHT filters that hover level at the origin at `tick`, and have measured nothing lately.

    Args:
        sensors: Suite of the filter.
        sigma: Standard deviations of position, velocity, attitude and biases; their errors are
            independent.
        innovations: True for a filter that stores innovations, also without a gate.
    """

    tick = 100_000.0

    def __init__(self, sensors, sigma=(0.1, 0.1, 0.05, 0.02, 0.002), innovations=False):
        super().__init__(sensors)
        self.form = int(form_of(sensors, innovations))
        self.settings["form"] = self.form
        stages = needed_stages(self.settings[0])
        stages = {stage: stages[stage] for stage in FILTER_STAGES if stage in stages}
        self._table = linked_table(stages, FILTER_ENTRIES)
        self.dt = sensors.imu.dt
        self.set(
            tick=self.tick,
            R_hat=np.eye(3),
            noise_factor=1.0,
            nis_ratio=1.0,
            accepted_tick=NEVER,
            refused_tick=NEVER,
            alarm_tick=NEVER,
            level_tick=NEVER,
            corrected_tick=self.tick,
            level_turn=np.eye(3),
        )
        self.slow = int(self.settings["slow_states"][0])
        slow = self.params["slow_sigma"][0, : self.slow, 0]
        self.set_covariance(np.diag(np.square([*np.repeat(sigma, 3), *slow])))

    def set_covariance(self, covariance):
        """Set the covariances of position, velocity, attitude, biases and slow errors."""
        lower = np.zeros((EIGHT, 15 + self.slow, 15 + self.slow))
        lower[:] = lower_triangle(covariance)
        rows = self.get("P_slow")
        rows[:, : self.slow, : 15 + self.slow] = lower[:, 15:]
        self.set(P=lower[:, :15, :15], P_slow=rows)

    def covariance(self):
        """Return the covariances (EIGHT, n, n) in the same order."""
        return joint_covariance(self.get("P"), self.get("P_slow")[:, : self.slow])

    def set_sigma(self, row, sigma):
        """Make a state independent of others, with this standard deviation, or one for each."""
        covariance = self.covariance()
        covariance[:, row], covariance[:, :, row] = 0.0, 0.0
        covariance[:, row, row] = np.square(sigma)
        self.set_covariance(covariance)

    def set(self, **values):
        """Set fields of all flights, to the same value or to one for each, (EIGHT, ...)."""
        for name, value in values.items():
            shape = self.get(name).shape[1:]
            each = np.broadcast_to(np.asarray(value, dtype=float), (EIGHT, *shape)).copy()
            for number in range(EIGHT):
                self.put(number, **{name: each[number]})

    def change(self, name, index, value):
        """Set one number of a field, or some, of all flights, to a value or one for each."""
        values = self.get(name)
        values[(slice(None), *np.atleast_1d(index))] = value
        self.set(**{name: values})

    def measured(self, block, value):
        """Give all flights a measurement of a block, (3,) or (EIGHT, 3)."""
        self.change("block_valid", block, 1.0)
        self.change("measurement", block, value)

    def run(self, stage, flag=0, lanes=(True,) * EIGHT):
        """Run a stage, in these flights."""
        for block, params, settings, work in self._each(lanes):
            work["taking"][0] = work["mask"][0]
            work["again"][0] = 0.0
            run_stage(
                block.ctypes.data, 0, 1, int(stage), params, params, settings, work,
                self._table, flag,
            )  # fmt: skip
