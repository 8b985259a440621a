"""Poses registered onto a part's surface, and judged by what the camera saw past it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.postprocess.test_icp import displaced

from pnet.geometry.rigid import axis_angle_between, rotation_angle
from pnet.parts.base import ParametricPart
from pnet.postprocess.surface import Surface, sample_surface
from pnet.postprocess.surface_registration import STIFFNESS, TURN, FreeSpace, OwnPoints, misfit, register

SLACK = 0.002  # metres
EYE = torch.eye(3, dtype=torch.float64)


def rays(columns: int = 41, rows: int = 31, pitch: float = 1 / 600) -> torch.Tensor:
    """(rows · columns, 3) directions with z = 1, about the camera's axis."""
    x, y = (pitch * (torch.arange(n).double() - n // 2) for n in (columns, rows))
    v, u = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)], -1).flatten(0, 1)


def place(column: float, row: float, depth: float, pitch: float = 1 / 600) -> torch.Tensor:
    """At so many pixels from the axis."""
    return torch.tensor([column * pitch * depth, row * pitch * depth, depth], dtype=torch.float64)


def test_the_camera_sees_past_what_is_before_a_plane():
    """10 mm and 3 mm before it, within the slack, on it, behind it."""
    free = FreeSpace(0.6 * rays(), SLACK)
    places = torch.stack([place(5.2, -3.1, depth) for depth in (0.59, 0.597, 0.5985, 0.6, 0.65)])
    expected = torch.tensor([0.008, 0.001, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(free.through(places), expected, rtol=0, atol=1e-9)


def test_where_the_camera_saw_nothing_nothing_is_seen_through():
    """Beyond each border of the cloud, behind the camera's plane, and in a hole of the cloud."""
    directions = rays()
    hole = (600 * directions[:, :2]).abs().amax(1) < 8
    free = FreeSpace(0.6 * directions[~hole], SLACK)
    outside = [
        place(25, 0, 0.5),
        place(-25, 0, 0.5),
        place(0, 20, 0.5),
        place(0, -20, 0.5),
        place(300, 9, 0.5),
    ]
    inside_hole = [place(0, 0, 0.5), place(-3, 3, 0.5)]
    on_the_plane_of_the_lens = torch.tensor([[0.1, 0, 0], [0, 0, 0]], dtype=torch.float64)
    places = torch.cat([torch.stack(outside + inside_hole), on_the_plane_of_the_lens])
    assert free.through(places).tolist() == [0.0] * 9
    assert float(free.through(place(15, 0, 0.5))) == pytest.approx(0.098)  # beside the hole it does


def test_beside_an_edge_the_nearer_depth_counts():
    """A step from 0.6 to 0.7 m at column 0: a place at 0.65 m in the far half."""
    directions = rays()
    far = directions[:, 0] > 0.5 / 600
    free = FreeSpace((0.6 + 0.1 * far[:, None].double()) * directions, SLACK)
    assert float(free.through(place(1, 0, 0.65))) == 0
    assert float(free.through(place(5, 0, 0.65))) == pytest.approx(0.048)
    assert float(free.through(place(5, 0, 0.59))) == pytest.approx(0.108)
    assert float(free.through(place(-5, 0, 0.59))) == pytest.approx(0.008)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_never_is_less_than_nothing_seen_through_nor_more_than_the_farthest_depth_allows(seed):
    generator = torch.Generator().manual_seed(seed)
    depth = 0.5 + 0.2 * torch.rand(41 * 31, 1, generator=generator).double()
    places = torch.rand(500, 3, generator=generator).double() * torch.tensor([0.06, 0.06, 0.9])
    places = places - torch.tensor([0.03, 0.03, 0], dtype=torch.float64)
    through = FreeSpace(depth * rays(), SLACK).through(places)
    assert float(through.min()) == 0 < float(through.max())
    assert bool((through <= (0.7 - SLACK - places[:, 2]).clamp(min=0)).all())


def test_the_depth_is_that_of_the_points_around(tn34):
    """Against a loop over all points of a cloud of random depths: no more than the nearest of those within a
    cell, no less than that of those within two and a half."""
    generator = torch.Generator().manual_seed(0)
    directions = rays()
    depth = 0.5 + 0.2 * torch.rand(len(directions), generator=generator).double()
    free, pitch = FreeSpace(depth[:, None] * directions, slack=0.0), 1 / 600
    for column, row in ((0.3, 2.1), (-7.4, 11.2), (14.9, -9.0), (3.0, 3.0)):
        spot = place(column, row, 0.4)
        apart = (directions[:, :2] - spot[:2] / spot[2]).abs().amax(1) / pitch
        seen = 0.4 + float(free.through(spot))
        assert float(depth[apart < 2.51].min()) <= seen <= float(depth[apart < 1.24].min())


def test_a_cloud_of_one_point_is_borne():
    free = FreeSpace(place(3, 4, 0.6)[None], SLACK)
    through = free.through(torch.stack([place(3, 4, 0.59), place(3, 4, 0.61), place(6000, 0, 0.1)]))
    torch.testing.assert_close(through, torch.tensor([0.008, 0, 0], dtype=torch.float64), rtol=0, atol=1e-9)


def test_points_that_are_none_and_strays_do_not_matter():
    """NaN, infinity, the lens itself, one behind it; and one far to the side, whose direction is all but 90°
    off, makes the depths coarser and no more."""
    plane = 0.6 * rays()
    bad = torch.tensor([[math.nan, 0, 0.6], [0, 0, math.inf], [0, 0, 0], [0, 0, -0.6]], dtype=torch.float64)
    places = torch.stack([place(5, -3, depth) for depth in (0.59, 0.6, 0.65)])
    expected = torch.tensor([0.008, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(FreeSpace(torch.cat([plane, bad]), SLACK).through(places), expected)
    stray = torch.tensor([[1e3, -1e3, 0.001]], dtype=torch.float64)
    torch.testing.assert_close(FreeSpace(torch.cat([plane, stray]), SLACK).through(places), expected)
    for nothing in (bad, bad[:0]):
        assert FreeSpace(nothing, SLACK).through(places).tolist() == [0, 0, 0]


def visible(surface: Surface, R: torch.Tensor, t: torch.Tensor, count: int, seed: int = 0) -> torch.Tensor:
    """(count, 3) of the samples that look at the camera, camera frame; exact for a convex part."""
    ray = surface.points + (t @ R).numpy()
    facing = np.flatnonzero((ray * surface.normals).sum(1) < 0)
    chosen = np.random.default_rng(seed).choice(facing, count, replace=False)
    return torch.from_numpy(surface.points[chosen]) @ R.mT + t


def all_visible(surface: Surface, R: torch.Tensor, t: torch.Tensor, count: int) -> OwnPoints:
    points = [visible(surface, R[i], t[i], count, seed=i) for i in range(len(R))]
    return OwnPoints(torch.stack(points), torch.ones(len(R), count, dtype=torch.float64))


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
    R, t = random_poses(8, seed=1)
    surface, other = (sample_surface(any_part, middle(any_part), n) for n in (2000, 1500))
    guess_R, guess_t = displaced(R, t, 0.002, 5)
    found_R, found_t = register(surface, all_visible(other, R, t, 100), guess_R, guess_t, SLACK, 12)
    shift, turn = (found_t - t).norm(dim=1), rotation_angle(found_R, R)
    assert float(shift.median()) < 0.0003 and float(turn.median()) < math.radians(1)
    assert int((shift < 0.001).sum()) >= 7


def test_a_revolutions_axis_comes_back(tn34, random_poses):
    R, t = random_poses(8, seed=1)
    surface, other = (sample_surface(tn34, middle(tn34), n) for n in (2000, 1500))
    guess_R, guess_t = displaced(R, t, 0.002, 5)
    found_R, found_t = register(surface, all_visible(other, R, t, 100), guess_R, guess_t, SLACK, 12)
    shift, turn = (found_t - t).norm(dim=1), axis_angle_between(found_R[..., 2], R[..., 2])
    assert float(shift.median()) < 0.0001 and float(turn.median()) < math.radians(0.5)
    assert int((shift < 0.0005).sum()) >= 7  # the side of one alone is seen: it slides along its axis


def test_a_pose_that_is_right_stays(case):
    """Points that are samples themselves lie nowhere off the surface."""
    surface, _, R, t = case
    found_R, found_t = register(surface, all_visible(surface, R, t, 100), R, t, SLACK, 5)
    torch.testing.assert_close(found_R, R, rtol=0, atol=1e-6)
    torch.testing.assert_close(found_t, t, rtol=0, atol=1e-8)


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


def naive_step(surface, points, counted, R, t, slack):
    """One Gauss–Newton step of one pose (3, 3), (3,), row by row."""
    A, b, total = np.zeros((6, 6)), np.zeros(6), 1.0
    camera = -R.T @ t
    shown = [i for i, n in enumerate(surface.normals) if (camera - surface.points[i]) @ n > 0]
    for p, count in zip(points, counted, strict=True):
        x = R.T @ (p - t)
        near = min(shown, key=lambda i: float(np.linalg.norm(x - surface.points[i])))
        off, normal = x - surface.points[near], surface.normals[near]
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
def test_a_step_is_that_of_the_naive_twin(tn34, random_poses, shift, degrees, slack):
    R, t = random_poses(4)
    surface, other = (sample_surface(tn34, middle(tn34), n) for n in (300, 400))
    own = all_visible(other, R, t, 40)
    own.counted[1, 30:] = 0
    guess_R, guess_t = displaced(R, t, shift, degrees)
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
    padded = OwnPoints(torch.cat([own.points, garbage], 1), torch.cat([own.counted, 0 * garbage[..., 0]], 1))
    free = FreeSpace(own.points.flatten(0, 1), SLACK)
    found, again = (register(surface, points, *guess, SLACK, 5) for points in (own, padded))
    for a, b in zip(found, again, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-9)
    off, same = (misfit(surface, points, *found, SLACK, free, 1.0, 0.004) for points in (own, padded))
    torch.testing.assert_close(off, same, rtol=0, atol=1e-12)


def test_every_pose_is_registered_by_itself(case):
    surface, own, R, t = case
    guess_R, guess_t = displaced(R, t, 0.002, 5)
    index = torch.tensor([4, 1, 4])
    all_R, all_t = register(surface, own, guess_R, guess_t, SLACK, 5)
    some_R, some_t = register(surface, own.of(index), guess_R[index], guess_t[index], SLACK, 5)
    torch.testing.assert_close(some_R, all_R[index], rtol=0, atol=1e-9)
    torch.testing.assert_close(some_t, all_t[index], rtol=0, atol=1e-9)


def plate() -> Surface:
    """20 × 20 mm, 5 mm between samples, its front towards −z and its back towards +z."""
    x, y = np.meshgrid(np.arange(-0.01, 0.011, 0.005), np.arange(-0.01, 0.011, 0.005))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    normals = np.zeros_like(points)
    normals[:, 2] = -1
    return Surface(np.concatenate([points, points]), np.concatenate([normals, -normals]))


def wide_plane(depth: float) -> FreeSpace:
    return FreeSpace(depth * rays(101, 101), SLACK)


def test_the_misfit_by_hand():
    """Points 3 mm before a plate's samples, a fourth of them 9 mm, none counted as more than 4 mm; and the
    plate 10 mm before what was seen, which is 8 mm with the slack and 4 mm at most."""
    surface, t = plate(), torch.tensor([[0, 0, 0.6]], dtype=torch.float64)
    points = torch.from_numpy(surface.points[:4]) + t - torch.tensor([0, 0, 0.003], dtype=torch.float64)
    points[3, 2] -= 0.006
    own = OwnPoints(points[None], torch.ones(1, 4, dtype=torch.float64))

    def found(depth: float, share: float = 1.0, most: float = 0.004, own: OwnPoints = own) -> float:
        return float(misfit(surface, own, EYE[None], t, SLACK, wide_plane(depth), share, most))

    assert found(0.6) == pytest.approx((3 * 0.003 + 0.004) / 4)
    assert found(0.6, most=0.1) == pytest.approx((3 * 0.003 + 0.009) / 4)
    assert found(0.61, share=0.0) == pytest.approx(found(0.6))
    assert found(0.61, share=0.5) == pytest.approx(found(0.6) + 0.5 * 0.004)
    assert found(0.61, most=0.1) == pytest.approx(found(0.6, most=0.1) + 0.008)
    three = replace(own, counted=torch.tensor([[1.0, 1, 1, 0]], dtype=torch.float64))
    assert found(0.6, own=three) == pytest.approx(0.003)


def test_past_an_edge_the_distance_along_the_surface_counts_beyond_the_slack():
    """Points in the plate's plane 1, 5 and 9 mm past its edge, and one that is 5 mm past and 4 mm high."""
    places = [[0.011, 0, 0], [0.015, 0, 0], [0.0, -0.019, 0], [0.015, 0, -0.004]]
    points = torch.tensor(places, dtype=torch.float64)[None] + torch.tensor([0, 0, 0.6], dtype=torch.float64)
    t, free = torch.tensor([[0, 0, 0.6]], dtype=torch.float64), wide_plane(0.6)
    expected = [0, 0.003, 0.007, 0.005]  # less 2 mm; √(3² + 4²)
    for i, distance in enumerate(expected):
        own = OwnPoints(points[:, i : i + 1], torch.ones(1, 1, dtype=torch.float64))
        found = float(misfit(plate(), own, EYE[None], t, SLACK, free, 1.0, 0.1))
        assert found == pytest.approx(distance, abs=1e-12)


def test_what_a_pose_does_not_show_is_in_nobodys_way():
    """A plate that shows its front alone: the back, 20 mm nearer to the camera, is not asked."""
    surface = plate()
    back = surface.normals[:, 2] > 0
    thick = Surface(surface.points - 0.02 * back[:, None] * np.array([0, 0, 1.0]), surface.normals)
    t = torch.tensor([[0, 0, 0.6]], dtype=torch.float64)
    own = OwnPoints(torch.from_numpy(surface.points[:9])[None] + t, torch.ones(1, 9, dtype=torch.float64))
    assert float(misfit(thick, own, EYE[None], t, SLACK, wide_plane(0.6), 1.0, 0.1)) == pytest.approx(
        0, abs=1e-12
    )


def test_the_misfit_is_nearly_nothing_for_the_truth_and_grows_with_the_offset(case):
    surface, _, R, t = case
    own = all_visible(surface, R, t, 150)
    free = FreeSpace(own.points.flatten(0, 1), SLACK)
    offsets = (0.0, 0.001, 0.002, 0.003)
    off = torch.stack([misfit(surface, own, *displaced(R, t, x, 0), SLACK, free, 0.0, 0.1) for x in offsets])
    assert float(off[0].max()) < 1e-7  # another sample that is as near in single precision
    assert bool((off[1:] > off[:-1]).all())
    assert float(off[-1].max()) <= 0.003 + 1e-12  # a point's own sample is no farther than the shift


def test_a_body_that_reaches_into_free_space_is_punished(brick):
    """A brick 14 mm long, seen from above before a floor; one twice as long with one end in the same place
    explains its points as well, but the floor is seen where the rest of it would be."""
    short, long = (sample_surface(brick, (a, 0.016, 0.024), 3000) for a in (0.014, 0.028))
    t = torch.tensor([[0, 0, 0.6]], dtype=torch.float64)
    front = short.normals[:, 2] < -0.5
    points = torch.from_numpy(short.points[front][:200]) + t
    floor = 0.62 * rays(61, 61)
    under = (floor[:, :2].abs() < torch.tensor([0.009, 0.010], dtype=torch.float64)).all(1)  # with its shadow
    free = FreeSpace(torch.cat([points, floor[~under]]), SLACK)
    own = OwnPoints(points[None], torch.ones(1, 200, dtype=torch.float64))
    beside = t + torch.tensor([0.007, 0, 0], dtype=torch.float64)

    def found(share: float) -> tuple[float, float]:
        bodies = ((short, t), (long, beside))
        return tuple(float(misfit(body, own, EYE[None], at, SLACK, free, share, 0.1)) for body, at in bodies)

    truth, wrong = found(0.0)
    assert truth < 1e-9 and wrong < 0.001
    truth, wrong = found(1.0)
    assert truth < 0.001 and wrong > 0.008
