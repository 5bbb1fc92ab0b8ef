"""Inputs of a filter, checked: IMU samples, and measurements of one instant."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks as check
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import AID_BLOCK, FEATURE_BLOCKS, POSITION_BLOCK, Aid

Floats = NDArray[np.float64]

HEADING_ALONE = 4.0
"""Value of the noise `baseline_sigma`, above the largest one of pi, with which a filter uses only
the heading of a baseline; its noise is then the suite's [rad]."""

SIGMA_KEYWORDS = (
    "gnss_sigma",
    "baseline_sigma",
    "velocity_sigma",
    "pixel_sigma",
    *(f"{aid.name.lower()}_sigma" for aid in Aid),
)
"""Keywords of `update` for the noise of its measurements."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measurements of one instant; None: not measured."""

    position_G: Floats | None = None  #: (3,) antenna position [m]
    baseline_G: Floats | None = None  #: (3,) baseline, scaled to a length near one [-]
    velocity_G: Floats | None = None  #: (3,) antenna velocity [m/s]
    pixels: Floats | None = None  #: (n_features, 2) image coordinates, NaN: not seen [pixels]
    aids: dict[Aid, Floats] = field(default_factory=dict)
    """(blocks, length) measurements of aiding sensors, NaN: a block was not measured"""
    noise: dict[str, Any] = field(default_factory=dict)
    """fields of the parameter record that replace the suite's for this measurement"""

    @property
    def empty(self) -> bool:
        """True if nothing was measured."""
        values = (self.position_G, self.baseline_G, self.velocity_G, self.pixels)
        return all(v is None for v in values) and not self.aids

    @property
    def blocks(self) -> list[int]:
        """Blocks of innovations of the measurement."""
        triples = enumerate((self.position_G, self.baseline_G, self.velocity_G))
        found = [POSITION_BLOCK + k for k, values in triples if values is not None]
        if self.pixels is not None:
            seen = ~np.isnan(self.pixels).any(axis=1)
            found += [FEATURE_BLOCKS + int(i) for i in np.flatnonzero(seen)]
        for aid, values in self.aids.items():
            found += [AID_BLOCK[aid] + int(i) for i in np.flatnonzero(~np.isnan(values[:, 0]))]
        return found


def checked_measurement(
    sensors: SensorSuite,
    position_G: ArrayLike | None,
    baseline_G: ArrayLike | None,
    pixels: ArrayLike | None,
    velocity_G: ArrayLike | None,
    others: dict[str, Any],
) -> Measurement:
    """Check the arguments of `update`.

    Args:
        sensors: The filter's suite.
        position_G: As in `update`.
        baseline_G: As in `update`.
        pixels: As in `update`.
        velocity_G: As in `update`.
        others: Measurements of aiding sensors by name, and noise by SIGMA_KEYWORDS.
    """
    aids = _checked_aids(sensors, others) if others else {}
    if position_G is not None or baseline_G is not None:
        require_gnss(sensors, "update")
    position = baseline = velocity = image = None
    if position_G is not None:
        position = check.array("gnss_position_G", position_G, (3,))
    if baseline_G is not None:
        baseline = checked_baseline(sensors, baseline_G)
    if pixels is not None:
        count = 0 if sensors.camera is None else len(sensors.camera.features_I)
        image = check.array("pixels", pixels, (count, 2), allow_nan=True)
    if velocity_G is not None:
        if sensors.gnss is None or sensors.gnss.velocity_sigma is None:
            raise ValueError("the sensor suite has no GNSS velocity to update with")
        velocity = check.array("gnss_velocity_G", velocity_G, (3,))
    if not others:
        return Measurement(position, baseline, velocity, image)
    measured = {
        "gnss_sigma": position is not None,
        "baseline_sigma": baseline is not None,
        "velocity_sigma": velocity is not None,
        "pixel_sigma": image is not None,
        **{f"{aid.name.lower()}_sigma": aid in aids for aid in Aid},
    }
    return Measurement(position, baseline, velocity, image, aids, _checked_noise(others, measured))


def require_gnss(sensors: SensorSuite, what: str) -> None:
    """Refuse an operation that requires GNSS."""
    if sensors.gnss is None:
        raise ValueError(f"the sensor suite has no GNSS to {what}")


def checked_baseline(sensors: SensorSuite, gnss_baseline_G: ArrayLike) -> Floats:
    """Return a baseline, scaled by a power of two: its length is not used."""
    if sensors.gnss is not None and not sensors.gnss.has_baseline:
        raise ValueError("gnss_baseline_G must be None for GNSS with one antenna")
    baseline = check.array("gnss_baseline_G", gnss_baseline_G, (3,))
    largest = np.abs(baseline).max()
    if largest == 0.0:
        raise ValueError("gnss_baseline_G must have a direction, got zeros")
    # a power of two brings it near one without rounding
    return np.ldexp(baseline, -int(np.frexp(largest)[1]))


def _checked_aids(sensors: SensorSuite, others: dict[str, Any]) -> dict[Aid, Floats]:
    """Return the measurements of aiding sensors as arrays; None: not measured."""
    names = tuple(aid.name.lower() for aid in Aid)
    check.keywords(others, names + SIGMA_KEYWORDS, "update")
    found = {}
    for name in names:
        aid, value = Aid[name.upper()], others.get(name)
        if value is None:
            continue
        if aid not in sensors.aids:
            raise ValueError(f"the sensor suite has no {name} to update with")
        params = sensors.aids[aid]
        alone, several = params.shape == (), params.most_blocks > 1
        numbers = [check.number(name, value)] if alone else value
        values = check.array(name, numbers, params.shape or (1,), allow_nan=several)
        found[aid] = values.reshape(params.blocks, params.length)
    return found


def gnss_noise(name: str, value: Any) -> Floats:
    """Return standard deviations (3,) in I [m] of a number or three."""
    if np.ndim(value) == 0:
        return np.full(3, check.positive(name, value, least=1e-9))
    sigmas = check.array(name, value, (3,))
    if not (sigmas >= 1e-9).all():
        raise ValueError(f"{name} must be at least 1e-9, got {value!r}")
    return sigmas


def _checked_noise(others: dict[str, Any], measured: dict[str, bool]) -> dict[str, Any]:
    """Return noise by fields of the parameter record."""
    noise: dict[str, Any] = {}
    for name in SIGMA_KEYWORDS:
        value = others.get(name)
        if value is None:
            continue
        if not measured[name]:
            raise ValueError(f"{name} must come with its measurement")
        if name == "gnss_sigma":
            noise["position_sigma_I"] = gnss_noise(name, value)
            continue
        sigma = check.positive(name, value, least=1e-12)
        if name == "baseline_sigma":
            noise["baseline_noise"] = noise["baseline_sigma"] = min(sigma, math.pi)
        elif name.removesuffix("_sigma").upper() in Aid.__members__:
            noise.setdefault("aid_sigma", {})[Aid[name.removesuffix("_sigma").upper()]] = sigma
        else:
            noise[name] = sigma
    return noise
