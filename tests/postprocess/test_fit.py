"""The fit is exact for exact keypoints, whatever the rule, the direction and the pose."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import apply_pose, axis_angle_between, rotation_angle
from pnet.geometry.symmetry import FiniteSymmetry, dihedral
from pnet.parts.keypoints import Keypoint, KeypointChain, KeypointChoice, KeypointRule
from pnet.parts.orbits import pair_orbit
from pnet.postprocess.fit import fit_pose

CAMERA, CANONICAL = KeypointRule.CAMERA, KeypointRule.CANONICAL
CHOICES = [
    KeypointChoice(CANONICAL),
    KeypointChoice(CAMERA),
    KeypointChoice(CAMERA, (0, 1, 0)),
    KeypointChoice(CAMERA, (1, -0.5, 0.3)),
]
POSES = 500


def random_poses(n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    R = torch.from_numpy(Rotation.random(n, rng).as_matrix())
    return R, torch.from_numpy(rng.uniform([-0.1, -0.1, 0.4], [0.1, 0.1, 0.8], (n, 3)))


def random_sizes(part, n: int, seed: int = 0) -> torch.Tensor:
    """Valid parameters between those of the grid."""
    rng = np.random.default_rng(seed)
    grid = part.grids["L"]
    mix = rng.dirichlet(np.ones(3), n)
    return torch.from_numpy(np.einsum("nj,njk->nk", mix, grid[rng.integers(0, len(grid), (n, 3))]))


def error_modulo(symmetry, Ra: torch.Tensor, Rb: torch.Tensor) -> float:
    """Largest angle, radians, after the symmetry is taken out."""
    if isinstance(symmetry, FiniteSymmetry):
        each = rotation_angle(
            Ra[:, None] @ symmetry.rotations, Rb[:, None].expand(-1, len(symmetry.rotations), 3, 3)
        )
        return float(each.amin(1).max())
    return float(axis_angle_between(Ra[..., 2], Rb[..., 2]).max())


@pytest.mark.parametrize("choice", CHOICES)
def test_exact_keypoints_give_the_exact_pose(part, choice):
    R, t = random_poses(POSES)
    sizes = random_sizes(part, POSES)
    keypoints = apply_pose(R, t, part.chain.select(choice, sizes, R))
    found_R, found_t = fit_pose(part.chain, part.mirror, sizes, t, keypoints)
    assert error_modulo(part.symmetry, found_R, R) < 1e-6
    assert float((found_t - t).abs().max()) < 1e-9
    assert float((torch.linalg.det(found_R) - 1).abs().max()) < 1e-9


@pytest.mark.parametrize("degrees", [0, 1e-6, 90, 180])
def test_seen_along_its_axis_too(part, degrees):
    """Where the label's choice is a tie, the fit must not care which way it went."""
    R = torch.from_numpy(Rotation.from_euler("x", [degrees], degrees=True).as_matrix()).view(1, 3, 3)
    t, sizes = torch.tensor([[0.01, 0.02, 0.6]], dtype=torch.float64), random_sizes(part, 1)
    for choice in CHOICES:
        keypoints = apply_pose(R, t, part.chain.select(choice, sizes, R))
        found_R, found_t = fit_pose(part.chain, part.mirror, sizes, t, keypoints)
        assert error_modulo(part.symmetry, found_R, R) < 1e-6
        torch.testing.assert_close(found_t, t, rtol=0, atol=1e-9)


def test_noise_makes_an_error_of_its_own_size(part):
    R, t = random_poses(200)
    sizes = random_sizes(part, 200)
    keypoints = apply_pose(R, t, part.chain.select(CHOICES[1], sizes, R))
    torch.manual_seed(0)
    noise = 1e-5 * torch.randn(200, 4, 3, dtype=torch.float64)
    found_R, found_t = fit_pose(part.chain, part.mirror, sizes, t + noise[:, 0], keypoints + noise[:, 1:])
    assert float((found_t - t).abs().max()) < 4e-5
    assert math.degrees(error_modulo(part.symmetry, found_R, R)) < 1


BOX = KeypointChain(
    [
        Keypoint("x", "centroid", pair_orbit((1, 0, 0)), "a", 0.5),
        Keypoint("y", "centroid", pair_orbit((0, 1, 0)), "b", 0.5),
        Keypoint("z", "centroid", pair_orbit((0, 0, 1)), "c", 0.5),
    ],
    ("a", "b", "c"),
)
MIRROR = torch.diag(torch.tensor([1.0, 1, -1], dtype=torch.float64))


def test_a_box_needs_both_chiralities_and_the_better_one_is_taken():
    """Three faces, each the nearer of a pair: half of the eight choices are mirror images of the template."""
    R, t = random_poses(100)
    sizes = torch.tensor([0.01, 0.02, 0.03], dtype=torch.float64).expand(100, 3)
    local = BOX.select(CHOICES[1], sizes, R)
    keypoints = apply_pose(R, t, local)
    mirrored = torch.linalg.det(local) < 0
    assert 20 < int(mirrored.sum()) < 80
    found_R, found_t = fit_pose(BOX, MIRROR, sizes, t, keypoints)
    assert error_modulo(dihedral(2), found_R, R) < 1e-6
    torch.testing.assert_close(found_t, t, rtol=0, atol=1e-9)
    assert float((torch.linalg.det(found_R) - 1).abs().max()) < 1e-9
    without, _ = fit_pose(BOX, None, sizes, t, keypoints)
    assert error_modulo(dihedral(2), without[~mirrored], R[~mirrored]) < 1e-6
    assert math.degrees(error_modulo(dihedral(2), without[mirrored], R[mirrored])) > 10


def test_an_outlier_of_little_weight_does_not_move_the_pose(part):
    R, t = random_poses(50)
    sizes = random_sizes(part, 50)
    keypoints = apply_pose(R, t, part.chain.select(CHOICES[1], sizes, R))
    keypoints[:, -1] += torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    weight = torch.ones(50, 4, dtype=torch.float64)
    plain_R, _ = fit_pose(part.chain, part.mirror, sizes, t, keypoints, weight)
    weight[:, -1] = 1e-12
    found_R, found_t = fit_pose(part.chain, part.mirror, sizes, t, keypoints, weight)
    if isinstance(part.symmetry, FiniteSymmetry):  # hole and centroid hold the turn only up to the circle
        axis = axis_angle_between(found_R[..., 2], R[..., 2])
        axis = torch.minimum(axis, math.pi - axis)
        assert float(axis.max()) < 1e-5
    else:
        assert error_modulo(part.symmetry, found_R, R) < 1e-5
    assert float((found_t - t).abs().max()) < 1e-6
    assert error_modulo(part.symmetry, plain_R, R) > 0.05


def test_no_weight_is_equal_weights(part):
    R, t = random_poses(20)
    sizes = random_sizes(part, 20)
    torch.manual_seed(0)
    keypoints = apply_pose(R, t, part.chain.canonical(sizes)) + 1e-3 * torch.randn(
        20, 3, 3, dtype=torch.float64
    )
    plain = fit_pose(part.chain, part.mirror, sizes, t, keypoints)
    equal = fit_pose(
        part.chain, part.mirror, sizes, t, keypoints, torch.full((20, 4), 7.0, dtype=torch.float64)
    )
    torch.testing.assert_close(plain, equal)
