"""Bitwise comparisons of flights and of the return values of environments."""

import numpy as np

IDS = (
    "QuadGym/Hover-v0",
    "QuadGym/Circle-v0",
    "QuadGym/Lemniscate-v0",
    "QuadGym/RandomTrajectory-v0",
    "QuadGym/Waypoints-v0",
    "QuadGym/Trajectory-v0",
    "QuadGym/LookAround-v0",
    "QuadGym/StaleRace-v0",
)
OBSERVATIONS = ("estimate", "truth", "noisy", "measurements")
ACTIONS = ("ctbr", "motor", "wrench", "attitude", "velocity")
LAYOUTS = ("relative", "absolute")


def assert_same(left, right, where="root"):
    """Check that types, keys, dtypes and all values are bitwise equal."""
    assert type(left) is type(right), f"{where}: {type(left)} is not {type(right)}"
    if isinstance(left, dict):
        assert left.keys() == right.keys(), f"{where}: {set(left) ^ set(right)}"
        for key in left:
            assert_same(left[key], right[key], f"{where}.{key}")
    elif isinstance(left, (list, tuple)):
        assert len(left) == len(right), where
        for k, (a, b) in enumerate(zip(left, right, strict=True)):
            assert_same(a, b, f"{where}[{k}]")
    elif isinstance(left, np.ndarray):
        assert left.dtype == right.dtype, f"{where}: {left.dtype} is not {right.dtype}"
        assert left.shape == right.shape, f"{where}: {left.shape} is not {right.shape}"
        if left.dtype == object:
            assert_same(list(left.ravel()), list(right.ravel()), where)
        elif left.tobytes() != right.tobytes():  # 0.0 equals -0.0
            np.testing.assert_array_equal(left, right, err_msg=where, strict=True)
    else:
        assert left == right, f"{where}: {left!r} is not {right!r}"


def masked_infos(infos):
    """Return infos without the values that the masks next to them exclude."""
    kept = {}
    for name, values in infos.items():
        mask = infos.get(f"_{name}")
        if isinstance(values, dict):
            kept[name] = masked_infos(values)
        elif mask is None:
            kept[name] = values
        elif values.dtype == object:
            kept[name] = [value for value, said in zip(values, mask, strict=True) if said]
        else:
            kept[name] = values[mask].astype(float)
    return kept


def assert_same_results(mine, other, where):
    """Check that results are equal, and infos where their masks are true."""
    assert_same(mine[:-1], other[:-1], where)
    assert_same(masked_infos(mine[-1]), masked_infos(other[-1]), where)


def state_of(env):
    """Return the state of all flights as bytes, for each of the three interfaces."""
    return getattr(env, "unwrapped", env).flights.batch.snapshot().tobytes()
