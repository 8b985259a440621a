"""Refinement by ICP: finds the pose again from single views, and leaves alone what it cannot better."""

import math
import sys

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from pnet.geometry.camera import Camera
from pnet.geometry.rigid import apply_inverse_pose, rotation_angle
from pnet.geometry.symmetry import nearest_equivalent
from pnet.postprocess.icp import MAX_TURN, IcpRefinement, _Target, residual
from pnet.postprocess.surface import sample_surface
from pnet.scenes.rendering import render_view

REFINE = IcpRefinement(model_points=2000, max_distance=0.005, iterations=30, min_points=20)
CAMERA = Camera(640, 512, 1500.0, 1500.0, 319.5, 255.5, near=0.3, far=1.0)
OBLIQUE = Rotation.from_euler("zyx", [0.4, 0.7, 2.4]).as_matrix()  # three sides of a box are in view


@pytest.fixture(scope="session")
def refine() -> IcpRefinement:
    pytest.importorskip("small_gicp", reason="needs the extra [icp]")
    return REFINE


def view(part, size, R, t, points, noise=0.0, seed=0):
    """(points, 3) of what the camera sees of one body, metres, noise on every coordinate."""
    rng = np.random.default_rng(seed)
    rendered = render_view(CAMERA, part.mesh(size.numpy()), R[None].numpy(), t[None].numpy())
    seen = CAMERA.depth_to_points(rendered.depth)[rendered.instance == 0]
    chosen = seen[rng.permutation(len(seen))[:points]]
    return torch.from_numpy(chosen + noise * rng.normal(size=chosen.shape))


def clusters(part, sizes, R, t, points=200, noise=0.0):
    """Every body seen alone: points (N, 3), owner (N,)."""
    views = [view(part, sizes[i], R[i], t[i], points, noise, seed=i) for i in range(len(R))]
    return torch.cat(views), torch.cat([torch.full((len(v),), i) for i, v in enumerate(views)])


def displaced(R, t, shift, degrees, seed=0):
    """Poses moved by so many metres and turned by so many degrees, in random directions."""
    rng = np.random.default_rng(seed)
    axis, way = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in rng.normal(size=(2, len(R), 3)))
    turn = torch.from_numpy(Rotation.from_rotvec(math.radians(degrees) * axis).as_matrix())
    return turn @ R, t + shift * torch.from_numpy(way)


def errors(part, sizes, R, t, found_R, found_t):
    """(d,) pose distance modulo the symmetry, metres."""
    spaces = {size: part.pose_space(np.array(size)) for size in map(tuple, sizes.tolist())}
    poses = zip(sizes.tolist(), R, t, found_R, found_t, strict=True)
    return torch.stack([spaces[tuple(size)].distance(*four) for size, *four in poses])


def surface_distance(part, size, R, t, points):
    """(n,) exact distance of points from the part's mesh: the nearest of all its triangles, metres."""
    triangles = 1000 * part.mesh(size.numpy()).triangles  # in metres they are too small for trimesh
    local = 1000 * apply_inverse_pose(R, t, points).numpy()
    n, f = len(local), len(triangles)
    nearest = trimesh.triangles.closest_point(np.tile(triangles, (n, 1, 1)), np.repeat(local, f, 0))
    return np.linalg.norm(nearest.reshape(n, f, 3) - local[:, None], axis=2).min(1) / 1000


@pytest.fixture(scope="module")
def case(part, random_poses, random_sizes):
    """Twelve bodies of three sizes, their views without noise and poses 2 mm and 5° off."""
    R, t = random_poses(12)
    t = t * torch.tensor([0.5, 0.5, 0]) + torch.tensor([0, 0, 0.65])
    sizes = random_sizes(part, 3).repeat(4, 1)
    return part, sizes, R, t, clusters(part, sizes, R, t), displaced(R, t, 0.002, 5)


@pytest.fixture(scope="module")
def one(brick):
    """A brick with three sides in view and its pose 2 mm and 4° off."""
    size = torch.from_numpy(brick.part_object("L", 0))[None]
    R, t = torch.from_numpy(OBLIQUE)[None], torch.tensor([[0.01, -0.02, 0.6]]).double()
    return brick, size, R, t, clusters(brick, size, R, t), displaced(R, t, 0.002, 4)


