"""Observations of the included policies for LookAround and OutageDash, as tasks."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from baselines.pd import MARGIN, SIGMAS
from quad_gym.params import checks as check
from quad_gym.tasks.look_around import LookAround
from quad_gym.tasks.outage_dash import OutageDash
from quad_gym.tasks.task import ObservationSpec

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

TYPICAL = 0.03  #: typical standard deviation of the position while markers are in view [m]

_SCALES = {
    "position_error": (0.0, 6.0),
    "velocity_error": (0.0, 4.0),
    "body_rates": (0.0, 2.0),
    "next_gap": (0.0, 12.0),
    "gap_width": (4.5, 1.5),
    "next_width": (4.5, 1.5),
}
"""Centers and half ranges of parts of the observation of `OutageDash`, in their units; parts that
contain the truth, `actual_NAME`, have these scales, too."""

Parts = dict[str, NDArray[np.float64]]


def _sigma(view: "View") -> NDArray[np.float64]:
    """Largest standard deviation of the position along an axis, (n,) [m]; 0 without a filter."""
    try:
        return np.asarray(view.estimate.position_sigma.max(axis=1))
    except ValueError:  # no filter runs with observation="truth"
        return np.zeros(view.count)


class WithStd(LookAround):
    """`LookAround` whose observation also contains the standard deviation of the position.

    It is observed as log10(sigma / `TYPICAL`), where sigma is the largest standard deviation along
    an axis, so that a doubling of millimeters and a doubling of meters are the same difference.

    Args:
        factor: Factor on the standard deviation that is observed.
    """

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self._factor = check.positive("factor", factor)

    observes: Mapping[str, ObservationSpec] = {
        **LookAround.observes,
        "log_sigma": ObservationSpec("log10", "I", -1.0, 6.0),
    }

    def observe(self, view: "View") -> Parts:
        """Return `features_direction` (n, 3) and `log_sigma` (n,)."""
        sigma = self._factor * _sigma(view)
        return {**super().observe(view), "log_sigma": np.log10(np.maximum(sigma, 1e-9) / TYPICAL)}


def scaled_parts(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Convert parts of an observation of `OutageDash`, or their bounds, to those of `Scaled`."""
    found = {}
    for name, part in parts.items():
        middle, half = _SCALES.get(name.removeprefix("actual_"), (0.0, 0.0))
        found[f"{name}_scaled" if half else name] = (part - middle) / half if half else part
    return found


def _scaled_specs(specs: Mapping[str, ObservationSpec]) -> dict[str, ObservationSpec]:
    """Specifications of `OutageDash` in `Scaled`: scaled parts are dimensionless."""
    low = scaled_parts({name: spec.low for name, spec in specs.items()})
    high = scaled_parts({name: spec.high for name, spec in specs.items()})
    return {
        shown: spec._replace(
            unit=spec.unit if shown in specs else "-", low=low[shown], high=high[shown]
        )
        for shown, spec in zip(low, specs.values(), strict=True)
    }


class Scaled(OutageDash):
    """`OutageDash` whose observation is normalized to values of the order of one.

    Gaps are 12 m apart, but body rates are a few tenths of rad/s: in SI units, a network long
    learns only from the former. The position error is divided by 6 m, the velocity error by 4 m/s,
    the body rates by 2 rad/s, and the vector between gaps by 12 m; widths w become
    (w - 4.5 m) / 1.5 m. Normalized parts have other names, such as `position_error_scaled`, so that
    policies for `OutageDash` are rejected in this task, and vice versa.
    """

    observes: Mapping[str, ObservationSpec] = _scaled_specs(OutageDash.observes)

    def observe(self, view: "View") -> Parts:
        """Return the observation of `OutageDash`, scaled."""
        return scaled_parts(super().observe(view))


class WithUncertainty(Scaled):
    """`Scaled` whose observation also contains the uncertainty relative to the next two gaps.

    It is log4(2 sigma / clearance), where sigma is the largest standard deviation of the position
    along an axis, and the clearance is half the width of the gap minus 0.5 m. Above 0, two standard
    deviations exceed the clearance.
    """

    observes: Mapping[str, ObservationSpec] = {
        **Scaled.observes,
        "uncertainty": ObservationSpec("log4", "-", -4.0, 4.0),
    }

    def observe(self, view: "View") -> Parts:
        """Return the observation of `Scaled`, and `uncertainty` (n, 2)."""
        parts = super().observe(view)
        scaled = np.stack([parts["gap_width_scaled"], parts["next_width_scaled"]], axis=1)
        middle, half = _SCALES["gap_width"]
        ratio = SIGMAS * _sigma(view)[:, np.newaxis] / (0.5 * (half * scaled + middle) - MARGIN)
        return {**parts, "uncertainty": np.asarray(0.5 * np.log2(np.maximum(ratio, 2.0**-8)))}
