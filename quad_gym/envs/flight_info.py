"""Faults and innovations in `info`."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.quantities import innovations_of
from quad_gym.faults.presets import named_faults

Parts = dict[str, dict[str, NDArray[Any]]]


def start_info(batch: FlightBatch) -> dict[str, Any]:
    """Return `info` of all flights at the start of episodes: arrays, and dictionaries of arrays."""
    return {
        "position_error": batch.record("position_error"),
        "estimation_error": batch.record("estimation_error"),
        "ending": np.zeros(batch.count, np.int64),
        "filter_status": batch.record("filter_status").astype(np.int64),
        "filter_diverged": batch.record("diverged") > 0.0,
        "gates_passed": np.zeros(batch.count, np.int64),
        **drawn_info(batch.drawn()),
        **flight_info(batch, batch.record("faults")),
    }


def drawn_info(drawn: dict[str, NDArray[np.float64]]) -> Parts:
    """Return the entry "drawn" of `info` for all flights; empty without draws."""
    return {"drawn": drawn} if drawn else {}


def flight_info(batch: FlightBatch, bits: NDArray[np.float64]) -> Parts:
    """Return the entries "faults", from their bits (n,), and "innovations" of `info`, if any."""
    found: Parts = {}
    if batch.faults:
        found["faults"] = named_faults(batch.faults, bits)
    if batch.innovations:
        found["innovations"] = innovations_of(batch)
    return found


def info_of_flight(infos: Mapping[str, Any], flight: int) -> dict[str, Any]:
    """Return the entries of one flight, with Python's booleans and numbers for arrays of one."""
    found: dict[str, Any] = {}
    for name, values in infos.items():
        if isinstance(values, dict):
            found[name] = info_of_flight(values, flight)
        elif values.ndim > 1 or values.dtype == object:
            found[name] = values[flight]
        else:
            found[name] = values[flight].item()
    return found


def replace_faults(infos: dict[str, Any], batch: FlightBatch, flights: NDArray[np.intp]) -> None:
    """Describe the present instant of some flights instead, if `info` has faults."""
    if batch.faults:
        now = named_faults(batch.faults, batch.record("faults", flights))
        for name, values in now.items():
            infos["faults"][name][flights] = values


def final_parts(infos: dict[str, Any], batch: FlightBatch, over: NDArray[np.bool_]) -> Parts:
    """Return the faults and innovations of episodes that are over, (n,)."""
    found: Parts = {}
    if "faults" in infos:
        faults = infos["faults"].items()
        found["faults"] = {name: values & over for name, values in faults}
    if batch.innovations:
        found["innovations"] = batch.final_innovations
    return found
