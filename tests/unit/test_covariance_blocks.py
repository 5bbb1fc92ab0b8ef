"""Parts of a filter's covariance equal those of the whole."""

import numpy as np

from quad_gym.records import covariance_block_of, covariance_of, variances_of


def test_blocks_and_variances_equal_those_of_the_whole_covariance():
    rng = np.random.default_rng(5)
    P, arc = rng.normal(size=(40, 15, 15)), rng.normal(size=(40, 6))
    whole = covariance_of(P, arc)
    np.testing.assert_array_equal(variances_of(P, arc), np.einsum("nii->ni", whole))
    for first in range(0, 15, 3):
        block = whole[:, first : first + 3, first : first + 3]
        np.testing.assert_array_equal(covariance_block_of(P, arc, first), block)
