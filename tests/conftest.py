"""Settings of all tests: reproducible examples and no time limit, as the first one compiles."""

from hypothesis import HealthCheck, settings

settings.register_profile(
    "quad_gym",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("quad_gym")
