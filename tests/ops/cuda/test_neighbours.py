"""Ball queries, nearest points and octants: the references' tables, to the bit."""

import pytest
import torch

from pnet.ops.cuda import nearest as nearest_kernels
from pnet.ops.cuda import neighbours as ball_kernels
from pnet.ops.cuda import octants as octant_kernels
from pnet.ops.neighbours import ball_query, nearest, octants
from pnet.ops.operators import plain_operators, squared

ON_CARD = torch.cuda.is_available()
# the interpreter takes its time
SOME, MANY = (None, 1000) if ON_CARD else (9, 15)  # points of an octant search
FEW = 60 if ON_CARD else 2  # centres of balls
REACHES = [1e-6, 0.4, 1000.0]


def extent(points):
    """A length of the cloud's size, without the stray point; 1 metre for a single place."""
    return float(points[:, :400].double().std()) or 1.0


def random(*shape, seed=0):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed))


def agree(found, reference, *args):
    """A kernel's tables are the reference's."""
    with plain_operators():
        expected = reference(*args)
    found, expected = (t if isinstance(t, tuple) else (t,) for t in (found, expected))
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype and torch.equal(a.cpu(), b)


def ball_agrees(here, points, centres, radius, k):
    found = ball_kernels.ball_query(here(points), here(centres), squared(radius, points), k)
    agree(found, ball_query, points, centres, radius, k)


def nearest_agrees(here, points, queries, k):
    agree(nearest_kernels.nearest(here(points), here(queries), k), nearest, points, queries, k)


def octants_agree(here, points, radius):
    agree(octant_kernels.octants(here(points), squared(radius, points)), octants, points, radius)


@pytest.fixture(params=["scan", "grid"])
def way(request, monkeypatch):
    """Ball queries in index order alone, and with the grid for what the first few points do not settle."""
    if request.param == "grid":
        monkeypatch.setattr(ball_kernels, "LARGE", 1)
        monkeypatch.setattr(ball_kernels, "FIRST", 8)


@pytest.mark.parametrize("reach", REACHES)
def test_a_ball_query_is_the_reference_s(here, clouds, way, reach):
    centres = torch.cat([clouds[:, :FEW], clouds[:, -1:] + 0.1], 1)
    ball_agrees(here, clouds[:, :100], centres, reach * extent(clouds), 6)


def test_a_ball_of_more_neighbours_than_points_repeats_the_first(here, clouds, way):
    ball_agrees(here, clouds[:, :6], clouds[:, :1], 0.5 * extent(clouds), 9)


@pytest.mark.parametrize("n", [127, 128, 129, 257])
def test_balls_in_clouds_of_sizes_around_a_block_s_border(here, way, n):
    points = random(3, n)
    ball_agrees(here, points, points[:, -3:], 0.4, 8)
    ball_agrees(here, points, points[:, :1] + 5, 0.1, 2)  # none is near: the nearest


def test_a_ball_keeps_more_neighbours_than_a_block_has_lanes(here, way):
    points = random(1, 400)
    ball_agrees(here, points, points[:, :2], 0.6, 200)


def test_of_equally_near_points_outside_the_ball_the_first_is_taken(here, way):
    points = torch.zeros(1, 300, 3)
    points[0, :, 0] = 1 + torch.arange(300) % 3
    points[0, :5] += 7
    ball_agrees(here, points, torch.zeros(1, 1, 3), 0.5, 3)


def test_a_smaller_number_in_a_later_cell_takes_the_place_of_the_largest(here, way):
    points = torch.zeros(1, 12, 3)
    points[0, :8] = -9.0
    points[0, 10, 2] = 0.9
    found = ball_kernels.ball_query(here(points), here(points[:, 8:9]), 1.0, 3)
    assert found.tolist() == [[[8, 9, 10]]]


def test_a_ball_query_with_too_many_neighbours_for_the_grid_goes_without(here, monkeypatch, way):
    monkeypatch.setattr(ball_kernels, "MOST", 4)
    points = random(2, 90)
    ball_agrees(here, points, points[:, :3], 0.2, 5)


def test_the_nearest_are_the_reference_s(here, clouds):
    some = clouds[:, :30]
    n = some.shape[1]
    nearest_agrees(here, some, clouds[:, -33:], min(3, n))
    nearest_agrees(here, some[:, -10:], some + 0.3, min(6, n))


@pytest.mark.parametrize("k", range(1, 10))
def test_any_number_of_nearest_is_the_reference_s(here, k):
    points = (4 * random(2, 9)).floor()
    nearest_agrees(here, points, points[:, :5], k)


@pytest.mark.parametrize("m", [63, 64, 65, 129])
@pytest.mark.parametrize("n", [3, 4, 5, 17])
def test_the_nearest_of_sizes_around_a_block_s_border(here, n, m):
    nearest_agrees(here, random(3, n), random(3, m, seed=1), 3)


def test_octants_of_small_buckets_are_the_reference_s(here, monkeypatch, clouds):
    monkeypatch.setattr(octant_kernels, "SIZE", 4)
    monkeypatch.setattr(octant_kernels, "GROUP", 2)
    octants_agree(here, clouds[:1, :SOME], 0.7 * extent(clouds))


@pytest.mark.parametrize("reach", REACHES)
def test_octants_within_any_radius(here, monkeypatch, reach):
    monkeypatch.setattr(octant_kernels, "SIZE", 4)
    points = random(2, 9)
    points[:, 5:7] = points[:, :2]
    octants_agree(here, points, reach)


@pytest.mark.parametrize("n", [7, 8, 9])
def test_octants_of_sizes_around_a_block_s_border(here, monkeypatch, n):
    monkeypatch.setattr(octant_kernels, "SIZE", 8)
    octants_agree(here, random(3, n), 0.4)


def test_octants_of_many_groups_of_buckets(here, monkeypatch):
    monkeypatch.setattr(octant_kernels, "SIZE", 1)
    monkeypatch.setattr(octant_kernels, "GROUP", 2)
    octants_agree(here, random(1, MANY), 0.4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_octants_of_a_bucket_of_a_warp(here, dtype):
    octants_agree(here, random(1, 20).to(dtype), 0.5)


def test_octants_of_points_too_far_apart_for_a_squared_distance_are_empty(here, monkeypatch):
    monkeypatch.setattr(octant_kernels, "SIZE", 2)
    points = random(1, 5)
    points[0, 2] += 1e25
    octants_agree(here, points, 1e30)
