"""The symmetry-aware pose distance: its invariants, and what it means on the surface."""

import math

import pytest
import roma
import torch

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.rigid import apply_pose
from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    cyclic,
    dihedral,
    rotation_about_z,
)

SYMMETRIES = {
    "none": cyclic(1),
    "cyclic": cyclic(3),
    "dihedral": dihedral(6),
    "revolution": RevolutionSymmetry(),
    "rotoreflection": RevolutionSymmetry(rotoreflection=True),
    "sphere": SphericalSymmetry(),
}
HALF_TURN = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))


@pytest.fixture(autouse=True)
def seed():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


@pytest.fixture(params=SYMMETRIES.values(), ids=SYMMETRIES.keys())
def space(request):
    return body(request.param)


def body(symmetry) -> PoseSpace:
    """A body of about 2 cm; the surface centroid and the inertial axes are not the body frame's."""
    frame_R, frame_t = roma.random_rotmat(dtype=torch.float64), 0.01 * torch.randn(3).double()
    scale = torch.tensor(0.02, dtype=torch.float64)
    if isinstance(symmetry, FiniteSymmetry):
        # Λ commutes with turns about z
        third = 0.01 if len(symmetry.rotations) > 1 else 0.015
        scale = torch.diag(torch.tensor([0.01, third, 0.02], dtype=torch.float64))
    else:
        frame_R[:] = torch.eye(3)
        frame_t[:2] = 0  # a symmetry axis goes through the centroid
    if isinstance(symmetry, SphericalSymmetry):
        frame_t[:] = 0
    return PoseSpace(symmetry, scale, frame_R, frame_t, 0.004)


def symmetry_poses(space: PoseSpace) -> tuple[torch.Tensor, torch.Tensor]:
    """Rigid motions of the body frame that leave the body as it is: R (g, 3, 3), t (g, 3)."""
    turns = rotation_about_z(torch.rand(8).double() * 2 * math.pi)
    match space.symmetry:
        case FiniteSymmetry(rotations=G):
            R = space.frame_R.T @ G @ space.frame_R
        case RevolutionSymmetry(rotoreflection=reflected):
            R = torch.cat([turns, turns @ HALF_TURN]) if reflected else turns
        case _:
            R = roma.random_rotmat(8, dtype=torch.float64)
    return R, space.centre - R @ space.centre


def random_poses(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    return roma.random_rotmat(n, dtype=torch.float64), 0.02 * torch.randn(n, 3).double()


def test_the_centre_is_carried_to_the_inertial_origin(space):
    carried = apply_pose(space.frame_R, space.frame_t, space.centre[None])
    torch.testing.assert_close(carried, torch.zeros(1, 3).double(), atol=1e-15, rtol=0)


def test_the_shapes_of_the_representatives(space):
    shape = space.representatives(*random_poses(5)).shape
    match space.symmetry:
        case FiniteSymmetry(rotations=G):
            assert shape == (5, len(G), 12)
        case RevolutionSymmetry(rotoreflection=reflected):
            assert shape == (5, 2 if reflected else 1, 6)
        case _:
            assert shape == (5, 1, 3)


def test_symmetry_elements_on_the_right_are_no_distance(space):
    R, t = random_poses(1)
    R_turn, t_turn = symmetry_poses(space)
    turned = R @ R_turn, t + t_turn @ R[0].T
    assert space.distance(R, t, *turned).max() < 1e-12


def test_the_distance_is_invariant_under_symmetry_elements_on_either_side(space):
    (R, t), (Rb, tb) = random_poses(1), random_poses(1)
    R_turn, t_turn = symmetry_poses(space)
    turned = R @ R_turn, t + t_turn @ R[0].T
    expected = space.distance(R, t, Rb, tb).expand(len(R_turn))
    torch.testing.assert_close(space.distance(*turned, Rb, tb), expected)
    torch.testing.assert_close(space.distance(Rb, tb, *turned), expected)


def test_the_distance_is_invariant_under_rigid_motions_of_the_common_frame(space):
    (Ra, ta), (Rb, tb), (Q, q) = random_poses(20), random_poses(20), random_poses(20)
    moved = [(Q @ R, (Q @ t[..., None])[..., 0] + q) for R, t in ((Ra, ta), (Rb, tb))]
    torch.testing.assert_close(space.distance(*moved[0], *moved[1]), space.distance(Ra, ta, Rb, tb))


def test_a_translation_is_its_length(space):
    R, t = random_poses(20)
    move = 0.05 * torch.randn(20, 3).double()
    torch.testing.assert_close(space.distance(R, t, R, t + move), move.norm(dim=1))


def test_the_distance_is_symmetric_and_zero_to_itself(space):
    a, b = random_poses(20), random_poses(20)
    torch.testing.assert_close(space.distance(*a, *b), space.distance(*b, *a))
    assert space.distance(*a, *a).max() == 0


def test_the_triangle_inequality(space):
    a, b, c = random_poses(500), random_poses(500), random_poses(500)
    detour = space.distance(*a, *b) + space.distance(*b, *c)
    assert (space.distance(*a, *c) <= detour + 1e-12).all()


def test_pairwise_distance_is_the_distance_of_every_pair(space):
    a, b = random_poses(5), random_poses(7)
    pairwise = space.pairwise_distance(*a, *b)
    for i in range(5):
        for j in range(7):
            expected = space.distance(a[0][i], a[1][i], b[0][j], b[1][j])
            assert pairwise[i, j].item() == pytest.approx(expected.item(), abs=1e-14)


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 4), (4, 0)])
def test_pairwise_distance_of_empty_sets(space, n, m):
    assert space.pairwise_distance(*random_poses(n), *random_poses(m)).shape == (n, m)


