"""Samples of a part's surface: on it, with its normals, and those that look at the camera."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.postprocess.test_icp import surface_distance

from pnet.postprocess.surface import Surface, sample_surface


def test_only_faces_that_look_at_the_camera_are_matched():
    """A cube 1 m before the camera: its front; with the sides, which are edge-on, and not its back."""
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    surface = Surface(0.01 * normals, normals)
    seen = surface.facing(np.eye(3), np.array([0, 0, 1.0]))
    assert seen.normals.tolist() == [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]
    tilted = Rotation.from_euler("y", 15, degrees=True).as_matrix()
    assert len(surface.facing(tilted, np.array([0, 0, 1.0])).points) == 4


def test_samples_lie_on_the_surface_with_its_normals(part, random_sizes):
    size = random_sizes(part, 1)[0]
    surface = sample_surface(part, tuple(size.tolist()), 500)
    assert surface.points.shape == surface.normals.shape == (500, 3)
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-12)
    eye, zero = torch.eye(3).double(), torch.zeros(3).double()
    on = torch.from_numpy(surface.points[:40])
    assert surface_distance(part, size, eye, zero, on).max() < 1e-12
    within = part.mesh(size.numpy()).contains(surface.points - 1e-5 * surface.normals)
    assert within.mean() > 0.99  # all but those nearer than that to an edge


def test_samples_are_the_same_every_time(part, random_sizes):
    size = tuple(random_sizes(part, 1)[0].tolist())
    first = sample_surface(part, size, 100)
    sample_surface.cache_clear()
    second = sample_surface(part, size, 100)
    assert first is not second
    assert np.array_equal(first.points, second.points) and np.array_equal(first.normals, second.normals)


@pytest.mark.parametrize("size", [(0.02, 0.01, 0.012), (0.003, -0.01, 0.012), (0.003, math.nan, 0.012)])
def test_an_impossible_size_has_no_surface(tn06, size):
    """A nut with a hole wider than itself, one of a negative edge, one of a size that is no number."""
    assert sample_surface(tn06, size, 100) is None
