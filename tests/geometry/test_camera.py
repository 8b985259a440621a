"""The pinhole camera."""

import numpy as np
import pytest

from pnet.geometry.camera import Camera

CAMERA = Camera(64, 48, fx=50.0, fy=60.0, cx=30.5, cy=22.0, near=0.2, far=3.0)


def test_a_point_on_the_axis_falls_on_the_principal_point():
    assert CAMERA.project(np.array([0.0, 0.0, 2.0])).tolist() == [30.5, 22.0]


def test_x_goes_right_and_y_goes_down():
    assert CAMERA.project(np.array([0.2, 0.1, 1.0])) == pytest.approx([40.5, 28.0])


def test_projecting_and_back_projecting_is_a_round_trip():
    points = np.random.default_rng(0).uniform([-1, -1, 0.5], [1, 1, 2], (100, 3))
    u, v = CAMERA.project(points).T
    np.testing.assert_allclose(CAMERA.rays(u, v) * points[:, 2:], points, atol=1e-12)


def test_a_depth_image_back_projects_to_its_own_pixels():
    depth = np.random.default_rng(1).uniform(0.5, 2, (48, 64))
    points = CAMERA.depth_to_points(depth)
    assert points.shape == (48, 64, 3)
    np.testing.assert_array_equal(points[..., 2], depth)
    v, u = np.mgrid[:48, :64]
    np.testing.assert_allclose(CAMERA.project(points), np.stack([u, v], -1), atol=1e-10)


def test_ray_lengths_are_those_of_the_rays():
    v, u = np.mgrid[:48, :64]
    np.testing.assert_allclose(CAMERA.ray_lengths(), np.linalg.norm(CAMERA.rays(u, v), axis=-1), rtol=1e-14)


def test_missing_depth_stays_missing():
    depth = np.full((48, 64), np.nan)
    assert np.isnan(CAMERA.depth_to_points(depth)).all()
    assert (CAMERA.depth_to_points(0 * np.ones((48, 64))) == 0).all()


def test_a_depth_image_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"\(64, 48\).*expects \(48, 64\)"):
        CAMERA.depth_to_points(np.ones((64, 48)))


def test_a_camera_comes_back_from_its_plain_numbers():
    assert Camera(**CAMERA.to_dict()) == CAMERA


@pytest.mark.parametrize("wrong", [{"width": 0}, {"fx": 0.0}, {"fy": -1.0}, {"near": 0.0}, {"near": 3.0}])
def test_an_impossible_camera_is_refused(wrong):
    with pytest.raises(ValueError, match="camera"):
        Camera(**CAMERA.to_dict() | wrong)


def test_negative_depth_is_refused():
    camera = Camera(width=2, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
    with pytest.raises(ValueError, match=r"negative values \(lowest -0.5 m\)"):
        camera.depth_to_points(np.array([[0.4, -0.5]]))


@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy", "near", "far"])
def test_a_camera_of_nan_is_refused(name):
    with pytest.raises(ValueError, match="camera"):
        Camera(**{**vars(CAMERA), name: float("nan")})
