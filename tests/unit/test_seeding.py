"""Keys of random streams equal those of NumPy's generators."""

import numpy as np
import pytest

from quad_gym.batch.starts import keys_of, stream_key, stream_keys

EDGES = [0, 1, *(2**k + d for k in (31, 32, 63, 64, 96, 127, 128, 200) for d in (-1, 0, 5))]


def numpys(seeds):
    """Return keys drawn by NumPy, seed by seed."""
    return np.array([stream_key(np.random.Generator(np.random.PCG64(seed))) for seed in seeds])


def test_keys_of_many_seeds_equal_numpys():
    seeds = np.random.default_rng(0).integers(0, 2**64, 20_000, dtype=np.uint64)
    assert np.array_equal(keys_of(seeds)[-300:], numpys(map(int, seeds[-300:])))


@pytest.mark.parametrize("seeds", [EDGES, EDGES[:6], [np.int64(7)]])
def test_keys_of_listed_seeds_equal_numpys(seeds):
    assert np.array_equal(stream_keys(seeds), numpys(map(int, seeds)))


def test_flights_without_a_seed_have_fresh_keys():
    keys = stream_keys([None, 3, None])
    assert np.array_equal(keys[1:2], numpys([3]))
    assert len(np.unique(np.concatenate([keys, stream_keys([None])]), axis=0)) == 4