def test_three_sides_of_a_box_give_its_exact_pose_back(refine, one):
    part, sizes, R, t, (points, owner), guess = one
    found_R, found_t = refine(part, sizes, *guess, points, owner)
    assert float(errors(part, sizes, R, t, *guess)) > 0.002
    assert float(errors(part, sizes, R, t, found_R, found_t)) < 2e-5
    assert float((found_t - t).norm()) < 2e-5 and float(rotation_angle(found_R, R)) < 0.002
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(found_R[0] @ found_R[0].mT, eye, rtol=0, atol=1e-9)


def test_views_without_noise_give_the_pose_back(refine, case):
    part, sizes, R, t, (points, owner), guess = case
    before = errors(part, sizes, R, t, *guess)
    after = errors(part, sizes, R, t, *refine(part, sizes, *guess, points, owner))
    assert float(before.median()) > 0.0018
    assert float(after.median()) < 5e-5 and int((after < 0.0005).sum()) >= 10


def test_poses_are_better_for_most_under_noise(refine, case):
    part, sizes, R, t, _, guess = case
    points, owner = clusters(part, sizes, R, t, points=120, noise=0.0002)
    before = errors(part, sizes, R, t, *guess)
    after = errors(part, sizes, R, t, *refine(part, sizes, *guess, points, owner))
    assert int((after < before).sum()) >= 11
    assert float(after.median()) < 0.0003


def test_the_points_lie_on_the_exact_surface_then(refine, case):
    """Against all triangles of the mesh, which the module itself never asks."""
    part, sizes, _, _, (points, owner), guess = case
    found = refine(part, sizes, *guess, points, owner)
    before, after = (
        np.array([
            np.median(surface_distance(part, sizes[i], R[i], t[i], points[owner == i][:50])) for i in range(6)
        ])
        for R, t in (guess, found)
    )  # fmt: skip
    assert before.min() > 0.0001 and np.median(before) > 0.0007
    assert np.median(after) < 2e-5 and (after < 0.2 * before).all()


def test_the_residual_is_the_exact_distance_but_for_the_samples(one):
    part, sizes, R, t, (points, _), _ = one
    library = pytest.importorskip("small_gicp", reason="needs the extra [icp]")
    surface = sample_surface(part, tuple(sizes[0].tolist()), 2000).facing(R[0].numpy(), t[0].numpy())
    off = points + 0.001 * torch.from_numpy(np.random.default_rng(0).normal(size=points.shape))
    local = apply_inverse_pose(R[0], t[0], off).numpy()
    found = _Target(library, surface, 0.005).distances(local)
    exact = surface_distance(part, sizes[0], R[0], t[0], off)
    assert np.median(np.abs(found - exact)) < 1e-9 and abs(residual(found) - residual(exact)) < 5e-5


def test_the_residual_by_hand():
    assert residual(np.array([4.0, 3.0, 1.0, 2.0, 100.0])) == pytest.approx(math.sqrt(30 / 4))
    assert residual(np.array([2.0])) == 2.0


def test_strays_of_other_bodies_do_little_harm(refine, one):
    part, sizes, R, t, (points, owner), guess = one
    points = points.clone()
    points[::7] += 0.006 * torch.from_numpy(np.random.default_rng(0).normal(size=points[::7].shape))
    found_R, found_t = refine(part, sizes, *guess, points, owner)
    assert float(errors(part, sizes, R, t, found_R, found_t)) < 1e-4


def test_small_clusters_keep_their_pose_bit_for_bit(refine, case):
    part, sizes, _, _, (points, owner), guess = case
    few = torch.cat([torch.nonzero(owner == i)[: 19 + i % 2, 0] for i in range(12)])
    found_R, found_t = refine(part, sizes, *guess, points[few], owner[few])
    assert torch.equal(found_R[::2], guess[0][::2]) and torch.equal(found_t[::2], guess[1][::2])
    assert bool((found_t[1::2] != guess[1][1::2]).any(1).all())
    alone = IcpRefinement(2000, 0.005, 30, min_points=1)(part, sizes, *guess, points[::20], owner[::20])
    assert torch.equal(alone[0], guess[0])  # ten points are too few whatever min_points says


