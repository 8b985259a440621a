"""Coverage of orientations: 1 for uniform ones, the analytic value for flat ones, equal for equivalents."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnet.geometry.symmetry import RevolutionSymmetry, SphericalSymmetry, cyclic, dihedral
from pnet.scenes.coverage import (
    direction_coverage,
    orientation_coverage,
    sphere_directions,
    viewing_directions,
)

ROUND, DISC = RevolutionSymmetry(), RevolutionSymmetry(rotoreflection=True)
SYMMETRIES = {
    "revolution": ROUND,
    "equal ends": DISC,
    "none": cyclic(1),
    "C2": cyclic(2),
    "D6": dihedral(6),
    "sphere": SphericalSymmetry(),
}


def seen_from(*directions) -> tuple[np.ndarray, np.ndarray]:
    """Upright bodies, R the identity, in the places from which the camera lies in these directions."""
    v = np.array(directions, float)
    return np.tile(np.eye(3), (len(v), 1, 1)), -0.6 * v / np.linalg.norm(v, axis=1, keepdims=True)


def random_poses(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.array([0, 0, 0.6]) + 0.05 * rng.normal(size=(count, 3))
    return Rotation.random(count, rng).as_matrix(), t


def uneven_poses(count: int) -> tuple[np.ndarray, np.ndarray]:
    _, t = random_poses(count)
    return Rotation.from_rotvec(0.5 * np.random.default_rng(2).normal(size=(count, 3))).as_matrix(), t


def test_the_viewing_direction_points_from_the_body_to_the_camera():
    R = Rotation.from_euler("x", [[180], [90]], degrees=True).as_matrix()
    t = np.array([[0, 0, 0.6], [0, 0, 0.5]])
    # upside down in front of the camera: seen from above; turned by 90 degrees: z lies in the image
    assert viewing_directions(R, t) == pytest.approx(np.array([[0, 0, 1], [0, -1, 0]]), abs=1e-12)


@pytest.mark.parametrize("name", SYMMETRIES)
def test_uniform_rotations_cover_everything(name):
    found = orientation_coverage(*random_poses(20_000), SYMMETRIES[name])
    assert found.instances == 20_000 and found.cells == {"revolution": 12, "equal ends": 12, "sphere": 1}.get(
        name, 96
    )
    assert 0.95 < found.share <= 1 and found.rare == 0


@pytest.mark.parametrize(
    ("name", "share", "rare"),
    [
        ("revolution", 1 / 12, 11 / 12),
        ("equal ends", 1 / 12, 11 / 12),
        ("none", 1 / 96, 95 / 96),
        ("C2", 1 / 96, 95 / 96),
        ("D6", 2 / 96, 94 / 96),  # both faces are one to the group, and count half each
        ("sphere", 1, 0),
    ],
)
def test_bodies_that_all_lie_flat_cover_one_direction(name, share, rare):
    found = orientation_coverage(*seen_from(*[(0, 0, 1)] * 1000), SYMMETRIES[name])
    assert (found.share, found.rare) == pytest.approx((share, rare))


def test_both_faces_of_a_flat_part_are_two_directions_unless_they_are_equal():
    poses = seen_from(*[(0, 0, 1), (0, 0, -1)] * 5000)
    assert orientation_coverage(*poses, ROUND).share == pytest.approx(2 / 12, rel=1e-3)
    assert orientation_coverage(*poses, DISC).share == pytest.approx(1 / 12)


def test_shares_of_the_sphere_count_by_their_area():
    # from the upper half alone: half the slices, and half the cells
    R, t = random_poses(20_000)
    v = viewing_directions(R, t)
    upper = v * np.where(v[:, 2:] < 0, -1, 1)
    assert direction_coverage(upper, ROUND).share == pytest.approx(0.5, abs=0.01)
    assert direction_coverage(upper, ROUND).rare == 0.5
    assert direction_coverage(upper, cyclic(1)).share == pytest.approx(0.5, abs=0.05)
    assert direction_coverage(upper, DISC).share > 0.99


@pytest.mark.parametrize("name", ["C2", "D6"])
def test_equivalent_rotations_count_the_same(name):
    symmetry = SYMMETRIES[name]
    R, t = uneven_poses(300)
    G = symmetry.rotations.numpy()
    turned = R @ G[np.random.default_rng(1).integers(0, len(G), len(R))]
    found = orientation_coverage(R, t, symmetry)
    assert orientation_coverage(turned, t, symmetry) == found and found.share < 0.7


@pytest.mark.parametrize("symmetry", [ROUND, DISC])
def test_turns_about_a_revolutions_axis_count_the_same(symmetry):
    R, t = uneven_poses(300)
    angles = np.random.default_rng(1).uniform(0, 2 * np.pi, 300)
    turned = R @ Rotation.from_euler("z", angles[:, None]).as_matrix()
    assert orientation_coverage(turned, t, symmetry) == orientation_coverage(R, t, symmetry)
    half = Rotation.from_euler("x", np.where(angles < np.pi, 0, np.pi)[:, None]).as_matrix()
    same = orientation_coverage(turned @ half, t, symmetry) == orientation_coverage(R, t, symmetry)
    assert same == symmetry.rotoreflection


@pytest.mark.parametrize("name", ["revolution", "none", "D6"])
def test_few_uniform_instances_are_not_taken_for_uneven_ones(name):
    symmetry = SYMMETRIES[name]
    group = len(symmetry.rotations) if name != "revolution" else 1
    cells = 12 if name == "revolution" else 96
    count = 4 * cells // group  # few for each cell that is its own
    shares = [orientation_coverage(*random_poses(count, seed), symmetry).share for seed in range(20)]
    assert np.mean(shares) == pytest.approx(0.97, abs=0.03)


def test_nothing_is_covered_by_nothing():
    found = orientation_coverage(np.zeros((0, 3, 3)), np.zeros((0, 3)), ROUND)
    assert found.instances == 0 and found.cells == 12
    assert math.isnan(found.share) and math.isnan(found.rare)


def test_what_is_not_finite_is_left_out():
    v = np.array([[0, 0, 1.0], [np.nan, 0, 1]])
    for symmetry in (ROUND, cyclic(1)):
        assert direction_coverage(v, symmetry).instances == 1


def test_the_cells_of_the_sphere_have_about_equal_areas():
    v = np.random.default_rng(0).normal(size=(100_000, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    cells = sphere_directions(96)
    area = np.bincount((v @ cells.T).argmax(1), minlength=96) / len(v) * 96
    assert np.allclose(np.linalg.norm(cells, axis=1), 1)
    assert area.min() > 0.8 and area.max() < 1.2
