"""Kernels called from tests: one source, compiled for plain records and for lanes."""

import numpy as np

from quad_gym.kernels.compiling import entry, kernel
from quad_gym.kernels.numbers.blocks import lanes_of
from quad_gym.records import WIDTH, aligned_zeros


class Compiled:
    """A kernel `body(record, option)` for flights; fields are given by name, (n_flights, ...).

    Args:
        body: Function to compile; it reads some fields of the record and writes others.
        fields: Shape of each field of one flight; a name that begins with `word_` holds uint64.
    """

    def __init__(self, body, **fields):
        body, name = kernel(body), body.__qualname__

        def on_records(records, option):
            for i in range(len(records)):
                body(records[i], option)

        def on_blocks(blocks, option):
            for i in range(len(blocks)):
                body(lanes_of(blocks[i]), option)

        for function in (on_records, on_blocks):  # a unique name in the cache
            function.__qualname__ = f"{function.__name__}_of_{name}"
        self._on_records, self._on_blocks = entry(on_records), entry(on_blocks)
        kinds = [(n, "u8" if n.startswith("word_") else "f8", shape) for n, shape in fields.items()]
        self._record = np.dtype(kinds, align=True)
        self._block = np.dtype([(n, k, (*shape, WIDTH)) for n, k, shape in kinds], align=True)

    def on_floats(self, option=0, **inputs):
        """Run the plain instance; return all fields by name, each (n_flights, ...)."""
        records = np.zeros(len(next(iter(inputs.values()))), self._record)
        for name, values in inputs.items():
            records[name] = values
        self._on_records(records, option)
        return {name: records[name] for name in self._record.names}

    def on_lanes(self, option=0, **inputs):
        """Run the instance for lanes, the last block padded with zeros; return all fields."""
        count = len(next(iter(inputs.values())))
        blocks = aligned_zeros(-(-count // WIDTH), self._block)
        for name, values in inputs.items():
            for lane in range(WIDTH):
                rows = np.asarray(values)[lane::WIDTH]
                blocks[name][: len(rows), ..., lane] = rows
        self._on_blocks(blocks, option)
        flights = {name: np.moveaxis(blocks[name], -1, 1) for name in self._block.names}
        return {name: v.reshape(-1, *v.shape[2:])[:count] for name, v in flights.items()}
