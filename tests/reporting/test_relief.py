"""Normals of measured surfaces, through noise, rounding and holes."""

import numpy as np
import pytest

from pnet.geometry.camera import Camera
from pnet.reporting import relief


def plane(camera, normal, distance):
    """Depth of the plane n·x = distance."""
    rays = camera.rays(*np.meshgrid(np.arange(camera.width), np.arange(camera.height)))
    return distance / (rays @ normal)


def angles(normals, normal):
    return np.degrees(np.arccos(np.clip(-normals @ normal, -1, 1)))


CAMERA = Camera(80, 60, 375.0, 380.0, 39.5, 29.5)


@pytest.mark.parametrize("tilt", [0, 30, 65])
def test_normals_of_a_plane_are_its_own_and_face_the_camera(tilt):
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    normal = np.array([0.6 * s, 0.8 * s, c])
    assert angles(relief.surface_normals(plane(CAMERA, normal, 0.6 * c), CAMERA), normal).max() < 0.1


def test_normals_survive_noise_and_holes():
    rng = np.random.default_rng(0)
    normal = np.array([0.3, -0.4, np.sqrt(0.75)])
    depth = plane(CAMERA, normal, 0.5)
    depth += rng.normal(0, 0.0008, depth.shape)  # half of a pixel's width
    depth[rng.random(depth.shape) < 0.1] = 0
    error = angles(relief.surface_normals(depth, CAMERA), normal)[depth > 0]
    assert np.median(error) < 4 and np.quantile(error, 0.95) < 10


def test_normals_do_not_mix_what_lies_before_with_what_lies_behind():
    before, behind = np.array([0.5, 0, np.sqrt(0.75)]), np.array([-0.3, 0, np.sqrt(0.91)])
    depth = plane(CAMERA, behind, 0.65)
    depth[:, :40] = plane(CAMERA, before, 0.45)[:, :40]
    normals = relief.surface_normals(depth, CAMERA)
    assert angles(normals[:, :40], before).max() < 0.1
    assert angles(normals[:, 40:], behind).max() < 0.1


def test_a_lone_pixel_faces_the_camera():
    depth = np.zeros((60, 80))
    depth[30, 40] = 0.5
    normal = relief.surface_normals(depth, CAMERA)[30, 40]
    assert angles(normal, np.array([0, 0, 1.0])) < 1


@pytest.mark.parametrize("sigma", [0.0002, 0.002])
def test_the_noise_is_told_apart_from_slopes_and_jumps(sigma):
    rng = np.random.default_rng(0)
    normal = np.array([0.6, 0, 0.8])
    depth = plane(CAMERA, normal, 0.45)
    depth[20:40, 20:60] -= 0.1
    noise = relief.depth_noise(1 / (1 / depth + rng.normal(0, sigma, depth.shape)))
    assert noise == pytest.approx(sigma, rel=0.1)


def test_rounding_counts_as_noise():
    depth = plane(CAMERA, np.array([0.1, 0.05, np.sqrt(0.9875)]), 0.55)
    assert relief.depth_noise(depth) < 2e-5
    assert relief.depth_noise(np.round(depth, 3)) * 0.55**2 == pytest.approx(0.0003, rel=0.05)


def test_a_few_flat_levels_are_no_rounding():
    depth = np.repeat([0.5, 0.52, 0.55], 20)[:, None] * np.ones(80)
    assert relief.depth_noise(depth) == 0
    assert angles(relief.surface_normals(depth, CAMERA), np.array([0, 0, 1.0])).max() < 0.1


def test_a_large_image_is_reduced_and_bad_depths_are_missing():
    view = Camera(800, 400, 250.0, 250.0, 399.75, 199.75)
    depth = np.full((800, 1600), 0.5, np.float32)
    depth[:, :400], depth[:, 400:800], depth[:, 800:1200] = np.nan, np.inf, -1
    surface = relief.measured_surface(depth, view)
    assert surface.shape == (400, 800)
    np.testing.assert_array_equal(surface[:, :600], 0)
    np.testing.assert_array_equal(surface[:, 600:], 0.5)
