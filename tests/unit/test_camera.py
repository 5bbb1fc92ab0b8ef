"""Pixels and visible features of the camera against a projection in NumPy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.sensors import Camera
from tests.unit.alarms import assert_normal

LAB = quad_gym.CameraParams()
SHARP = LAB.replace(pixel_sigma=1e-9)
HALF_IMAGE = np.array([1920.0, 1080.0])
# R_CB for a roll of 120 and a yaw of 90 degrees, by SciPy
R_CB = Rotation.from_euler("ZXY", [90.0, 120.0, 0.0], degrees=True).as_matrix().T

seeds = st.integers(0, 2**32 - 1)


def random_pose(seed):
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 5.0, 3), Rotation.random(rng=rng).as_matrix()


def point_seen_at(v_C, position, R_BI, params=LAB):
    """Return the point in I whose camera coordinates are v_C."""
    return position + R_BI.T @ (R_CB.T @ v_C + params.position_B)


def picture(params, position, R_BI, seed=1):
    return Camera(params, np.random.default_rng(seed)).measure(position, R_BI)


def test_the_camera_looks_ahead_and_thirty_degrees_down():
    optical_axis_B = R_CB.T @ [0.0, 0.0, 1.0]
    expected = [np.cos(np.radians(30)), 0.0, -np.sin(np.radians(30))]
    np.testing.assert_allclose(optical_axis_B, expected, rtol=0.0, atol=1e-15)
    ahead = SHARP.replace(features_I=[LAB.position_B + 5.0 * optical_axis_B])
    np.testing.assert_allclose(picture(ahead, np.zeros(3), np.eye(3)), 0.0, rtol=0.0, atol=1e-6)


@given(seeds)
def test_random_features_have_the_pixels_of_a_plain_projection(seed):
    position, R_BI = random_pose(seed)
    features = position + np.random.default_rng(seed).normal(0.0, 3.0, (16, 3))
    got = picture(SHARP.replace(features_I=features), position, R_BI)
    v_C = (R_CB @ ((features - position) @ R_BI.T - LAB.position_B).T).T
    pixels = LAB.focal_length * v_C[:, :2] / v_C[:, 2:]
    inside = (v_C[:, 2] > 0.0) & (np.abs(pixels) <= HALF_IMAGE).all(axis=1)
    np.testing.assert_array_equal(np.isnan(got), np.repeat(~inside[:, np.newaxis], 2, axis=1))
    np.testing.assert_allclose(got[inside], pixels[inside], rtol=1e-9, atol=1e-6)


def test_pixel_noise_is_white_and_of_the_given_size():
    # the laboratory's two features, from above the circle
    position, R_BI = np.array([4.0, 0.0, 2.0]), Rotation.from_euler("z", np.pi).as_matrix().T
    camera, count = Camera(LAB, np.random.default_rng(1)), 6_000
    pixels = np.array([camera.measure(position, R_BI) for _ in range(count)]).reshape(-1, 4)
    truth = picture(SHARP, position, R_BI).ravel()
    assert_normal(pixels, truth, 400.0 * np.eye(4))


def test_visibility_does_not_depend_on_noise():
    # a feature just inside the image is always reported, one just outside never
    pose = np.zeros(3), np.eye(3)
    for x, reported in ((0.999, True), (1.001, False)):
        v_C = 3.0 * np.array([x * HALF_IMAGE[0] / LAB.focal_length, 0.0, 1.0])
        camera = Camera(
            LAB.replace(features_I=[point_seen_at(v_C, *pose)]), np.random.default_rng(2)
        )
        pictures = np.array([camera.measure(*pose) for _ in range(300)])
        assert (np.isfinite(pictures) == reported).all()
        if reported:
            assert (pictures[:, 0, 0] > HALF_IMAGE[0]).any()