def test_clusters_without_points_keep_their_pose(refine, case):
    part, sizes, _, _, (points, owner), guess = case
    owner = torch.where(owner == 3, -1, owner)
    found_R, found_t = refine(part, sizes, *guess, points, owner)
    assert torch.equal(found_R[3], guess[0][3]) and torch.equal(found_t[3], guess[1][3])


def test_points_of_other_clusters_have_no_influence(refine, case):
    part, sizes, _, _, (points, owner), guess = case
    own = owner == 5
    other = points + 0.003 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    moved = torch.where(own[:, None], points, other)
    label = torch.where(own, 5, torch.where(owner < 9, -1, owner))
    first = refine(part, sizes, *guess, points, owner)
    second = refine(part, sizes, *guess, moved, label)
    assert torch.equal(first[0][5], second[0][5]) and torch.equal(first[1][5], second[1][5])


def test_every_run_gives_the_same(refine, case):
    part, sizes, _, _, (points, owner), guess = case
    first = refine(part, sizes, *guess, points, owner)
    sample_surface.cache_clear()
    second = refine(part, sizes, *guess, points, owner)
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])


def test_poses_are_carried_along_with_the_scene(refine, one):
    """The camera's own frame is of no account, once the same faces are in view: exact composition."""
    part, sizes, _, _, (points, owner), (R, t) = one
    turn = torch.from_numpy(Rotation.from_euler("z", 1.1).as_matrix())  # about the line of sight
    first_R, first_t = refine(part, sizes, R, t, points, owner)
    second_R, second_t = refine(part, sizes, turn @ R, t @ turn.mT, points @ turn.mT, owner)
    torch.testing.assert_close(second_R, turn @ first_R, rtol=0, atol=1e-6)
    torch.testing.assert_close(second_t, first_t @ turn.mT, rtol=0, atol=1e-8)


def test_no_pose_goes_farther_than_is_plausible(refine, case):
    part, sizes, R, t, (points, owner), _ = case
    for shift, degrees in ((0.004, 12), (0.006, 20), (0.01, 40)):
        guess_R, guess_t = displaced(R, t, shift, degrees, seed=1)
        found_R, found_t = refine(part, sizes, guess_R, guess_t, points, owner)
        assert float((found_t - guess_t).norm(dim=1).max()) <= refine.max_distance
        assert float(rotation_angle(found_R, guess_R).max()) <= MAX_TURN + 1e-9


def test_a_pose_that_a_registration_does_not_better_stays(refine, one):
    """The exact pose: samples for a surface can only lead away from it."""
    part, sizes, R, t, (points, owner), _ = one
    found_R, found_t = refine(part, sizes, R, t, points, owner)
    assert torch.equal(found_R, R) and torch.equal(found_t, t)


def test_a_revolution_is_not_turned_about_its_axis(refine, tn34, random_poses, random_sizes):
    R, t = random_poses(10, seed=3)
    sizes = random_sizes(tn34, 10)
    points, owner = clusters(tn34, sizes, R, t, noise=0.0005)
    guess_R, guess_t = displaced(R, t, 0.001, 3)
    found_R, _ = refine(tn34, sizes, guess_R, guess_t, points, owner)
    nearest = nearest_equivalent(found_R, guess_R, tn34.symmetry)
    torch.testing.assert_close(found_R, nearest, rtol=0, atol=1e-9)
    assert bool((found_R != guess_R).any(2).any(1).all())


@pytest.mark.parametrize("any_part", ["marble", "plug", "jack", "tn42"], indirect=True)
def test_parts_of_every_symmetry_are_refined(refine, any_part, random_poses, random_sizes):
    R, t = random_poses(6, seed=4)
    sizes = random_sizes(any_part, 2).repeat(3, 1)
    points, owner = clusters(any_part, sizes, R, t)
    guess = displaced(R, t, 0.002, 4)
    before = errors(any_part, sizes, R, t, *guess)
    after = errors(any_part, sizes, R, t, *refine(any_part, sizes, *guess, points, owner))
    assert float(after.median()) < 0.1 * float(before.median())


