"""The hexagonal nut."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pnet.parts.choice import KeypointChoice
from pnet.parts.tn06 import TN06

SECTIONS = 48


def hole_area(r: float) -> float:
    return SECTIONS / 2 * r**2 * math.sin(2 * math.pi / SECTIONS)


def test_both_grids_have_64_part_objects(tn06):
    assert tn06.grids["L"].shape == tn06.grids["G"].shape == (64, 3)


def test_the_part_index_counts_the_hole_then_the_height_then_the_hexagon(tn06):
    """index = i_r + 4 i_h + 16 i_d, millimetres from the published parts."""
    r, h, d = [2.5, 4, 5.5, 7], [8, 11, 14, 17], [12, 14, 16, 18]
    for i_d, i_h, i_r in np.ndindex(4, 4, 4):
        index = i_r + 4 * i_h + 16 * i_d
        assert 1000 * tn06.part_object("L", index) == pytest.approx([r[i_r], h[i_h], d[i_d]])
    assert 1000 * tn06.part_object("G", 63) == pytest.approx([7.5, 18, 19])


def test_the_volume_is_hexagon_less_hole_times_height(tn06):
    for r, h, d in tn06.grids["L"][::9]:
        expected = (1.5 * math.sqrt(3) * d**2 - hole_area(r)) * h
        assert tn06.mesh(np.array([r, h, d])).volume == pytest.approx(expected, rel=1e-6)


def test_the_hexagon_has_a_vertex_on_x_and_the_axis_is_z(tn06):
    mesh = tn06.mesh(np.array([0.004, 0.010, 0.012]))
    np.testing.assert_allclose(mesh.bounds[1], [0.012, 0.012 * math.sqrt(0.75), 0.005], atol=1e-9)
    np.testing.assert_allclose(mesh.bounds[0], -mesh.bounds[1], atol=1e-9)


def test_the_symmetry_maps_the_vertices_onto_themselves(tn06):
    assert len(tn06.symmetry.rotations) == 12
    vertices = tn06.mesh(tn06.part_object("L", 10)).vertices
    for G in tn06.symmetry.rotations.numpy():
        gap, index = cKDTree(vertices).query(vertices @ G.T)
        assert gap.max() < 1e-9
        assert len(set(index)) == len(vertices)


def test_half_a_symmetry_turn_does_not(tn06):
    vertices = tn06.mesh(tn06.part_object("L", 10)).vertices
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    turned = vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    assert cKDTree(vertices).query(turned)[0].max() > 1e-3


def test_the_keypoints_measure_radius_height_and_circumradius(tn06):
    parameters = torch.tensor([0.0055, 0.014, 0.016], dtype=torch.float64)
    kp1, kp2, kp3 = tn06.chain.keypoints_from_parameters(parameters)
    assert [float(torch.linalg.vector_norm(v)) for v in (kp2 - kp1, 2 * kp1, kp3 - kp1)] == pytest.approx(
        [0.0055, 0.014, 0.016]
    )
    assert kp1.tolist() == pytest.approx([0, 0, 0.007])


def test_the_keypoints_lie_on_the_surface(tn06):
    parameters = tn06.part_object("L", 21)
    vertices = tn06.mesh(parameters).vertices
    hole, vertex = tn06.chain.keypoints_from_parameters(torch.from_numpy(parameters))[1:].numpy()
    assert cKDTree(vertices).query([hole, vertex])[0].max() < 1e-9


@pytest.mark.parametrize("r", [12 * math.sqrt(0.75), 11.0, 13.0])
def test_a_hole_as_wide_as_the_hexagon_is_refused(r):
    grid = {"r": [2.5, r], "h": [8], "d": [12]}
    with pytest.raises(ValueError, match=rf"tn06: the hole \(r = {r:g} mm\) .* 10.3923 mm"):
        TN06(grid, grid)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan])
def test_values_that_are_not_positive_are_refused_before_the_hole_is_compared(bad):
    grid = {"r": [2.5], "h": [8], "d": [12]}
    with pytest.raises(ValueError, match=rf"tn06: parameters must be positive, got .*d = {bad:g} mm"):
        TN06(grid, {**grid, "d": [12, bad]})


def test_a_hole_just_inside_the_hexagon_makes_a_solid():
    grid = {"r": [10.3], "h": [8], "d": [12]}
    part = TN06(grid, grid)
    mesh = part.mesh(part.part_object("L", 0))
    assert mesh.is_watertight and mesh.volume > 0


def test_hole_and_vertex_of_the_labels_lie_on_the_face_nearest_to_the_camera(tn06, rotations):
    R = rotations(50)
    parameters = torch.tensor([0.0055, 0.014, 0.016], dtype=torch.float64).expand(50, 3)
    labels, _ = tn06.chain.select(KeypointChoice(), parameters, R)
    side = -0.007 * R[:, 2, 2].sign()
    torch.testing.assert_close(labels[..., 2], side[:, None].expand(50, 3))
    face, hole, vertex = (labels @ R.mT)[..., 2].unbind(-1)
    assert (hole < face).all() and (vertex < hole + 1e-12).sum() > 40  # the vertex lies farther out
    corners = torch.tensor(
        [[0.016 * math.cos(i * math.pi / 3), 0.016 * math.sin(i * math.pi / 3)] for i in range(6)]
    ).double()
    nearest = (corners @ R[:, 2, :2].T).argmin(0)
    torch.testing.assert_close(labels[:, 2, :2], corners[nearest])


def test_its_mirror_planes_add_no_second_structure(tn06):
    assert len(tn06.chain.chiralities) == 1 and tn06.mirror is None
    assert tn06.chain.is_finite == [True, False, True]
