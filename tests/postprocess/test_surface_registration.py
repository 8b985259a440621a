"""Poses registered onto a part's surface, and judged by what the camera saw past it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.postprocess.test_icp import displaced

from pnet.geometry.rigid import axis_angle_between, rotation_angle
from pnet.parts.base import ParametricPart
from pnet.postprocess.surface import Surface, Triangles, sample_surface
from pnet.postprocess.surface_registration import (
    STIFFNESS,
    TURN,
    OwnPoints,
    Sight,
    misfit,
    register,
    seen_through,
)

SLACK = 0.002  # metres
FINE = 0.0002
EYE = torch.eye(3, dtype=torch.float64)
AHEAD = torch.tensor([[0, 0, 0.6]], dtype=torch.float64)


def tensor(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def only_points(points: torch.Tensor) -> OwnPoints:
    """(d, n, 3) that all count, and no rays besides."""
    d, n, _ = points.shape
    return OwnPoints(points, torch.ones(d, n).double(), points[:, :0], torch.full((d,), n).double())


def nothing_own(cloud: torch.Tensor, instances: int = 1) -> torch.Tensor:
    return torch.zeros(instances, len(cloud), dtype=torch.bool)


def test_rays_that_pass_near_an_instance_are_around_it():
    """20 mm about a place 0.6 m ahead; the kept ones in the cloud's order."""
    kept = [
        [0, 0, 0.66],  # straight behind it
        [0.019, 0, 0.6],  # beside it
        [0, -0.021, 0.66],  # farther beside it, but behind, so that the ray passes nearer
        [0, 0, 0.585],  # a little before it
    ]
    out = [
        [0, 0, 0.59],  # its own
        [0.021, 0, 0.6],  # too far beside it
        [0, -0.023, 0.66],
        [0, 0, 0.575],  # well before it
        [math.nan, 0, 0.66],
        [0, math.inf, 0.66],
        [0, 0, 0],
    ]
    cloud = tensor([out[0], kept[0], out[1], out[2], kept[1], *out[3:], kept[2], kept[3]])
    own = nothing_own(cloud)
    own[0, 0] = True
    assert Sight(cloud).around(AHEAD, own, 0.02).tolist() == [kept]
    own[0, 1] = True
    assert Sight(cloud).around(AHEAD, own, 0.02).tolist() == [kept[1:]]
    assert Sight(cloud).around(AHEAD, nothing_own(cloud), 0.02).tolist() == [[out[0], *kept]]


def test_where_an_instance_has_fewer_rays_there_are_zeros():
    """One with two, one with none, one with the same two less its own."""
    cloud = tensor([[0, 0, 0.66], [0, 0.01, 0.66]])
    t = torch.cat([AHEAD, AHEAD + tensor([0.1, 0, 0]), AHEAD])
    own = nothing_own(cloud, 3)
    own[2, 0] = True
    found = Sight(cloud).around(t, own, 0.02)
    zero = [0.0, 0, 0]
    assert found.tolist() == [cloud.tolist(), [zero, zero], [cloud[1].tolist(), zero]]
    assert Sight(cloud).around(t[1:2], own[1:2], 0.02).shape == (1, 0, 3)


@pytest.mark.parametrize("points", [0, 5])
def test_around_no_instance_there_is_nothing(points):
    cloud = torch.rand(points, 3).double()
    assert Sight(cloud).around(AHEAD[:0], nothing_own(cloud, 0), 0.02).shape == (0, 0, 3)
    assert Sight(cloud[:0]).around(AHEAD, nothing_own(cloud[:0]), 0.02).shape == (1, 0, 3)


@settings(max_examples=20, deadline=None)
@given(d=st.integers(1, 4), n=st.integers(1, 60), seed=st.integers(0, 10**6))
def test_rays_around_are_those_of_a_loop(d, n, seed):
    generator = torch.Generator().manual_seed(seed)
    spread = tensor([0.08, 0.08, 0.2])
    cloud, t = (spread * (torch.rand(m, 3, generator=generator).double() - 0.5) + AHEAD for m in (n, d))
    own = torch.rand(d, n, generator=generator) < 0.3
    found = Sight(cloud).around(t, own, 0.02)
    expected = []
    for place, mine in zip(t.numpy(), own, strict=True):
        rays = []
        for point in cloud[~mine].numpy():
            along = place @ point / np.linalg.norm(point)
            across = np.linalg.norm(np.cross(place, point)) / np.linalg.norm(point)
            if across < 0.02 and np.linalg.norm(point) > along - 0.02:
                rays.append(point.tolist())
        expected.append(rays)
    most = max(map(len, expected))
    assert found.tolist() == [rays + [[0.0, 0, 0]] * (most - len(rays)) for rays in expected]


