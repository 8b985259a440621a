"""The constants of a part's pose distance against closed forms and scipy's hulls."""

import math

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from pnet.geometry.symmetry import RevolutionSymmetry, SphericalSymmetry, cyclic, dihedral
from pnet.parts.base import pose_space_of_mesh


def test_pose_space_of_a_box():
    """Second moments of a box's surface by hand: a pair of faces at ±a/2, four faces spread over a²/12."""
    a, b, c = sides = np.array([0.01, 0.02, 0.04])
    pairs = 2 * np.array([b * c, a * c, a * b])  # area of the two faces across each axis
    spread = sides**2 * (pairs / 4 + (pairs.sum() - pairs) / 12) / pairs.sum()
    shift = np.array([0.1, -0.2, 0.3])
    space = pose_space_of_mesh(trimesh.creation.box(sides).apply_translation(shift), cyclic(1))
    np.testing.assert_allclose(space.centre, shift, atol=1e-12)
    np.testing.assert_allclose(space.scale, np.diag(np.sqrt(spread)), atol=1e-12)
    assert space.distance_threshold == pytest.approx(0.1 * np.linalg.norm(sides))


def test_pose_space_of_a_sphere():
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.03)
    space = pose_space_of_mesh(sphere, SphericalSymmetry())
    assert float(space.scale) == pytest.approx(0.03 * math.sqrt(2 / 3), rel=1e-3)
    assert space.distance_threshold == pytest.approx(0.1 * 2 * 0.03)


def test_pose_space_of_a_cylinder():
    """λ² = E x² + E z² over the mantle (2πRh: R²/2, h²/12) and the caps (πR² each: R²/4, h²/4)."""
    R, h = 0.02, 0.05
    mantle, caps = 2 * math.pi * R * h, 2 * math.pi * R**2
    moment = mantle * (R**2 / 2 + h**2 / 12) + caps * (R**2 / 4 + h**2 / 4)
    space = pose_space_of_mesh(
        trimesh.creation.cylinder(radius=R, height=h, sections=720), RevolutionSymmetry(True)
    )
    assert float(space.scale) == pytest.approx(math.sqrt(moment / (mantle + caps)), rel=1e-4)
    assert space.distance_threshold == pytest.approx(0.2 * math.hypot(R, h / 2))


def test_the_inertial_symmetries_are_the_parts_own():
    """A prism lying along x: the eigenframe turns the axes, and the group turns with them."""
    lying = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    solid = trimesh.creation.cylinder(radius=0.02, height=0.1, sections=6)
    solid.apply_transform(np.block([[lying, np.zeros((3, 1))], [np.zeros((1, 3)), 1]]))
    group = torch.from_numpy(lying) @ dihedral(6).rotations @ torch.from_numpy(lying).T
    space = pose_space_of_mesh(solid, type(dihedral(6))(group))
    back = space.frame_R.T @ space.symmetry.rotations @ space.frame_R
    torch.testing.assert_close(back, group, atol=1e-12, rtol=0)
    assert float(torch.linalg.det(space.frame_R)) == pytest.approx(1)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_pose_space_of_any_hull_is_that_of_points_spread_over_its_facets(seed):
    """A quadratic's mean over a triangle is that over its edges' midpoints, here on scipy's facets."""
    points = np.random.default_rng(seed).normal(size=(14, 3)) * [0.01, 0.02, 0.04]
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert area.sum() == pytest.approx(hull.area)
    middles = (corners + np.roll(corners, 1, 1)) / 2
    weight = np.repeat(area / (3 * hull.area), 3)
    centre = weight @ middles.reshape(-1, 3)
    offset = middles.reshape(-1, 3) - centre
    mesh = trimesh.Trimesh(points, hull.simplices)
    mesh.fix_normals()
    space = pose_space_of_mesh(mesh, cyclic(1))
    np.testing.assert_allclose(space.centre, centre, atol=1e-12)
    np.testing.assert_allclose(
        space.frame_R.T @ space.scale**2 @ space.frame_R, (weight[:, None] * offset).T @ offset, atol=1e-12
    )
    farthest = np.linalg.norm(points[hull.vertices] - centre, axis=1).max()
    assert space.distance_threshold == pytest.approx(0.2 * farthest)


def test_the_distance_of_two_poses_is_the_root_mean_square_way_of_the_surface():
    solid = trimesh.creation.box([0.01, 0.02, 0.04])
    space = pose_space_of_mesh(solid, cyclic(1))
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    eye, t = torch.eye(3, dtype=torch.float64), torch.tensor([0.003, -0.001, 0.002], dtype=torch.float64)
    points, _ = trimesh.sample.sample_surface(solid, 200_000, seed=0)
    way = points @ turn.numpy().T + t.numpy() - points
    found = float(space.distance(eye, torch.zeros(3).double(), turn, t))
    assert found == pytest.approx(math.sqrt((way**2).sum(1).mean()), rel=5e-3)
