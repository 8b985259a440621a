"""A part's surface: its triangles, samples of it with its normals, and those that look at the camera."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from tests.postprocess.test_icp import surface_distance

from pnet.postprocess import surface as module
from pnet.postprocess.surface import SLIVER, Surface, sample_surface
from pnet.postprocess.surface_registration import nearest_on_triangles


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


def test_triangles_are_those_of_the_mesh(part, random_sizes):
    """All of them here, wound as their outward normals say, and closed."""
    size = random_sizes(part, 1)[0]
    mesh = part.mesh(size.numpy())
    triangles = sample_surface(part, tuple(size.tolist()), 10).triangles
    np.testing.assert_allclose(triangles.corners, mesh.triangles, rtol=0, atol=1e-15)
    side, other = (triangles.corners[:, i] - triangles.corners[:, 0] for i in (1, 2))
    twice = np.cross(side, other)  # the area
    np.testing.assert_allclose(
        np.einsum("ij,ij->i", twice, triangles.normals) / 2, mesh.area_faces, rtol=1e-9
    )
    volume = np.einsum("ij,ij->", twice, triangles.corners[:, 0]) / 6
    assert volume == pytest.approx(mesh.volume, rel=1e-9) and volume > 0


def flat(corners: list[list[float]], faces: list[list[int]]) -> trimesh.Trimesh:
    return trimesh.Trimesh(np.array(corners, np.float64), faces, process=False)


def test_slivers_are_dropped(tn34, monkeypatch):
    """Triangles of 50 mm², of half and twice the area that a sliver may have, and of none."""
    wide = 2 * SLIVER / 0.01  # metres: that high over a side of 10 mm the area is the limit
    places = [[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, wide / 2, 0], [0, 2 * wide, 0], [0.005, 0, 0]]
    mesh = flat(places, [[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 1, 5]])
    monkeypatch.setattr(type(tn34), "mesh", lambda self, parameters: mesh)
    triangles = sample_surface(tn34, (0.0161, 0.0171), 10).triangles
    np.testing.assert_array_equal(triangles.corners[:, 2], np.array(places)[[2, 4]])
    np.testing.assert_allclose(triangles.normals, [[0, 0, 1]] * 2, rtol=0, atol=1e-12)
    sample_surface.cache_clear()


def test_of_a_mesh_too_fine_patches_about_the_samples_stand_for_the_surface(tn34, monkeypatch):
    size = (0.0163, 0.0173)
    fine = len(tn34.mesh(np.array(size)).faces)
    exact = []
    for most in (fine, fine - 1):
        monkeypatch.setattr(module, "MOST_TRIANGLES", most)
        sample_surface.cache_clear()
        exact.append(sample_surface(tn34, size, 100))
    sample_surface.cache_clear()
    known, unknown = exact
    assert len(known.triangles.corners) == fine
    assert np.array_equal(known.points, unknown.points)
    corners, normals = unknown.triangles.corners, unknown.triangles.normals
    assert corners.shape == (100, 3, 3) and np.array_equal(normals, unknown.normals)
    np.testing.assert_allclose(corners.mean(1), unknown.points, atol=1e-15)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    share = 0.01 * tn34.mesh(np.array(size)).area
    # equilateral with that circumradius, wound about the normal
    np.testing.assert_allclose(across / 2, 0.75 * math.sqrt(3) * share * normals, rtol=0, atol=1e-12)


def test_patches_are_nearly_as_good_as_the_mesh(tn34, monkeypatch):
    """Places 1 mm over the surface: half of them are as far from both, to 20 µm, and most of the others lie
    beside an edge that patches reach over. From samples alone half are farther by a tenth and more."""
    size = (0.0164, 0.0174)
    dense = sample_surface(tn34, size, 400)
    over = torch.from_numpy(dense.points + 0.001 * dense.normals)[None]
    found = []
    for most in (2000, 10):
        monkeypatch.setattr(module, "MOST_TRIANGLES", most)
        sample_surface.cache_clear()
        triangles = sample_surface(tn34, size, 1000).triangles
        corners, normals = torch.from_numpy(triangles.corners), torch.from_numpy(triangles.normals)
        place, _ = nearest_on_triangles(over, corners, normals, torch.ones(1, len(corners), dtype=torch.bool))
        found.append(torch.linalg.vector_norm(over - place, dim=-1)[0])
    sample_surface.cache_clear()
    off = (found[1] - found[0]).abs()
    assert float(off.median()) < 2e-5 and float(off.quantile(0.9)) < 3e-4
    samples = torch.from_numpy(sample_surface(tn34, size, 1000).points)
    assert float((torch.cdist(over[0], samples).amin(1) - found[0]).median()) > 1e-4