def plate(both: bool = True) -> Surface:
    """20 × 20 mm, its front towards −z; with a back towards +z or not. Samples every 5 mm."""
    x, y = np.meshgrid(np.arange(-0.01, 0.011, 0.005), np.arange(-0.01, 0.011, 0.005))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    low, right, high, left = 0.01 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    front = np.array([[low, left, high], [low, high, right]])
    corners = np.concatenate([front, front[:, ::-1]]) if both else front
    down = np.array([[0, 0, -1.0]])
    normals = np.concatenate([down, down, -down, -down])[: len(corners)]
    samples = np.concatenate([points, points]) if both else points
    turned = np.concatenate([np.repeat(down, 25, 0), np.repeat(-down, 25, 0)])[: len(samples)]
    return Surface(samples, turned, Triangles(corners, normals))


def through(
    places, R: torch.Tensor = EYE, slack: float = SLACK, surface: Surface | None = None
) -> list[float]:
    """Of a plate 0.6 m ahead."""
    surface = plate() if surface is None else surface
    found = seen_through(surface, tensor([places]), R[None], AHEAD, slack)
    assert found.shape == (1, len(places))
    return found[0].tolist()


def test_a_ray_that_ends_behind_a_plate_has_gone_through_it():
    """By the way along the ray less the slack; straight ahead that is the difference in depth."""
    places = [[0, 0, 0.62], [0, 0, 0.6015], [0.003, -0.002, 0.62], [-0.006, 0.006, 0.7]]
    lengths = np.linalg.norm(places, axis=1)
    ways = lengths * (1 - 0.6 / np.array(places)[:, 2])
    assert through(places) == pytest.approx(np.maximum(ways - SLACK, 0).tolist(), abs=1e-12)
    assert through(places, slack=0.0005) == pytest.approx((ways - 0.0005).tolist(), abs=1e-12)
    assert through(places)[:2] == pytest.approx([0.018, 0], abs=1e-12)


def test_nothing_is_seen_through_a_plate_beside_the_ray_or_behind_what_was_seen():
    beside = [[0.011, 0, 0.62], [-0.011, 0, 0.62], [0, 0.011, 0.62], [0, -0.011, 0.62]]
    behind = [[0, 0, 0.599], [0.004, 0.003, 0.5]]
    assert through(beside + behind + [[0, 0, 0.6], [0, 0, 0]]) == [0] * 4 + [0] * 2 + [0, 0]
    # the same rays end 1 mm farther in where the plate is
    assert min(through([[0.01, 0, 0.62], [-0.01, 0, 0.62], [0, 0.01, 0.62], [0, -0.01, 0.62]])) > 0.017


def test_a_face_that_a_pose_does_not_show_stands_in_no_rays_way():
    """A plate without a back, turned away."""
    away = torch.from_numpy(Rotation.from_euler("x", 180, degrees=True).as_matrix())
    assert through([[0, 0, 0.62]], surface=plate(both=False)) == pytest.approx([0.018])
    assert through([[0, 0, 0.62]], away, surface=plate(both=False)) == [0]
    assert through([[0, 0, 0.62]], away) == pytest.approx([0.018])  # with its back


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_through_a_tilted_plate_goes_what_lies_behind_its_plane(seed):
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    places = rng.uniform([-0.02, -0.02, 0.55], [0.02, 0.02, 0.65], (40, 3))
    t, normal = AHEAD[0].numpy(), R[:, 2]
    share = (normal @ t) / (places @ normal)
    hit = (share[:, None] * places - t) @ R
    within, sure = np.abs(hit).max(1) < 0.01, np.abs(np.abs(hit).max(1) - 0.01) > 1e-9
    way = np.linalg.norm(places, axis=1) * (1 - share) - SLACK
    expected = np.where(within & (share > 0), np.maximum(way, 0), 0)
    found = np.array(through(places.tolist(), torch.from_numpy(R)))
    np.testing.assert_allclose(found[sure], expected[sure], rtol=0, atol=1e-9)


