"""Findings: sentences about the use of an estimate, by quantity and severity."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

QUANTITIES = ("position", "height", "attitude", "heading")

ADVICE = (
    "Check the units, axes and time stamps of the log, or use a suite with the noise, delays and "
    "mounting of these sensors: `quad-gym calibrate LOG` finds noise, delays and lever arms."
)


class Severity(IntEnum):
    """Weight of a finding."""

    NOTE = 0  #: information
    UNCERTAIN = 1  #: errors of the quantity are larger than its standard deviation
    LOST = 2  #: the quantity cannot be used, or the suite does not describe the log


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A sentence of the verdict."""

    quantity: str  #: "position", "height", "attitude", "heading"; or "log", for its units and axes
    severity: Severity
    text: str

    def __str__(self) -> str:
        return self.text if self.quantity == "log" else f"{self.quantity}: {self.text}"


def by_quantity(findings: Sequence[Finding]) -> list[str]:
    """Return a line on each quantity: its findings, or "usable"."""
    lines = [f"log: {f.text}" for f in findings if f.quantity == "log"]
    for quantity in QUANTITIES:
        some = [f for f in findings if f.quantity == quantity]
        worst = max((f.severity for f in some), default=Severity.NOTE)
        words = ("usable", "uncertain", "not usable")[worst]
        lines.append("; ".join([f"{quantity}: {words}", *(f.text for f in some)]))
    return lines
