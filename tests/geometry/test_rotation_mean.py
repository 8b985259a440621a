"""Mean rotation modulo a symmetry group."""

import math

import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import axis_angle_between, rotation_angle
from pnet.geometry.rotation_mean import mean_rotation
from pnet.geometry.symmetry import (
    FLIP,
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    cyclic,
    dihedral,
    rotation_about_z,
)

THIRD = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)  # x → y → z → x
HALF = [torch.diag(torch.tensor(d).double()) for d in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
TETRAHEDRAL = FiniteSymmetry(torch.stack([h @ t for h in HALF for t in (HALF[0], THIRD, THIRD @ THIRD)]))
CLASSES = {
    "none": cyclic(1),
    "cyclic": cyclic(2),
    "dihedral": dihedral(6),
    "tetrahedral": TETRAHEDRAL,
    "revolution": RevolutionSymmetry(),
    "reversible": RevolutionSymmetry(rotoreflection=True),
    "sphere": SphericalSymmetry(),
}
WIDTH = math.radians(25)


@pytest.fixture(params=list(CLASSES), scope="module")
def symmetry(request):
    return CLASSES[request.param]


def random_rotations(n: int, generator: torch.Generator) -> torch.Tensor:
    q = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    return torch.from_numpy(Rotation.from_quat(q.numpy()).as_matrix())


def small_rotations(n: int, degrees: float, generator: torch.Generator) -> torch.Tensor:
    """Turns by a normal vector of so many degrees in each component."""
    vector = math.radians(degrees) * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    return torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix())


def elements(symmetry, n: int, generator: torch.Generator) -> torch.Tensor:
    """(n, 3, 3) members of the group at random."""
    match symmetry:
        case FiniteSymmetry(rotations=G):
            return G[torch.randint(len(G), (n,), generator=generator)]
        case RevolutionSymmetry(rotoreflection=reflected):
            turn = rotation_about_z(6.3 * torch.rand(n, generator=generator, dtype=torch.float64))
            flip = torch.stack([torch.eye(3, dtype=torch.float64), torch.tensor(FLIP, dtype=torch.float64)])
            which = torch.randint(2 if reflected else 1, (n,), generator=generator)
            return turn @ flip[which]
    return random_rotations(n, generator)


def angle_modulo(symmetry, Ra: torch.Tensor, Rb: torch.Tensor) -> float:
    """Largest angle, radians, after the symmetry is taken out."""
    match symmetry:
        case FiniteSymmetry(rotations=G):
            each = rotation_angle(
                Ra[..., None, :, :] @ G, Rb[..., None, :, :].expand(*Rb.shape[:-2], len(G), 3, 3)
            )
            return float(each.amin(-1).max())
        case RevolutionSymmetry(rotoreflection=reflected):
            angle = axis_angle_between(Ra[..., 2], Rb[..., 2])
            return float((torch.minimum(angle, math.pi - angle) if reflected else angle).max())
    return 0.0


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 40))
def test_exact_hypotheses_scattered_over_the_group_give_the_exact_rotation(symmetry, seed, n):
    generator = torch.Generator().manual_seed(seed)
    truth = random_rotations(1, generator)
    found = mean_rotation(truth @ elements(symmetry, n, generator), torch.ones(n).double(), symmetry, WIDTH)
    assert angle_modulo(symmetry, found, truth[0]) < 1e-7
    torch.testing.assert_close(found @ found.mT, torch.eye(3).double(), rtol=0, atol=1e-9)
    assert float(torch.linalg.det(found)) == pytest.approx(1)


@pytest.mark.parametrize("seed", range(5))
def test_thirty_percent_of_random_outliers_hardly_move_it(symmetry, seed):
    """Seventy hypotheses are off by two degrees a component, thirty point anywhere."""
    generator = torch.Generator().manual_seed(seed)
    truth = random_rotations(1, generator)
    R = truth @ small_rotations(100, 2.0, generator) @ elements(symmetry, 100, generator)
    R[torch.arange(100) % 10 < 3] = random_rotations(30, generator)
    found = mean_rotation(R, torch.ones(100).double(), symmetry, WIDTH)
    assert math.degrees(angle_modulo(symmetry, found, truth[0])) < 1.5


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_replacing_hypotheses_by_equivalents_changes_nothing(symmetry, seed):
    generator = torch.Generator().manual_seed(seed)
    R = random_rotations(1, generator) @ small_rotations(30, 5.0, generator)
    weight = torch.rand(30, generator=generator, dtype=torch.float64)
    plain = mean_rotation(R, weight, symmetry, WIDTH)
    other = mean_rotation(R @ elements(symmetry, 30, generator), weight, symmetry, WIDTH)
    assert angle_modulo(symmetry, plain, other) < 1e-6