def test_poses_and_places_go_together():
    """Two poses of a plate, each with its own rays."""
    t = torch.cat([AHEAD, AHEAD + tensor([0, 0, 0.01])])
    others = tensor([[[0, 0, 0.62], [0.02, 0, 0.62]], [[0.02, 0, 0.62], [0, 0, 0.62]]])
    found = seen_through(plate(), others, EYE.expand(2, 3, 3), t, SLACK)
    torch.testing.assert_close(found, tensor([[0.018, 0], [0, 0.008]]), rtol=0, atol=1e-12)


def visible(surface: Surface, R: torch.Tensor, t: torch.Tensor, count: int, seed: int = 0) -> torch.Tensor:
    """(count, 3) of the samples that look at the camera, camera frame; exact for a convex part."""
    ray = surface.points + (t @ R).numpy()
    facing = np.flatnonzero((ray * surface.normals).sum(1) < 0)
    chosen = np.random.default_rng(seed).choice(facing, count, replace=False)
    return torch.from_numpy(surface.points[chosen]) @ R.mT + t


def all_visible(surface: Surface, R: torch.Tensor, t: torch.Tensor, count: int) -> OwnPoints:
    points = [visible(surface, R[i], t[i], count, seed=i) for i in range(len(R))]
    return only_points(torch.stack(points))


def middle(part: ParametricPart) -> tuple[float, ...]:
    return tuple(part.grids["L"].mean(0).tolist())


@pytest.fixture(scope="module")
def case(brick, random_poses):
    """Bricks of six poses, 150 exact points of each; these are not among the samples."""
    R, t = random_poses(6)
    surface, other = (sample_surface(brick, middle(brick), n) for n in (2000, 1500))
    return surface, all_visible(other, R, t, 150), R, t


@pytest.mark.parametrize("any_part", ["brick", "plug", "jack", "tn42", "tn06"], indirect=True)
def test_poses_of_a_finite_symmetry_come_back(any_part, random_poses):
    """Exactly, but for the jack, whose mesh is so fine that patches about samples stand for it."""
    R, t = random_poses(8, seed=1)
    surface, other = (sample_surface(any_part, middle(any_part), n) for n in (2000, 1500))
    own = all_visible(other, R, t, 100)
    near = register(surface, own, *displaced(R, t, 0.002, 5), 0.001, 8)
    found_R, found_t = register(surface, own, *near, FINE, 8)
    shift, turn = (found_t - t).norm(dim=1), rotation_angle(found_R, R)
    exact = any_part.name != "jack"
    assert (len(surface.triangles.corners) == len(surface.points)) == (not exact)
    assert float(shift.median()) < (1e-6 if exact else 1e-4) and float(turn.median()) < (
        1e-5 if exact else 0.01
    )
    assert float(shift.max()) < 0.0005
    assert not exact or int((shift < 1e-6).sum()) >= 7  # along one alone nothing holds it


def test_a_revolutions_axis_comes_back(tn34, random_poses):
    R, t = random_poses(8, seed=1)
    surface, other = (sample_surface(tn34, middle(tn34), n) for n in (100, 1500))
    found_R, found_t = register(surface, all_visible(other, R, t, 100), *displaced(R, t, 0.002, 5), FINE, 16)
    shift, turn = (found_t - t).norm(dim=1), axis_angle_between(found_R[..., 2], R[..., 2])
    assert float(shift.max()) < 1e-5 and float(turn.max()) < math.radians(0.02)


def test_a_pose_that_is_right_stays(case):
    """Exact points lie nowhere off the surface."""
    surface, own, R, t = case
    found_R, found_t = register(surface, own, R, t, SLACK, 5)
    torch.testing.assert_close(found_R, R, rtol=0, atol=1e-9)
    torch.testing.assert_close(found_t, t, rtol=0, atol=1e-11)


def test_no_step_leaves_poses_as_they_are(case):
    surface, own, R, t = case
    found_R, found_t = register(surface, own, R, t, SLACK, 0)
    torch.testing.assert_close(found_R, R, rtol=0, atol=1e-12)
    assert torch.equal(found_t, t)


