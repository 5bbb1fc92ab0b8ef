"""Rules of the verdict on innovations: their size, correlation, and runs of rejections."""

import math
from collections.abc import Iterator

import numpy as np

from quad_gym.estimation.replaying.cases import (
    FALSE_ALARM,
    MEASURED_BY,
    NAMES,
    OF_SENSOR,
    Case,
    lost,
    note,
    uncertain,
)
from quad_gym.estimation.replaying.dead_reckoning import SETTLED
from quad_gym.estimation.replaying.findings import Finding, Severity
from quad_gym.estimation.replaying.fits import (
    MIN_COUNT,
    Fit,
    correlations,
    exceeds,
    larger,
    runs_beyond_chance,
)
from quad_gym.estimation.replaying.results import Measured

RATIO = 2.0  #: ratio of true and assumed standard deviations with which a filter still works [-]
MAX_REJECTED = 0.1  #: share of the measurements of a sensor that the gate rejects [-]
LONG_RUN = 0.1  #: share of the measurements of a sensor that are rejected in one run [-]
MAX_MEAN = 25.0
"""Mean NIS per degree of freedom that no noise model explains: standard deviations five times as
large. Outliers that chance explains are left out of the mean."""
MAX_CORRELATED = 0.8  #: correlation of successive innovations of GNSS that noise does not have
PESSIMISTIC = 0.3
"""NIS per degree of freedom below which noise is assumed much too large: innovations of such a
filter are correlated, as it follows the measurements slowly."""
PATIENCE = 10.0  #: time for which GNSS may be refused [s]


def misfits(case: Case) -> Iterator[Finding]:
    """Innovations that are larger, smaller or more correlated than the suite has them."""
    for name, fit in case.fits.items():
        m, quantity = case.sensors[name], OF_SENSOR.get(name, "position")
        yield from _size(case, name, m, fit)
        if name.startswith("gnss") and len(m.nis) >= MIN_COUNT:
            yield from _correlated(name, m, quantity)
        if fit.mean_nis < PESSIMISTIC:
            factor = 1.0 / math.sqrt(max(fit.mean_nis, 1e-6))
            yield note(
                quantity,
                f"{_nis(name, fit)}: pessimistic, noise is assumed about {factor:.1f} times too "
                "large",
            )


def _nis(name: str, fit: Fit) -> str:
    return f"{NAMES[name]}: NIS per degree of freedom {fit.mean_nis:.3g}, 1 expected"


def _size(case: Case, name: str, m: Measured, fit: Fit) -> Iterator[Finding]:
    """Innovations of a sensor that are too large, or rejected for long."""
    quantity = OF_SENSOR.get(name, "position")
    known = np.isfinite(m.nis)
    nis, d = m.nis[known], fit.freedoms
    others = any(other in case.fits for other in MEASURED_BY[quantity] if other != name)
    shared = quantity == "height" and others
    ratio = RATIO**2 if not shared else RATIO**4
    many = exceeds(m.rejected[known], MAX_REJECTED)
    heavy = larger(nis, d, RATIO) and fit.mean_nis > 2.0 * ratio  # in the median, and in the mean
    rows = known & (m.time > m.time[0] + SETTLED)
    runs = runs_beyond_chance(m.rejected[rows], FALSE_ALARM)
    longest = max(runs, key=lambda run: run[1] - run[0], default=None)
    share = 0.0 if longest is None else (longest[1] - longest[0] + 1) / len(nis)
    rejected = f"{100.0 * fit.rejected:.0f} % rejected"
    far = _mean_with_runs(m, known, rows, runs) > MAX_MEAN * d
    if larger(nis, d, ratio) or heavy or (not shared and (many or far)):
        text = f"{_nis(name, fit)}, {rejected}: the suite's noise model does not fit this log"
        yield lost(quantity, text)
    elif many or larger(nis, d, RATIO):
        factor = math.sqrt(max(fit.median_nis, 1.0))
        yield uncertain(
            quantity,
            f"{_nis(name, fit)}, {rejected}: errors about {factor:.1f} times as large as the suite "
            "has them",
        )
    if longest is None:
        return
    since, until = m.time[rows][list(longest)]
    text = f"{NAMES[name]} refused for {until - since:.1f} s in a row from {since:.1f} s on"
    long = quantity == "position" and until - since >= PATIENCE
    if not shared and (long or share > LONG_RUN):
        yield lost(quantity, f"{text}: it drifts or jumps, or others do")
    elif not many:
        yield uncertain(quantity, text)


def _mean_with_runs(
    m: Measured, known: np.ndarray, rows: np.ndarray, runs: list[tuple[int, int]]
) -> float:
    """Return the mean NIS without the rejections that chance explains."""
    counts = known & ~m.rejected
    settled = np.flatnonzero(rows)
    for begin, end in runs:
        counts[settled[begin : end + 1]] = True
    return float(m.nis[counts].mean()) if counts.any() else math.inf


def _correlated(name: str, m: Measured, quantity: str) -> Iterator[Finding]:
    """Innovations whose successive values are correlated, in the worst axis of each quantity."""
    scaled = (m.innovation / m.sigma)[np.isfinite(m.nis) & ~m.gated]
    scaled = scaled[len(scaled) // 5 :]
    if len(scaled) < MIN_COUNT:
        return
    rho, size = correlations(scaled), (scaled**2).mean(axis=0)
    parts = ((0, 1), "position"), ((2,), "height")
    for axes, part in parts if name == "gnss_position" else (((*range(len(rho)),), quantity),):
        worst = max(axes, key=lambda k: rho[k])
        # the lower end of the interval, by Fisher's transformation
        sure = math.tanh(math.atanh(min(rho[worst], 0.999)) - 3.0 / math.sqrt(len(scaled) - 3))
        if sure > MAX_CORRELATED and size[worst] > PESSIMISTIC:
            text = (
                f"{NAMES[name]}: successive innovations have a correlation of {rho[worst]:.2f}, 0 "
                "expected: check the suite's time stamps and noise"
            )
            severity = Severity.UNCERTAIN if part == "height" else Severity.LOST
            yield Finding(quantity=part, severity=severity, text=text)
