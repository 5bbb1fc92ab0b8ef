"""The catalog of compiled functions is complete and needs no Numba."""

import inspect

import numpy as np
import pytest

from quad_gym.kernels import batch, entries, single, tape
from quad_gym.kernels.compiling.decorators import EntryDispatcher
from quad_gym.kernels.compiling.workers import dispatcher_of
from quad_gym.records import FLIGHT, PARAMS
from tests.builders import run_python

CATALOG = "from quad_gym.kernels import entries, stages; import sys"


def test_catalog_and_stages_are_imported_without_numba():
    code = f"{CATALOG}; sys.exit('numba' in sys.modules or 'llvmlite' in sys.modules)"
    assert run_python("-c", code).returncode == 0


def test_catalog_has_the_entries_of_kernels_with_their_arguments():
    modules = (batch, single, tape)
    found = {
        f"{module.__name__}:{name}"
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, EntryDispatcher)
    }
    assert found == entries.ENTRIES.keys()
    for name, entry in entries.ENTRIES.items():
        assert len(inspect.signature(dispatcher_of(name).py_func).parameters) == len(
            entry.arguments
        )


@pytest.mark.parametrize(
    ("flights", "words"),
    [
        (np.zeros((1, 1), FLIGHT), "of 1 axes in C order, got 2 axes"),
        (np.zeros(4, FLIGHT)[::2], "got 1 axes with strides"),
        (np.zeros(1, PARAMS), "of {'names'"),
    ],
)
def test_array_of_wrong_layout_or_type_raises_type_error(flights, words):
    with pytest.raises(TypeError, match=f"integrate_flight takes an array .*{words}"):
        entries.integrate_flight(flights, np.zeros(1, PARAMS), 1)
