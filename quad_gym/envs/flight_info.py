"""Faults and innovations in `info`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.faults.presets import named_faults
from quad_gym.packing.aids import blocks_of

Parts = dict[str, dict[str, NDArray[Any]]]


def flight_info(batch: FlightBatch, bits: NDArray[np.float64]) -> Parts:
    """Return the entries "faults" and "innovations" of `info` for all flights, if they have any.

    Args:
        batch: The flights.
        bits: (n,) active faults, as in a flight's field "faults".
    """
    found: Parts = {}
    if batch.faults:
        found["faults"] = named_faults(batch.faults, bits)
    if batch.innovations:
        found["innovations"] = innovations_of(batch)
    return found


def innovations_of(batch: FlightBatch) -> dict[str, NDArray[Any]]:
    """Return the last innovations of all flights, block by block.

    The blocks are position, baseline, velocity and features, followed by barometer and magnetometer
    if the suite has them.

    Returns:
        Arrays (n, blocks, ...): "measured" (True if measured since the last step); "innovation" and
        "sigma" (its standard deviation predicted by the filter), three numbers each, of which a
        direction uses two; "nis"; "gate", see `quad_gym.records.GateDecision`; "rejections" in this
        episode. NaN: not measured yet.
    """
    blocks = list(blocks_of(batch.sensors))
    position, baseline = batch.record("position_fresh"), batch.record("baseline_fresh")
    has_velocity = batch.sensors.gnss is not None and batch.sensors.gnss.velocity_sigma is not None
    others = batch.record("feature_fresh"), batch.record("aid_fresh")
    measured = np.column_stack([position, baseline, position * has_velocity, *others])
    return {
        "measured": measured[:, blocks] > 0.0,
        "innovation": batch.record("innovation")[:, blocks],
        "sigma": batch.record("innovation_sigma")[:, blocks],
        "nis": batch.record("block_nis")[:, blocks],
        "gate": batch.record("gate")[:, blocks].astype(np.int64),
        "rejections": batch.record("rejections")[:, blocks].astype(np.int64),
    }


def info_of_flight(parts: Parts, flight: int) -> dict[str, dict[str, Any]]:
    """Return the entries of one flight, with booleans in place of arrays of one."""
    return {
        name: {
            key: values[flight] if values.ndim > 1 else bool(values[flight])
            for key, values in part.items()
        }
        for name, part in parts.items()
    }


def replace_faults(infos: dict[str, Any], batch: FlightBatch, flights: NDArray[np.intp]) -> None:
    """Describe the present instant of some flights instead, if `info` has faults."""
    if batch.faults:
        now = named_faults(batch.faults, batch.record("faults", flights))
        for name, values in now.items():
            infos["faults"][name][flights] = values


def final_faults(infos: dict[str, Any], over: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the faults at the end of the episodes that are over, as `final_info` holds them."""
    if "faults" not in infos:
        return {}
    faults = infos["faults"].items()
    return {"faults": {name: values & over for name, values in faults if name[0] != "_"}}
