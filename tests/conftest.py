"""Settings of all tests: reproducible examples, no deadline, and the number of threads."""

import gc
import importlib.util
import os
import re

import pytest

os.environ.setdefault("QUAD_GYM_KERNELS", "numba")  # even where a library is built

from hypothesis import HealthCheck, settings

from quad_gym.kernels.compiling.workers import prepare
from quad_gym.kernels.entries import FILTER_ENTRIES, SENSORS_AND_VEHICLE, names_of
from quad_gym.kernels.library import available_cores
from quad_gym.kernels.stages import SOURCES

if "PYTEST_XDIST_WORKER_COUNT" in os.environ:  # for this process and its children
    share = str(max(1, available_cores() // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])))
    for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, share)

settings.register_profile(
    "quad_gym",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("quad_gym")


QUICK = {"wahba", "rotation", "linalg", "integration", "gnss", "imu", "ekf", "camera", "dryden"}
"""Files of tests that an author of kernels runs first, see the marker `quick`."""


def pytest_collection_modifyitems(items):
    """Mark the tests of the files in `QUICK`."""
    for item in items:
        if item.path.stem.removeprefix("test_") in QUICK and not item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.quick)


def pytest_sessionstart(session):
    """Compile shared kernels before tests run in several processes, which then load them."""
    if getattr(session.config.option, "numprocesses", None):
        prepare(
            [*names_of([source.name for source in SOURCES]), *FILTER_ENTRIES, *SENSORS_AND_VEHICLE]
        )


def pytest_collection_finish(session):
    """Exempt what exists now from the search for cycles, which otherwise takes 1/20 of the time."""
    gc.freeze()
    gc.set_threshold(20_000)


def skip_without_extra():
    """Skip a test that needs an extra which is not installed; the reason names it."""
    try:
        return (yield)
    except ImportError as error:
        named = re.search(r'needs ([\w-]+): pip install "quad-gym\[', str(error))
        if named and not importlib.util.find_spec(named[1].lower().replace("-", "_")):
            pytest.skip(str(error))
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup():
    """Skip a test whose fixtures need an extra."""
    return (yield from skip_without_extra())


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call():
    """Skip a test that needs an extra."""
    return (yield from skip_without_extra())
