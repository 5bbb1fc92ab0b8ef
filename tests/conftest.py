"""Settings of all tests: reproducible examples and no time limit, as the first one compiles."""

from hypothesis import HealthCheck, settings

from quad_gym.kernels.compiling.linked import names_of
from quad_gym.kernels.compiling.stages import SOURCES
from quad_gym.kernels.compiling.workers import prepare

settings.register_profile(
    "quad_gym",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("quad_gym")


def pytest_sessionstart(session):
    """Compile all stages first where tests run in several processes, which then only load them."""
    if getattr(session.config.option, "numprocesses", None):
        prepare(names_of(frozenset(SOURCES)))