def test_what_comes_out_is_a_rotation_however_far_off_the_start_is(case):
    surface, own, R, t = case
    for shift, degrees in ((0.002, 5), (0.02, 60), (0.1, 150)):
        guess = displaced(R, t, shift, degrees)
        found_R, found_t = register(surface, own, *guess, SLACK, 10)
        torch.testing.assert_close(found_R @ found_R.mT, EYE.expand(6, 3, 3), rtol=0, atol=1e-12)
        assert float(torch.linalg.det(found_R).min()) > 0 and bool(found_t.isfinite().all())


def test_one_step_turns_by_so_much_at_most(case):
    """Points turned by a third of a right angle and more; a few of these steps are cut short."""
    surface, own, R, t = case
    guess_R, guess_t = displaced(R, t, 0.0, 35)
    angle = rotation_angle(register(surface, own, guess_R, guess_t, 0.01, 1)[0], guess_R)
    assert float(angle.max()) == pytest.approx(TURN, abs=1e-9)


def nearest(corners: np.ndarray, normals: np.ndarray, camera: np.ndarray, x: np.ndarray):
    """The nearest place of what faces the camera, and the normal there; None where two faces are as near."""
    shown = ((camera - corners[:, 0]) * normals).sum(1) > 0
    if bool((corners == corners[:, :1]).all()):
        places = corners[shown, 0]
    else:  # in metres they are too small for trimesh
        places = (
            trimesh.triangles.closest_point(1000 * corners[shown], np.tile(1000 * x, (shown.sum(), 1))) / 1000
        )
    far = np.linalg.norm(places - x, axis=1)
    as_near = normals[shown][far < far.min() + 1e-9]
    return (places[far.argmin()], as_near[0]) if np.ptp(as_near, axis=0).max() < 1e-9 else None


def naive_step(surface, points, counted, R, t, slack):
    """One Gauss–Newton step of one pose (3, 3), (3,), row by row."""
    A, b, total = np.zeros((6, 6)), np.zeros(6), 1.0
    triangles, camera = surface.triangles, -R.T @ t
    for p, count in zip(points, counted, strict=True):
        if count == 0:
            continue
        x = R.T @ (p - t)
        place, normal = nearest(triangles.corners, triangles.normals, camera, x)
        off = x - place
        weight = count / (1 + (np.linalg.norm(off) / (2 * slack)) ** 2)
        along = off - (off @ normal) * normal
        past = np.linalg.norm(along) - slack
        rows = [(normal, off @ normal, weight)]
        if past > 0:
            rows.append((along / np.linalg.norm(along), past, weight / 2))
        for direction, length, w in rows:
            row = np.concatenate([np.cross(x, direction), direction])
            A += w * np.outer(row, row)
            b += w * length * row
        total += weight
    A += total * np.diag([STIFFNESS[0]] * 3 + [STIFFNESS[1]] * 3)
    step = -np.linalg.solve(A, b)
    step *= min(1, TURN / np.linalg.norm(step[:3]))
    # the same motion of the points, put together as 4 × 4 matrices: pose⁻¹ p ↦ motion pose⁻¹ p
    motion, pose = np.eye(4), np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
    pose[:3, :3], pose[:3, 3] = R, t
    moved = pose @ np.linalg.inv(motion)
    return moved[:3, :3], moved[:3, 3]


@pytest.mark.parametrize(
    ("shift", "degrees", "slack"), [(0.002, 5, 0.002), (0.006, 15, 0.0005), (0.004, 40, 0.01)]
)
@pytest.mark.parametrize("exact", [True, False], ids=["triangles", "samples"])
def test_a_step_is_that_of_the_naive_twin(tn34, random_poses, exact, shift, degrees, slack):
    """Points as near to one face as to another are left out: either may tell them their normal."""
    R, t = random_poses(4)
    surface, other = (sample_surface(tn34, middle(tn34), n) for n in (300, 400))
    if not exact:
        surface = replace(surface, exact=None)
    own = all_visible(other, R, t, 60)
    own.counted[1, 30:] = 0
    guess_R, guess_t = displaced(R, t, shift, degrees)
    triangles = surface.triangles
    for i in range(4):
        local = ((own.points[i] - guess_t[i]) @ guess_R[i]).numpy()
        camera = -(guess_t[i] @ guess_R[i]).numpy()
        for j, x in enumerate(local):
            own.counted[i, j] *= nearest(triangles.corners, triangles.normals, camera, x) is not None
    assert float(own.counted.sum(1).min()) >= 20
    found_R, found_t = register(surface, own, guess_R, guess_t, slack, 1)
    for i in range(4):
        given = (x[i].numpy() for x in (own.points, own.counted, guess_R, guess_t))
        expected_R, expected_t = naive_step(surface, *given, slack)
        np.testing.assert_allclose(found_R[i], expected_R, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found_t[i], expected_t, rtol=0, atol=1e-9)
    assert float((found_t - guess_t).norm(dim=1).min()) > 1e-4