def test_bad_clusters_and_poses_stay_as_they_are(refine, one):
    """Far off, in one place, not numbers, and poses that are none: nothing raises, nothing becomes NaN."""
    part, size, _, _, (points, _), (R, t) = one
    nothing = torch.full_like(points, math.nan)
    cases = [points + 0.1, points[:1].expand_as(points), nothing, points.clone(), points.clone()]
    owner = torch.arange(len(cases)).repeat_interleave(len(points))
    guess_R, guess_t = R.repeat(len(cases), 1, 1), t.repeat(len(cases), 1)
    guess_t[3], guess_t[4] = math.nan, -math.inf
    found_R, found_t = refine(part, size.expand(len(cases), -1), guess_R, guess_t, torch.cat(cases), owner)
    assert bool(found_R.isfinite().all()) and bool(found_t[:3].isfinite().all())
    for i in (0, 2, 3, 4):
        assert torch.equal(found_R[i], guess_R[i])
    torch.testing.assert_close(found_t[[0, 2, 3, 4]], guess_t[[0, 2, 3, 4]], equal_nan=True, atol=0, rtol=0)


def test_points_that_are_not_numbers_are_passed_over(refine, one):
    part, size, _, _, (points, owner), guess = one
    with_gaps = torch.cat([points, torch.tensor([[math.nan, 0, 0.6], [0, math.inf, 0.6]]).double()])
    label = torch.cat([owner, torch.zeros(2, dtype=torch.int64)])
    first, second = refine(part, size, *guess, points, owner), refine(part, size, *guess, with_gaps, label)
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])


def test_instances_of_impossible_sizes_keep_their_pose(refine, tn06, random_poses):
    """A nut with a hole wider than itself, one of no height, one of endless size; the others are refined."""
    R, t = random_poses(5)
    good = torch.from_numpy(tn06.part_object("L", 0))
    bad = [(0.02, 0.01, 0.012), (0.003, -0.01, 0.012), (0.003, math.inf, 0.012)]
    sizes = torch.stack([good, *torch.tensor(bad).double(), good])
    points, owner = clusters(tn06, good.expand(5, -1), R, t)
    guess_R, guess_t = displaced(R, t, 0.002, 5)
    found_R, found_t = refine(tn06, sizes, guess_R, guess_t, points, owner)
    assert torch.equal(found_R[1:4], guess_R[1:4]) and torch.equal(found_t[1:4], guess_t[1:4])
    assert bool((found_t[[0, 4]] != guess_t[[0, 4]]).any(1).all())


def test_unknown_sizes_are_refused(one):
    part, size, _, _, (points, owner), guess = one
    with pytest.raises(ValueError, match="ICP needs the part's size: this method does not estimate it; use"):
        REFINE(part, torch.full_like(size, math.nan), *guess, points, owner)


def test_no_instance_gives_none(refine, tn34):
    empty = torch.zeros(0, 3, 3)
    sizes, points = torch.zeros(0, tn34.k), torch.rand(50, 3)
    R, t = refine(tn34, sizes, empty, empty[:, 0], points, torch.full((50,), -1))
    assert R.shape == (0, 3, 3) and t.shape == (0, 3) and R.dtype == t.dtype == torch.float64


def test_the_result_is_double_and_the_arguments_stay(refine, one):
    part, size, R, t, (points, owner), guess = one
    given = [x.float() for x in (size, *guess, points)]
    kept = [x.clone() for x in given]
    found_R, found_t = refine(part, *given, owner)
    assert found_R.dtype == found_t.dtype == torch.float64
    assert all(torch.equal(a, b) for a, b in zip(given, kept, strict=True))
    assert float(errors(part, size, R, t, found_R, found_t)) < 2e-5


def test_an_absent_library_is_named(one, monkeypatch):
    part, size, _, _, (points, owner), guess = one
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "pnet\[icp\]"'):
        REFINE(part, size, *guess, points, owner)
