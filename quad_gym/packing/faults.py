"""Faults as numbers in the settings record that kernels read."""

import math
from collections.abc import Iterable
from typing import Any

from quad_gym.faults import Fault, Span, ends
from quad_gym.records import NEVER


def pack_faults(s: Any, faults: Iterable[Fault], dt: float) -> None:
    """Write faults, at most one of each kind, into a settings record; `dt` is the tick [s]."""
    for fault in faults:
        k = fault.kind
        s["faults"], s["fault_on"][k] = True, True
        s["fault_rate"][k] = fault.rate * dt
        s["fault_start"][k] = _ticks(fault.start, dt)
        s["fault_duration"][k] = _ticks(fault.duration, dt, least=1.0)
        s["fault_probability"][k] = fault.probability
        for name, value in fault.numbers.items():
            if name == "size":
                low, high = ends(value)
                s["fault_size"][k] = low, high - low
            elif name in ("share", "direction"):
                s[f"fault_{name}"][k] = value
            else:
                s[name] = value


def _ticks(value: Span, dt: float, least: float = 0.0) -> tuple[float, float]:
    """Return the lower end and the length of a span of time [s] in ticks; a number is rounded."""
    low, high = ends(value)
    if math.isinf(high):
        return NEVER, 0.0
    if low == high:
        return max(float(round(low / dt)), least), 0.0
    return low / dt, (high - low) / dt