def test_points_that_do_not_count_do_not_matter(case):
    surface, own, R, t = case
    guess = displaced(R, t, 0.002, 5)
    garbage = torch.rand(6, 40, 3, generator=torch.Generator().manual_seed(0)).double()
    points, counted = torch.cat([own.points, garbage], 1), torch.cat([own.counted, 0 * garbage[..., 0]], 1)
    padded = replace(own, points=points, counted=counted)
    found, again = (register(surface, points, *guess, SLACK, 5) for points in (own, padded))
    for a, b in zip(found, again, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)
    off, same = (misfit(surface, points, *found, SLACK, 1.0, 0.004) for points in (own, padded))
    torch.testing.assert_close(off, same, rtol=0, atol=1e-12)


def test_every_pose_is_registered_by_itself(case):
    surface, own, R, t = case
    guess_R, guess_t = displaced(R, t, 0.002, 5)
    index = torch.tensor([4, 1, 4])
    all_R, all_t = register(surface, own, guess_R, guess_t, SLACK, 5)
    some_R, some_t = register(surface, own.of(index), guess_R[index], guess_t[index], SLACK, 5)
    torch.testing.assert_close(some_R, all_R[index], rtol=0, atol=1e-9)
    torch.testing.assert_close(some_t, all_t[index], rtol=0, atol=1e-9)


def test_the_misfit_by_hand():
    """Points 3 mm before a plate, a fourth of them 9 mm, none counted as more than 4 mm; and one ray of three
    that ends 10 mm behind it, which is 8 mm with the slack and 4 mm at most; its points number eight."""
    points = torch.from_numpy(plate().points[:4]) + AHEAD - tensor([0, 0, 0.003])
    points[3, 2] -= 0.006
    alone = only_points(points[None])
    past = tensor([[[0, 0, 0.61], [0.02, 0, 0.61], [0, 0, 0]]])
    own = replace(alone, others=past, number=tensor([8]))

    def found(own: OwnPoints, share: float = 1.0, most: float = 0.004) -> float:
        return float(misfit(plate(), own, EYE[None], AHEAD, SLACK, share, most))

    assert found(alone) == pytest.approx((3 * 0.003 + 0.004) / 4)
    assert found(alone, most=0.1) == pytest.approx((3 * 0.003 + 0.009) / 4)
    assert found(own, share=0.0) == found(alone)
    assert found(own, share=0.5) == pytest.approx(found(alone) + 0.5 * 0.004 / 8)
    assert found(own, most=0.1) == pytest.approx(found(alone, most=0.1) + 0.008 / 8)
    assert found(replace(own, number=tensor([4]))) == pytest.approx(found(alone) + 0.004 / 4)
    three = replace(alone, counted=tensor([[1.0, 1, 1, 0]]))
    assert found(three) == pytest.approx(0.003)
    none = replace(alone, counted=tensor([[0.0] * 4]), number=tensor([0]))
    assert found(none) == 0


@pytest.mark.parametrize("surface", [plate(), replace(plate(), exact=None)], ids=["triangles", "samples"])
def test_past_an_edge_the_distance_along_the_surface_counts_beyond_the_slack(surface):
    """Points in the plate's plane 1, 5 and 9 mm past its edge, and one that is 5 mm past and 4 mm high."""
    places = [[0.011, 0, 0], [0.015, 0, 0], [0.0, -0.019, 0], [0.015, 0, -0.004]]
    points = tensor(places)[None] + AHEAD
    expected = [0, 0.003, 0.007, 0.005]  # less 2 mm; √(3² + 4²)
    for i, distance in enumerate(expected):
        own = only_points(points[:, i : i + 1])
        found = float(misfit(surface, own, EYE[None], AHEAD, SLACK, 1.0, 0.1))
        assert found == pytest.approx(distance, abs=1e-12)


