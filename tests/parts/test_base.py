"""What every template promises, and the constants of its pose distance."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import ConvexHull

from pnet.geometry.symmetry import RevolutionSymmetry, SphericalSymmetry, cyclic, dihedral
from pnet.parts.base import pose_space_of_mesh
from pnet.parts.tn06 import TN06
from pnet.parts.tn34 import TN34

GRID_06 = {"r": [2.5, 7], "h": [8], "d": [12]}
GRID_34 = {"r": [12], "h": [10, 13, 16]}


def some_objects(part) -> list[np.ndarray]:
    """The corners of both grids, metres."""
    return [grid[i] for grid in part.grids.values() for i in (0, len(grid) // 3, len(grid) - 1)]


def test_meshes_are_closed_and_wound_outwards(part):
    for parameters in some_objects(part):
        mesh = part.mesh(parameters)
        assert mesh.is_watertight and mesh.is_winding_consistent
        assert mesh.volume > 0
        assert mesh.euler_number == 0  # one hole goes through


def test_the_volume_centroid_is_the_origin(part):
    for parameters in some_objects(part):
        assert np.abs(part.mesh(parameters).center_mass).max() < 1e-9


def test_exact_convex_pieces_unite_to_the_solid(part):
    for parameters in some_objects(part)[::2]:
        pieces = part.convex_pieces(parameters, fill_holes=False)
        hulls = [trimesh.convex.convex_hull(1000 * piece) for piece in pieces]
        volume = 1e9 * part.mesh(parameters).volume
        assert trimesh.boolean.union(hulls, engine="manifold").volume == pytest.approx(volume, rel=1e-6)
        assert sum(ConvexHull(1000 * p).volume for p in pieces) == pytest.approx(volume, rel=1e-6)


def test_filled_convex_pieces_leave_out_the_hole_alone(part):
    """The pieces' volume is the solid's and the hole's; no corner lies outside the solid's bounds."""
    for parameters in some_objects(part)[::2]:
        mesh = part.mesh(parameters)
        pieces = part.convex_pieces(parameters, fill_holes=True)
        filled = sum(ConvexHull(piece).volume for piece in pieces)
        hole_radius = np.linalg.norm(mesh.vertices[:, :2], axis=1).min()
        hole = part.sections / 2 * hole_radius**2 * math.sin(2 * math.pi / part.sections)
        height = np.ptp(mesh.bounds[:, 2])
        assert filled == pytest.approx(mesh.volume + hole * height, rel=1e-6)
        corners = np.concatenate(pieces)
        np.testing.assert_allclose([corners.min(0), corners.max(0)], mesh.bounds, atol=1e-9)


def test_pieces_are_fewer_without_holes(part):
    parameters = part.part_object("L", 0)
    assert len(part.convex_pieces(parameters, True)) <= 2 < len(part.convex_pieces(parameters, False))


def test_the_learning_and_generalization_grids_share_no_part_object(part):
    learning, generalization = ({tuple(p) for p in part.grids[g]} for g in "LG")
    assert len(learning) == len(part.grids["L"]) and not learning & generalization


def test_the_first_parameter_runs_fastest_in_the_grid():
    part = TN34(GRID_34, {"r": [1, 2], "h": [3, 4]})
    expected = [[0.001, 0.003], [0.002, 0.003], [0.001, 0.004], [0.002, 0.004]]
    np.testing.assert_allclose(part.grids["G"], expected)
    np.testing.assert_allclose(part.part_object("G", 1), [0.002, 0.003])


@pytest.mark.parametrize("index", [-1, 3, 100])
def test_a_part_object_outside_the_grid_is_refused(index):
    part = TN34(GRID_34, GRID_34)
    with pytest.raises(ValueError, match=rf"tn34 has no part object {index} in grid L: choose 0 to 2"):
        part.part_object("L", index)


def test_an_unknown_grid_is_refused():
    with pytest.raises(ValueError, match=r"tn34 has no grid 'train': choose L or G"):
        TN34(GRID_34, GRID_34).part_object("train", 0)


@pytest.mark.parametrize("bad", [0.0, -3.0, math.nan, math.inf])
def test_a_grid_value_that_is_not_positive_and_finite_is_refused(bad):
    with pytest.raises(ValueError, match=rf"tn34: parameters must be positive, got .*h = {bad:g} mm"):
        TN34({"r": [12], "h": [10, bad]}, GRID_34)


@pytest.mark.parametrize("grid", [{"r": [12]}, {"r": [12], "x": [1]}, {**GRID_34, "d": [3]}])
def test_a_grid_that_names_other_parameters_is_refused(grid):
    with pytest.raises(ValueError, match=r"part.generalization names .*tn34 has \['h', 'r'\]"):
        TN34(GRID_34, grid)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_the_wrong_number_of_parameters_is_refused(count):
    part = TN34(GRID_34, GRID_34)
    with pytest.raises(ValueError, match=r"tn34 takes parameters \('r', 'h'\), got \[.*\]"):
        part.check_named(np.full(count, 0.01))


@pytest.mark.parametrize("sections", [0, 4, 50, -6])
def test_sections_that_are_no_multiple_of_six_are_refused(sections):
    with pytest.raises(ValueError, match=f"tn06: sections is {sections}, expected a multiple of 6"):
        TN06(GRID_06, GRID_06, sections)


def test_parameters_read_in_millimetres(tn06):
    assert tn06.text(np.array([0.0025, 0.008, 0.012])) == "r = 2.5 mm, h = 8 mm, d = 12 mm"


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


def test_equivalent_poses_of_a_part_object_have_no_distance(tn06):
    space = tn06.pose_space(tn06.part_object("L", 0))
    eye, zero = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    G = tn06.symmetry.rotations
    distance = space.distance(eye, zero, G, zero.expand(12, 3))
    assert float(distance.max()) < 1e-9
    shifted = space.distance(eye, zero, G, torch.tensor([0.003, 0, 0.004]).double().expand(12, 3))
    torch.testing.assert_close(shifted, torch.full((12,), 0.005).double(), atol=1e-9, rtol=0)
