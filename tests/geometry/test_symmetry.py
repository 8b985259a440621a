"""Symmetry groups."""

import math

import pytest
import torch

from pnet.geometry.symmetry import FiniteSymmetry, cyclic, dihedral, rotation_about_z

EYE = torch.eye(3, dtype=torch.float64)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_the_groups_have_their_order_and_start_with_the_identity(n):
    assert len(cyclic(n).rotations) == n
    assert len(dihedral(n).rotations) == 2 * n
    for group in (cyclic(n), dihedral(n)):
        torch.testing.assert_close(group.rotations[0], EYE)
        gaps = (group.rotations[:, None] - group.rotations[None]).abs().amax((-1, -2))
        assert (gaps > 0.1).sum() == len(gaps) * (len(gaps) - 1)  # all elements differ


@pytest.mark.parametrize("group", [cyclic(5), dihedral(4)], ids=["cyclic", "dihedral"])
def test_the_inverse_of_an_element_is_an_element(group):
    G = group.rotations
    gap = (G.mT[:, None] - G[None]).abs().amax((-1, -2)).amin(1)
    assert gap.max() < 1e-12


def test_a_cyclic_group_turns_about_z():
    G = cyclic(4).rotations
    torch.testing.assert_close(G[1] @ EYE[0], EYE[1])
    torch.testing.assert_close(G @ EYE[2], EYE[2].expand(4, 3))


def test_a_dihedral_group_exchanges_the_two_ends_of_its_axis():
    ends = dihedral(3).rotations[:, 2, 2]
    assert ends.tolist() == [1, 1, 1, -1, -1, -1]
    half_turn_about_x = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    assert (dihedral(3).rotations - half_turn_about_x).abs().amax((-1, -2)).min() < 1e-12


def test_rotation_about_z_carries_x_towards_y():
    R = rotation_about_z(torch.tensor([0.0, math.pi / 2, math.pi]).double())
    expected = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0]]).double()
    torch.testing.assert_close(R[..., 0], expected)
    assert rotation_about_z(torch.zeros(2, 4)).shape == (2, 4, 3, 3)


@pytest.mark.parametrize(
    ("rotations", "message"),
    [
        (EYE, "shape"),
        (torch.empty(0, 3, 3), "shape"),
        (torch.stack([EYE, -EYE]), "determinant"),
        (torch.stack([EYE, 1.001 * EYE]), "orthonormal"),
        (cyclic(3).rotations[:2], "not a group"),
        (cyclic(2).rotations[1:], "not a group"),
    ],
)
def test_what_is_no_proper_group_is_refused(rotations, message):
    with pytest.raises(ValueError, match=message):
        FiniteSymmetry(rotations)