def test_turning_the_camera_turns_the_mean(symmetry):
    generator = torch.Generator().manual_seed(1)
    R = random_rotations(1, generator) @ small_rotations(30, 5.0, generator)
    turn, weight = random_rotations(1, generator)[0], torch.ones(30).double()
    first, second = (
        mean_rotation(R, weight, symmetry, WIDTH),
        mean_rotation(turn @ R, weight, symmetry, WIDTH),
    )
    assert angle_modulo(symmetry, turn @ first, second) < 1e-7


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_without_symmetry_and_with_a_wide_kernel_it_is_the_chordal_mean(seed):
    """Tukey's weight of a kernel a thousand times as wide as the scatter is 1 for all."""
    generator = torch.Generator().manual_seed(seed)
    R = random_rotations(1, generator) @ small_rotations(20, 0.05, generator)
    weight = 0.1 + torch.rand(20, generator=generator, dtype=torch.float64)
    expected = Rotation.from_matrix(R.numpy()).mean(weight.numpy()).as_matrix()
    found = mean_rotation(R, weight, cyclic(1), math.radians(100))
    assert float(rotation_angle(found, torch.from_numpy(expected))) < 1e-7


def test_weights_decide_between_two_camps():
    """Forty hypotheses of little weight against ten of much."""
    generator = torch.Generator().manual_seed(0)
    camps = random_rotations(2, generator)
    assert float(rotation_angle(camps[0], camps[1])) > 3 * WIDTH
    R = torch.cat([camps[0].expand(40, 3, 3), camps[1].expand(10, 3, 3)])
    weight = torch.cat([torch.full((40,), 0.1), torch.full((10,), 1.0)]).double()
    assert float(rotation_angle(mean_rotation(R, weight, cyclic(1), WIDTH), camps[1])) < 1e-7
    equal = mean_rotation(R, torch.ones(50).double(), cyclic(1), WIDTH)
    assert float(rotation_angle(equal, camps[0])) < 1e-7


def test_hypotheses_of_no_weight_do_not_count():
    generator = torch.Generator().manual_seed(0)
    R = random_rotations(30, generator)
    weight = torch.zeros(30, dtype=torch.float64)
    weight[17] = 0.2
    for symmetry in (cyclic(1), dihedral(6), RevolutionSymmetry(True)):
        assert angle_modulo(symmetry, mean_rotation(R, weight, symmetry, WIDTH), R[17]) < 1e-7


def test_instances_side_by_side_are_as_one_by_one(symmetry):
    generator = torch.Generator().manual_seed(2)
    R = torch.stack([random_rotations(1, generator) @ small_rotations(15, 4.0, generator) for _ in range(6)])
    weight = torch.rand(6, 15, generator=generator, dtype=torch.float64)
    together = mean_rotation(R, weight, symmetry, WIDTH)
    alone = torch.stack([mean_rotation(r, w, symmetry, WIDTH) for r, w in zip(R, weight, strict=True)])
    assert together.shape == (6, 3, 3)
    assert angle_modulo(symmetry, together, alone) < 1e-9
    assert mean_rotation(R.view(2, 3, 15, 3, 3), weight.view(2, 3, 15), symmetry, WIDTH).shape == (2, 3, 3, 3)


def test_a_small_cluster_does_not_depend_on_the_padding_beside_it():
    R = roma.random_rotmat(20).double()
    R = roma.special_procrustes(R)
    R[6:] = R[0]
    alone = mean_rotation(R, torch.ones(20).double(), cyclic(2), 0.4)
    padded = torch.cat([R, R[:1].expand(200, 3, 3)])
    weight = torch.cat([torch.ones(20), torch.zeros(200)]).double()
    torch.testing.assert_close(mean_rotation(padded, weight, cyclic(2), 0.4), alone, atol=1e-9, rtol=0)
