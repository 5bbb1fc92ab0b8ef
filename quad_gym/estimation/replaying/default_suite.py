"""The suite with which a log is replayed by default: by the sensors that it has."""

from quad_gym.estimation.logs import Log
from quad_gym.params.suites import sensor_suite


def suite_for(log: Log) -> tuple[str, str]:
    """Return the name of a built-in suite for the sensors of a log, and the reason.

    With a receiver it is "field", of real flights, or "rtk" with two antennas. Without one it is
    the suite that uses most of the log's sensors, as far as they measure position or velocity.
    """
    values = {} if log.gnss is None else log.gnss.values
    if {"baseline_G", "baseline_I"} & set(values):
        return "rtk", "the log has a receiver with two antennas"
    if log.gnss is not None and log.attitude is not None:
        return "mocap", "the log has positions and attitudes of motion capture"
    if log.gnss is not None:
        used = [n.replace("_", " ") for n in ("barometer", "magnetometer") if n in log.streams]
        return "field", " and ".join(["the log has a receiver", *used])
    for name, needs in (("uwb", ("uwb_range",)), ("crazyflie", ("optical_flow", "range_finder"))):
        if set(needs) <= set(log.streams):
            return name, f"the log has {' and '.join(n.replace('_', ' ') for n in needs)}"
    if log.camera is not None:
        features = log.camera.values["pixels"].shape[1]
        for name in ("indoor", "standard"):
            camera = sensor_suite(name).camera
            if camera is not None and len(camera.features_I) == features:
                return name, f"the log has images of {features} features"
    return "field", "the log has no receiver"
