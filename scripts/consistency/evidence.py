"""Evidence of a fault in the measurements: the detections of an ideal test.

At a given rate of false alarms, no test detects a fault more often than the ratio of two
likelihoods of all measurements (the Neyman-Pearson lemma): with this fault, at its time and with
its size and direction, and without a fault. Twice its logarithm is the difference of the sums of
NIS of two filters, of which only the first ignores the fault. The second models it, so it has the
innovations of the same flight without the fault.

Without a fault, the ratio ever exceeds 1 / p with a probability of at most p (J. Ville, 1939). A
fault with less `evidence` than `REQUIRED` is thus undetectable even by an ideal test with the false
alarms of the filter's monitor, which in addition does not have time, size and direction.

Both filters have no gate, and the controller has the truth, so that flights are the same. The
blocks of measurements of an instant count as independent, as their noise exceeds the uncertainty of
the estimate.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from quad_gym.commands.consistency import Case
from quad_gym.records import Source

FALSE_ALARM = 2e-5
"""Probability that the sums of corrections of a consistent filter exceed their limit, see
`quad_gym.kernels.filter.measurements`."""
REQUIRED = -2.0 * math.log(FALSE_ALARM)
"""Evidence that an ideal test with this probability of false alarms requires."""


def evidence_of(
    case: Case, *, seeds: Sequence[int], duration: float, threads: int | None = None
) -> NDArray[np.float64]:
    """Twice the logarithm of the likelihood ratio of the faults of a case, (flights,).

    Args:
        case: Flights with faults.
        seeds: Seeds of the flights.
        duration: Length of the flights [s].
        threads: Number of threads.
    """
    estimator = case.sensors.estimator.replace(false_alarm_probability=0.0)
    on_truth = {**case.keywords, "source": Source.TRUTH, "run_filter": True}
    twins = [
        replace(case, sensors=case.sensors.replace(estimator=estimator), keywords=keywords)
        for keywords in (on_truth, on_truth | {"faults": None})
    ]
    faulty, sound = (twin.batch(len(seeds), threads) for twin in twins)
    found = np.zeros(len(seeds))
    for batch in (faulty, sound):
        batch.reset(seeds=seeds)
    for _ in range(round(duration * case.sensors.imu.rate)):
        for batch in (faulty, sound):
            batch.step()
        both = (faulty.record("block_valid") > 0.0) & (sound.record("block_valid") > 0.0)
        more = faulty.record("block_nis") - sound.record("block_nis")
        found += np.where(both[:, : more.shape[1]], more, 0.0).sum(axis=1)
    return found