def test_between_its_samples_a_surface_is_as_near_as_at_them():
    """A point 1 mm over the middle between four samples that lie 5 mm apart."""
    own = only_points(tensor([[[0.0025, 0.0025, -0.001]]]) + AHEAD)
    surface = plate()
    exact, sampled = (
        float(misfit(x, own, EYE[None], AHEAD, SLACK, 1.0, 0.1))
        for x in (surface, replace(surface, exact=None))
    )
    assert exact == pytest.approx(0.001, abs=1e-12)
    assert sampled == pytest.approx(math.hypot(0.001, 0.0025 * math.sqrt(2) - SLACK), abs=1e-12)


def test_no_point_is_laid_onto_what_a_pose_does_not_show():
    """A point 2 mm before the back of a block 10 mm thick, of which the front alone faces."""
    front, back = plate().triangles.corners[:2], plate().triangles.corners[2:] + np.array([0, 0, 0.01])
    block = Surface(
        plate().points, plate().normals, Triangles(np.concatenate([front, back]), plate().exact.normals)
    )
    own = only_points(AHEAD[None] + tensor([0, 0, 0.008]))
    assert float(misfit(block, own, EYE[None], AHEAD, SLACK, 1.0, 0.1)) == pytest.approx(0.008, abs=1e-12)


def test_the_misfit_is_nothing_for_the_truth_and_grows_with_the_offset(case):
    surface, own, R, t = case
    offsets = (0.0, 0.001, 0.002, 0.003)
    off = torch.stack([misfit(surface, own, *displaced(R, t, x, 0), 1e-9, 0.0, 0.1) for x in offsets])
    assert float(off[0].max()) < 1e-8  # the slack's
    assert bool((off[1:] > off[:-1]).all())
    assert float(off[-1].max()) <= 0.003 + 1e-12  # what is so near to where it was is no farther off


def rays(columns: int, rows: int, pitch: float = 1 / 600) -> torch.Tensor:
    """(rows · columns, 3) directions with z = 1, about the camera's axis."""
    x, y = (pitch * (torch.arange(n).double() - n // 2) for n in (columns, rows))
    v, u = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)], -1).flatten(0, 1)


def test_what_is_too_large_costs_the_share_of_rays_that_it_stands_in_the_way_of(brick):
    """A brick 14 mm long, seen from above before a floor; one twice as long with one end in the same place
    explains its points as well, but the floor is seen where the rest of it would be: by as many rays as pass
    the rest's front."""
    short, long = (sample_surface(brick, (a, 0.016, 0.024), 3000) for a in (0.014, 0.028))
    points = torch.from_numpy(short.points[short.normals[:, 2] < -0.5][:200]) + AHEAD
    floor = 0.62 * rays(61, 61)
    top = floor * (0.6 - 0.012) / 0.62  # where the rays pass the bricks' front
    hidden = (top[:, 0].abs() < 0.007) & (top[:, 1].abs() < 0.008)
    under = (top[:, 0] > -0.007) & (top[:, 0] < 0.021) & (top[:, 1].abs() < 0.008) & ~hidden
    cloud = torch.cat([points, floor[~hidden]])
    own = nothing_own(cloud)
    own[0, :200] = True
    rest = Sight(cloud).around(AHEAD, own, 0.04)
    beside = AHEAD + tensor([0.007, 0, 0])
    known = replace(only_points(points[None]), others=rest)

    def found(share: float, most: float = 0.001) -> tuple[float, float]:
        bodies = ((short, AHEAD), (long, beside))
        return tuple(float(misfit(body, known, EYE[None], at, FINE, share, most)) for body, at in bodies)

    assert found(0.0) == pytest.approx((0, 0), abs=1e-12)
    assert found(1.0)[0] == pytest.approx(0, abs=1e-12)
    assert 50 < int(under.sum()) < rest.shape[1]
    assert found(1.0)[1] == pytest.approx(0.001 * int(under.sum()) / 200, rel=0.05)
    assert found(3.0)[1] == pytest.approx(3 * found(1.0)[1])
    depths = seen_through(long, rest, EYE[None], beside, FINE)
    assert int((depths > 0).sum()) == pytest.approx(int(under.sum()), abs=3)
    assert float(depths.max()) == pytest.approx(0.032, abs=0.001)  # the floor from the front
