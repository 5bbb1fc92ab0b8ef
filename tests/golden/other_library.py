"""Parameters of the golden flights, on a processor whose mathematical functions round differently.

`python -m tests.golden.other_library` moves the results of the functions of C, NumPy and SciPy to
the next number, before anything is imported that calls them, and prints the parameters' digests.
"""

import json
import math

import numpy as np
import scipy.special

C_FUNCTIONS = (
    "exp",
    "exp2",
    "expm1",
    "log",
    "log2",
    "log10",
    "log1p",
    "cbrt",
    "pow",
    "hypot",
    "dist",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "atan2",
    "sinh",
    "cosh",
    "tanh",
    "erf",
    "erfc",
    "gamma",
    "lgamma",
)
NUMPY_FUNCTIONS = (
    "exp",
    "expm1",
    "log",
    "log1p",
    "sin",
    "cos",
    "tan",
    "arctan2",
    "hypot",
    "power",
    "arcsin",
    "arccos",
    "arctan",
    "dot",
    "matmul",
    "einsum",
)
LINEAR_ALGEBRA = ("norm", "inv", "solve", "cholesky", "det", "eigvalsh", "pinv")


def _moved(function):
    def other(*values, **keywords):
        found = function(*values, **keywords)
        if getattr(found, "dtype", np.dtype(float)) != np.float64:
            return found
        exact = (np.abs(found) == 1.0) | (found == 0.0) | ~np.isfinite(found)
        near = np.where(exact, found, np.nextafter(found, np.inf))
        return float(near) if isinstance(found, float) else near

    return other


def move_results():
    """Change the last bits of all functions that have no single right result."""
    for module, names in (
        (math, C_FUNCTIONS),
        (np, NUMPY_FUNCTIONS),
        (np.linalg, LINEAR_ALGEBRA),
        (scipy.special, [n for n, f in vars(scipy.special).items() if isinstance(f, np.ufunc)]),
    ):
        for name in names:
            setattr(module, name, _moved(getattr(module, name)))


def digests():
    """Return the digests of settings, parameters and paths of the golden flights, by case."""
    from tests.golden.flights import cases, made

    found = {}
    for name, case in cases().items():
        env = made(case)
        found[name] = int(env.unwrapped.flights.batch.record("configuration")[0])
        env.close()
    return found


if __name__ == "__main__":
    move_results()
    print(json.dumps(digests()))
