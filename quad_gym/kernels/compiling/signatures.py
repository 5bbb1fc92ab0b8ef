"""Signatures of entries in Numba's types, from the catalog of entries."""

from typing import Any

from numba import types
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.entries import Entry, Rows

_SCALARS: dict[Any, Any] = {
    int: types.int64,
    bool: types.boolean,
    float: types.float64,
    None: types.none,
}


def signature_of(entry: Entry) -> Any:
    """Return the signature with which an entry is compiled."""
    arguments = [
        types.Array(from_dtype(wanted.dtype), wanted.axes, "C")
        if isinstance(wanted, Rows)
        else _SCALARS[wanted]
        for wanted in entry.arguments
    ]
    return _SCALARS[entry.returns](*arguments)
