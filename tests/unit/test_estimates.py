"""Checks of the arrays that a user's estimator returns."""

import threading

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quad_gym.batch.own_estimator import checked_estimate, factors
from tests.builders import vec_env
from tests.estimators import Given

COUNT = 4
ALL, FIRST = np.ones(COUNT, bool), np.arange(COUNT) == 0
TURNED = Rotation.random(COUNT, rng=1).as_matrix()
POSITIVE = np.random.default_rng(2).normal(size=(COUNT, 15, 15))
POSITIVE = POSITIVE @ POSITIVE.transpose(0, 2, 1) + np.eye(15)


def checked(rows=ALL, **changes):
    rest = {"position": np.zeros((COUNT, 3)), "velocity": np.zeros((COUNT, 3)), "R_BI": TURNED}
    return checked_estimate("Mine.update", rest | changes, COUNT, rows)


@pytest.mark.parametrize(
    "wrong",
    [
        -TURNED,  # turned reflections
        TURNED @ np.diag([1.0, 1.0, -1.0]),
        np.ones((COUNT, 3, 3)) / np.sqrt(3.0),  # of rank 1, with the same sum of squares
        TURNED @ np.diag([1.1, 1.0, np.sqrt(3.0 - 2.21)]),
    ],
    ids=["reflection", "mirrored axis", "rank 1", "stretched"],
)
def test_matrices_that_are_no_rotations_are_refused(wrong):
    with pytest.raises(ValueError, match=r'rotations for "R_BI".* for flight 0 and 3 more'):
        checked(R_BI=wrong)
    mixed = np.where(FIRST[:, np.newaxis, np.newaxis], TURNED, wrong)
    checked(FIRST, R_BI=mixed)  # the others do not begin an episode
    with pytest.raises(ValueError, match="for flight 1 and 2 more"):
        checked(R_BI=mixed)


def test_rotations_with_errors_of_float32_are_accepted():
    found = checked(R_BI=TURNED.astype(np.float32))["R_BI"]
    np.testing.assert_allclose(found, TURNED, atol=1e-7)
    assert found.dtype == np.float64


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((COUNT, 3), complex), "real numbers"),
        (np.full((COUNT, 3), "1.0"), "real numbers"),
        (np.full((COUNT, 3), 1j, object), "real numbers"),
        (np.zeros((COUNT, 3), "M8[s]"), "real numbers"),
        (np.ma.masked_less(np.zeros((COUNT, 3)), 1.0), "arrays without a mask"),
    ],
    ids=["complex", "text", "complex objects", "times", "masked"],
)
def test_arrays_that_are_no_plain_real_numbers_are_refused(value, message):
    with pytest.raises(ValueError, match=rf'^Mine\.update must return {message} for "position"'):
        checked(position=value)


def test_asymmetric_covariances_are_refused_and_rounding_is_not():
    rounded = POSITIVE.astype(np.float32).astype(float)
    rounded[:, 3, 0] *= 1.0 + 1e-6
    np.testing.assert_allclose(
        factors("Mine.update", rounded, ALL), np.linalg.cholesky(POSITIVE), atol=1e-3
    )
    uneven = POSITIVE.copy()
    uneven[2, 3, 0] += 0.1
    with pytest.raises(ValueError, match='symmetric "covariance", got another for flight 2'):
        factors("Mine.update", uneven, ALL)
    factors("Mine.update", uneven, FIRST)


def test_environments_share_no_list_of_an_estimator():
    class Counts(Given):
        def __init__(self):
            super().__init__()
            self.calls = []

        def update(self, measurements):
            self.calls.append(measurements.count)
            return super().update(measurements)

    estimator = Counts()
    for count in (2, 3):
        vec_env(estimator=estimator, count=count, seed=0).step(np.zeros((count, 4)))
    assert estimator.calls == []


def test_estimator_that_cannot_be_copied_is_refused():
    estimator = Given()
    estimator.lock = threading.Lock()
    with pytest.raises(ValueError, match=r"copy\.deepcopy can copy, got Given: .*lock"):
        vec_env(estimator=estimator, count=2)
