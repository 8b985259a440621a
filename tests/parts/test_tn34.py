"""The stepped flange."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pnet.parts.choice import KeypointChoice
from pnet.parts.tn34 import BOSS, DISC, HOLE

SECTIONS = 48
# height of the centroid over the base / total height: first moment of disc and boss over their volume
_DISC, _BOSS = 1 - HOLE**2, BOSS**2 - HOLE**2
CENTROID = (_DISC * DISC**2 + _BOSS * (1 - DISC**2)) / 2 / (_DISC * DISC + _BOSS * (1 - DISC))


def ring_area(outer: float, inner: float) -> float:
    return SECTIONS / 2 * (outer**2 - inner**2) * math.sin(2 * math.pi / SECTIONS)


def test_both_grids_have_16_part_objects(tn34):
    assert tn34.grids["L"].shape == tn34.grids["G"].shape == (16, 2)


def test_the_volume_is_disc_and_boss(tn34):
    for r, h in tn34.grids["L"]:
        expected = ring_area(r, HOLE * r) * DISC * h + ring_area(BOSS * r, HOLE * r) * (1 - DISC) * h
        assert tn34.mesh(np.array([r, h])).volume == pytest.approx(expected, rel=1e-9)


def test_the_wide_disc_lies_below(tn34):
    r, h = 0.012, 0.010
    vertices = tn34.mesh(np.array([r, h])).vertices
    radius = np.linalg.norm(vertices[:, :2], axis=1)
    assert vertices[radius > 0.99 * r][:, 2].max() == pytest.approx((DISC - CENTROID) * h)
    assert np.ptp(vertices[:, 2]) == pytest.approx(h)


def test_turning_by_a_section_maps_the_vertices_onto_themselves(tn34):
    mesh = tn34.mesh(tn34.part_object("L", 5))
    angle = 2 * math.pi / SECTIONS
    turn = np.array(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    )
    gap, index = cKDTree(mesh.vertices).query(mesh.vertices @ turn.T)
    assert gap.max() < 1e-9 and len(set(index)) == len(mesh.vertices)


def test_its_ends_differ(tn34):
    vertices = tn34.mesh(tn34.part_object("L", 5)).vertices
    assert not tn34.symmetry.rotoreflection
    assert cKDTree(vertices).query(vertices * [1, -1, -1])[0].max() > 1e-3


def test_the_keypoints_are_the_ends_of_the_axis_and_a_point_of_the_rim(tn34):
    parameters = torch.tensor([0.012, 0.010], dtype=torch.float64)
    base, top, rim = tn34.chain.keypoints_from_parameters(parameters)
    low, high = tn34.mesh(parameters.numpy()).bounds[:, 2]
    assert base.tolist() == pytest.approx([0, 0, low])
    assert top.tolist() == pytest.approx([0, 0, high])
    assert rim.tolist() == pytest.approx([0.012, 0, low])


def test_the_chosen_rim_point_lies_on_the_base(tn34):
    """The base does not jump with the view, so the rim stays below."""
    parameters = torch.tensor([0.012, 0.010], dtype=torch.float64)
    for up in (1.0, -1.0):
        R = torch.diag(torch.tensor([1.0, up, up], dtype=torch.float64))
        (base, _, rim), _ = tn34.chain.select(KeypointChoice(), parameters, R)
        assert rim[2] == base[2] == pytest.approx(-CENTROID * 0.010)