# --- the meaning: root mean square displacement of the surface ------------------------------------


def surface_points(n: int = 200) -> torch.Tensor:
    """Points of a body without symmetry, (n, 3) metres."""
    stretch = torch.tensor([0.01, 0.02, 0.03], dtype=torch.float64)
    return torch.rand(n, 3).double() * stretch + 0.1


def space_of_points(points: torch.Tensor) -> PoseSpace:
    centre = points.mean(0)
    covariance = (points - centre).T @ (points - centre) / len(points)
    values, V = torch.linalg.eigh(covariance)
    V = V * torch.linalg.det(V).sign()
    return PoseSpace(cyclic(1), values.sqrt().diag(), V.T, -V.T @ centre, 0.01)


@pytest.mark.parametrize("radians", [1e-3, 0.1, 2.0])
def test_the_distance_is_the_rms_displacement_of_the_surface(radians):
    points = surface_points()
    (Ra, ta), n = random_poses(10), 10
    axis = torch.nn.functional.normalize(torch.randn(n, 3).double(), dim=1)
    Rb = roma.rotvec_to_rotmat(radians * axis) @ Ra
    tb = ta + 0.01 * torch.randn(n, 3).double()
    displacement = apply_pose(Ra, ta, points) - apply_pose(Rb, tb, points)
    rms = displacement.square().sum(-1).mean(-1).sqrt()
    torch.testing.assert_close(space_of_points(points).distance(Ra, ta, Rb, tb), rms)


def test_the_distance_of_a_revolution_is_the_rms_displacement_at_the_best_turn():
    # rings about z, with λ² = λ_r² + λ_z²
    angle = torch.arange(24).double() * (2 * math.pi / 24)
    rings = [(0.01, -0.02), (0.03, 0.005), (0.02, 0.015)]
    points = torch.cat([torch.stack([r * angle.cos(), r * angle.sin(), 0 * angle + z], -1) for r, z in rings])
    covariance = points.T @ points / len(points)
    scale = (covariance[0, 0] + covariance[2, 2]).sqrt()
    eye = torch.eye(3, dtype=torch.float64)
    space = PoseSpace(RevolutionSymmetry(), scale, eye, 0 * eye[0], 0.01)
    (Ra, ta), (Rb, tb) = random_poses(1), random_poses(1)
    turns = rotation_about_z(torch.linspace(0, 2 * math.pi, 20001).double())
    moved = apply_pose(Ra, ta, points) - apply_pose(Rb @ turns, tb, points)
    best = moved.square().sum(-1).mean(-1).sqrt().min()
    torch.testing.assert_close(space.distance(Ra, ta, Rb, tb)[0], best, rtol=1e-6, atol=0)
