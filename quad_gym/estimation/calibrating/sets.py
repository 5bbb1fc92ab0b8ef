"""Many filters on one log: a set of parameters for each lane, a block of lanes for each thread."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from quad_gym.estimation.filtering.engine import Floats
from quad_gym.estimation.filtering.tape import Tape
from quad_gym.estimation.replaying.player import Player
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import WIDTH, aligned_zeros


def innovations_of_sets(player: Player, tape: Tape, suites: Sequence[SensorSuite]) -> Floats:
    """Run a tape with filters of suites that differ in numbers only.

    Returns:
        (m, blocks, REPORTED, sets) innovations of each update.
    """
    engines = [player.started(suite)._engine for suite in suites]
    first, tape = engines[0], tape.without_estimates()

    def run(k: int) -> Floats:
        chosen = [engines[min(i, len(engines) - 1)] for i in range(k, k + WIDTH)]
        parts = (
            _side_by_side([getattr(engine, name) for engine in chosen])
            for name in ("blocks", "params", "_ticks", "steps")
        )
        return first.run_block(tape, first.empty_slots(tape), *parts)[1]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = list(pool.map(run, range(0, len(engines), WIDTH)))
    return np.concatenate(found, axis=-1)[..., : len(engines)]


def _side_by_side(blocks: Sequence[Any]) -> Any:
    """Return one block with a lane of each of WIDTH blocks."""
    found = aligned_zeros(1, blocks[0].dtype)
    raw = found.view(np.uint64).reshape(-1, WIDTH)
    for lane, block in enumerate(blocks):
        raw[:, lane] = block.view(np.uint64).reshape(-1, WIDTH)[:, 0]
    return found
