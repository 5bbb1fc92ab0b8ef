"""Kinds of cases, one row each: `python -m tests.soak --kinds NAME` runs one kind."""

from tests.soak import configurations, damaged_logs, exports, faults, snapshots
from tests.soak.cases import Kind

KINDS = {
    "configurations": Kind(run=configurations.run, about=configurations.ABOUT),
    "snapshots": Kind(run=snapshots.run, about=snapshots.ABOUT),
    "faults": Kind(run=faults.run, about=faults.ABOUT),
    "damaged_logs": Kind(run=damaged_logs.run, about=damaged_logs.ABOUT),
    "exports": Kind(run=exports.run, about=exports.ABOUT, missing=exports.missing),
}
