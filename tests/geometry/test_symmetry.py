"""Symmetry groups."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import rotation_angle
from pnet.geometry.symmetry import (
    FLIP,
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    cyclic,
    dihedral,
    full_group,
    nearest_equivalent,
    reflection,
    rotation_about_z,
)

EYE = torch.eye(3, dtype=torch.float64)
THIRD = EYE[[2, 0, 1]]  # x → y → z → x
HALVES = [torch.diag(torch.tensor(d).double()) for d in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
TETRAHEDRAL = FiniteSymmetry(torch.stack([h @ t for h in HALVES for t in (EYE, THIRD, THIRD @ THIRD)]))


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


@pytest.mark.parametrize(
    ("normal", "expected"), [((0, 0, 5), [1, 1, -1]), ((-1, 0, 0), [-1, 1, 1]), ((0, 2, 0), [1, -1, 1])]
)
def test_a_reflection_turns_its_normal_round_and_nothing_else(normal, expected):
    torch.testing.assert_close(reflection(normal), torch.diag(torch.tensor(expected).double()))


def test_a_reflection_in_an_oblique_plane_exchanges_two_axes():
    torch.testing.assert_close(reflection((1, -1, 0)), EYE[[1, 0, 2]])


def test_the_full_group_without_a_mirror_is_the_proper_one():
    assert torch.equal(full_group(dihedral(3)), dihedral(3).rotations)
    assert (
        full_group(RevolutionSymmetry()).tolist()
        == full_group(SphericalSymmetry()).tolist()
        == [EYE.tolist()]
    )
    assert full_group(RevolutionSymmetry(True)).tolist() == [
        EYE.tolist(),
        [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    ]


@pytest.mark.parametrize(
    ("proper", "normal"),
    [(cyclic(1), (0, 1, 0)), (cyclic(4), (1, 1, 0)), (dihedral(2), (0, 0, 1)), (TETRAHEDRAL, (1, -1, 0))],
)
def test_a_mirror_doubles_the_group_proper_before_improper(proper, normal):
    G = full_group(proper, reflection(normal))
    n = len(proper.rotations)
    assert torch.equal(G[:n], proper.rotations) and len(G) == 2 * n
    torch.testing.assert_close(torch.linalg.det(G), torch.tensor([1.0] * n + [-1.0] * n).double())
    gap = ((G[:, None] @ G[None]).flatten(0, 1)[:, None] - G[None]).abs().amax((-1, -2)).amin(1)
    assert float(gap.max()) < 1e-12  # closed
    assert float((G - reflection(normal)).abs().amax((-1, -2)).min()) < 1e-12


@pytest.mark.parametrize(
    ("symmetry", "mirror", "message"),
    [
        (cyclic(1), EYE, "determinant -1"),
        (cyclic(1), 2 * reflection((1, 0, 0)), "orthonormal"),
        (cyclic(1), reflection((1, 0, 0))[:2], "orthonormal"),
        (cyclic(3), reflection((1, 0, 1)), "not a group together"),
        (RevolutionSymmetry(), reflection((1, 0, 0)), "leave it out"),
        (RevolutionSymmetry(True), reflection((0, 0, 1)), "leave it out"),
        (SphericalSymmetry(), -EYE, "leave it out"),
    ],
)
def test_a_mirror_that_does_not_fit_is_refused(symmetry, mirror, message):
    with pytest.raises(ValueError, match=message):
        full_group(symmetry, mirror)


def random_rotations(seed: int, n: int) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(n, np.random.default_rng(seed)).as_matrix())


SEEDS = given(seed=st.integers(0, 10**6))
FEW = settings(max_examples=20, deadline=None)
FINITE = {"none": cyclic(1), "cyclic": cyclic(2), "dihedral": dihedral(6), "tetrahedral": TETRAHEDRAL}
TURNS = rotation_about_z(torch.linspace(0, 2 * math.pi, 3601).double())  # every tenth of a degree


@pytest.mark.parametrize("name", FINITE)
@FEW
@SEEDS
def test_nearest_of_a_finite_group_is_that_of_all_tried(name, seed):
    G = FINITE[name].rotations
    R, reference = random_rotations(seed, 8), random_rotations(seed + 1, 8)
    found = nearest_equivalent(R, reference, FINITE[name])
    for one, given_one, aim in zip(found, R, reference, strict=True):
        angles = rotation_angle(given_one @ G, aim.expand(len(G), 3, 3))
        assert float(rotation_angle(one, aim)) == pytest.approx(float(angles.min()), abs=1e-7)
        assert float((given_one @ G - one).abs().amax((-1, -2)).min()) < 1e-12  # in R's class


@pytest.mark.parametrize("reflected", [False, True])
@FEW
@SEEDS
def test_nearest_of_a_revolution_is_that_of_all_turns(reflected, seed):
    R, reference = random_rotations(seed, 4), random_rotations(seed + 1, 4)
    found = nearest_equivalent(R, reference, RevolutionSymmetry(reflected))
    flip = torch.tensor(FLIP, dtype=torch.float64)
    G = torch.cat([TURNS, TURNS @ flip]) if reflected else TURNS
    for one, given_one, aim in zip(found, R, reference, strict=True):
        least = float(rotation_angle(given_one @ G, aim.expand(len(G), 3, 3)).min())
        # the sampling can be worse than the closed form by half a step, never better
        assert least - math.radians(0.05) <= float(rotation_angle(one, aim)) <= least + 1e-7
        between = given_one.mT @ one  # an element of the group: keeps z, or turns it round
        sign = float(between[2, 2])
        assert abs(sign) == pytest.approx(1, abs=1e-12) and (reflected or sign > 0)
        assert float(torch.linalg.det(one)) == pytest.approx(1)


@FEW
@SEEDS
def test_nearest_of_a_sphere_is_the_reference_itself(seed):
    R, reference = random_rotations(seed, 3), random_rotations(seed + 1, 3)
    assert torch.equal(nearest_equivalent(R, reference, SphericalSymmetry()), reference)


@pytest.mark.parametrize(
    "symmetry",
    [dihedral(6), TETRAHEDRAL, RevolutionSymmetry(True), SphericalSymmetry()],
    ids=["dihedral", "tetrahedral", "revolution", "sphere"],
)
def test_one_reference_serves_many_rotations(symmetry):
    R, reference = random_rotations(0, 6).view(2, 3, 3, 3), random_rotations(1, 1)[0]
    found = nearest_equivalent(R, reference, symmetry)
    assert found.shape == (2, 3, 3, 3)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(found[i, j], nearest_equivalent(R[i, j], reference, symmetry))


def test_nearest_keeps_float32():
    R = random_rotations(0, 2).float()
    for symmetry in (dihedral(6), RevolutionSymmetry(True), SphericalSymmetry()):
        assert nearest_equivalent(R[:1], R[1:], symmetry).dtype == torch.float32
