"""The last innovations of flights, block by block."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.memory import FlightMemory
from quad_gym.packing.aids import blocks_of


def innovations_of(batch: FlightMemory) -> dict[str, NDArray[Any]]:
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
    return {
        "measured": batch.record("block_fresh")[:, blocks] > 0.0,
        "innovation": batch.record("innovation")[:, blocks],
        "sigma": batch.record("innovation_sigma")[:, blocks],
        "nis": batch.record("block_nis")[:, blocks],
        "gate": batch.record("gate")[:, blocks].astype(np.int64),
        "rejections": batch.record("rejections")[:, blocks].astype(np.int64),
    }
