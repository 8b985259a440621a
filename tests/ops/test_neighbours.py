"""Neighbour tables against loops and scipy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pnet.ops import neighbours
from pnet.ops.neighbours import ball_query, nearest, octants, three_nearest
from pnet.ops.operators import plain_operators


def random_clouds(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed))


def ball_query_naive(points: torch.Tensor, centres: torch.Tensor, radius: float, k: int) -> list[list[int]]:
    """One cloud, one centre at a time."""
    rows = []
    for centre in centres.double():
        distance = (points.double() - centre).norm(dim=-1)
        row = [i for i, d in enumerate(distance.tolist()) if d <= radius][:k]
        first = row[0] if row else int(distance.argmin())
        rows.append(row + [first] * (k - len(row)))
    return rows


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 60), st.integers(1, 10), st.integers(1, 20), st.floats(0.01, 1.0), st.integers(0, 10_000)
)
def test_a_ball_query_is_the_naive_loop(n, m, k, radius, seed):
    points, centres = random_clouds(2, n, seed=seed), random_clouds(2, m, seed=seed + 1)
    expected = [ball_query_naive(p, c, radius, k) for p, c in zip(points, centres, strict=True)]
    assert ball_query(points, centres, radius, k).tolist() == expected


def test_a_ball_query_agrees_with_a_tree():
    points, centres = random_clouds(1, 2000), random_clouds(1, 50, seed=1)
    found = ball_query(points, centres, 0.2, 2000)[0]
    inside = cKDTree(points[0].double().numpy()).query_ball_point(centres[0].double().numpy(), 0.2)
    assert [sorted(set(row.tolist())) for row in found] == [sorted(i) for i in inside]


def test_neighbours_come_in_index_order_and_are_padded_with_the_first():
    points = torch.tensor([[[5.0, 0, 0], [0.2, 0, 0], [9, 0, 0], [0.1, 0, 0], [0, 0, 0]]])
    assert ball_query(points, torch.zeros(1, 1, 3), 1.0, 5).tolist() == [[[1, 3, 4, 1, 1]]]
    assert ball_query(points, torch.zeros(1, 1, 3), 1.0, 2).tolist() == [[[1, 3]]]


def test_more_neighbours_than_points_are_padded():
    assert ball_query(torch.zeros(1, 2, 3), torch.zeros(1, 1, 3), 1.0, 4).tolist() == [[[0, 1, 0, 0]]]


def test_the_nearest_point_stands_in_where_the_ball_is_empty():
    points = torch.tensor([[[5.0, 0, 0], [3, 0, 0], [4, 0, 0]]])
    assert ball_query(points, torch.zeros(1, 1, 3), 1.0, 3).tolist() == [[[1, 1, 1]]]


def test_a_point_on_the_sphere_belongs_to_the_ball():
    points = torch.tensor([[[0.0, 0, 0], [0.5, 0, 0], [math.nextafter(0.5, 1) + 1e-7, 0, 0]]])
    assert ball_query(points, torch.zeros(1, 1, 3), 0.5, 3).tolist() == [[[0, 1, 0]]]


def test_the_three_nearest_agree_with_a_tree():
    points, known = random_clouds(3, 200), random_clouds(3, 40, seed=1)
    index, weight = three_nearest(points, known)
    assert index.dtype == torch.int64 and index.shape == weight.shape == (3, 200, 3)
    for b in range(3):
        distance, expected = cKDTree(known[b].double().numpy()).query(points[b].double().numpy(), k=3)
        np.testing.assert_array_equal(index[b], expected)
        inverse = 1 / (distance**2 + 1e-10)
        np.testing.assert_allclose(weight[b], inverse / inverse.sum(1, keepdims=True), rtol=1e-3)


def test_weights_fall_with_the_square_of_the_distance():
    known = torch.tensor([[[1.0, 0, 0], [0, 2, 0], [0, 0, 4], [9, 9, 9]]])
    index, weight = three_nearest(torch.zeros(1, 1, 3), known)
    assert index.tolist() == [[[0, 1, 2]]]
    assert weight[0, 0].tolist() == pytest.approx([16 / 21, 4 / 21, 1 / 21])


def test_a_point_on_a_known_one_takes_it_alone():
    known = random_clouds(1, 10)
    index, weight = three_nearest(known[:, 4:5], known)
    assert index[0, 0, 0] == 4
    assert weight[0, 0].tolist() == pytest.approx([1, 0, 0], abs=1e-6)


@pytest.mark.parametrize("m", [1, 2])
def test_fewer_than_three_known_points_give_fewer_columns(m):
    index, weight = three_nearest(random_clouds(2, 5), random_clouds(2, m, seed=1))
    assert index.shape == weight.shape == (2, 5, m)
    torch.testing.assert_close(weight.sum(-1), torch.ones(2, 5))


def test_coincident_known_points_give_finite_weights():
    _, weight = three_nearest(torch.zeros(1, 1, 3), torch.zeros(1, 3, 3))
    torch.testing.assert_close(weight[0, 0], torch.full((3,), 1 / 3))


@pytest.mark.parametrize("chunk", [1, 7, 100])
def test_chunks_do_not_change_the_tables(monkeypatch, chunk):
    points, centres = random_clouds(2, 50), random_clouds(2, 13, seed=1)

    def tables():
        with plain_operators():
            found = [ball_query(points, centres, 0.3, 8), *three_nearest(points, centres)]
            return [*found, octants(points, 0.3)]

    whole = tables()
    monkeypatch.setattr(neighbours, "CHUNK", chunk)
    assert all(torch.equal(a, b) for a, b in zip(whole, tables(), strict=True))


def agree(search, *args) -> None:
    """The kernel's tables are the reference's, to the bit."""
    found = search(*args)
    with plain_operators():
        expected = search(*args)
    found, expected = (t if isinstance(t, tuple) else (t,) for t in (found, expected))
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype and torch.equal(a, b)


def extent(points: torch.Tensor) -> float:
    """A length of the cloud's size, without the stray point; 1 metre for a single place."""
    return float(points[:, :400].double().std()) or 1.0


@pytest.mark.parametrize("reach", [1e-6, 0.3, 1000.0])
def test_a_ball_query_s_kernel_is_its_reference(clouds, reach):
    some = clouds[:, : max(1, clouds.shape[1] // 4)]
    for k in (1, 8, 40):
        agree(ball_query, clouds, some, reach * extent(clouds), k)
    agree(ball_query, some, clouds + 0.01, reach * extent(clouds), some.shape[1] + 3)


def test_a_nearest_s_kernel_is_its_reference(clouds):
    n = clouds.shape[1]
    for k in {1, min(3, n), min(20, n)}:
        agree(nearest, clouds, clouds[:, : n // 2 + 1], k)
        agree(nearest, clouds, clouds.flip(1)[:, :100] + 0.3, k)
    some = clouds[:, :50]
    agree(nearest, some, clouds[:, :70], some.shape[1])
    agree(three_nearest, clouds, some)


@pytest.mark.parametrize("reach", [1e-6, 0.3, 1000.0])
def test_an_octants_kernel_is_its_reference(clouds, reach):
    agree(octants, clouds, reach * extent(clouds))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@settings(max_examples=30, deadline=None)
@given(st.integers(1, 80), st.integers(1, 6), st.floats(1e-3, 1.0), st.integers(0, 10_000))
def test_ties_that_are_rounded_are_the_same_ties(dtype, n, width, step, seed):
    g = torch.Generator().manual_seed(seed)
    points = (torch.randint(0, width, (1, n, 3), generator=g) * step).to(dtype)
    # the radius is a distance between points, so that its square may be rounded as theirs is
    offset = (points[0, 0] - points[0, -1]).double()
    radius = float(offset.square().sum().sqrt()) or step
    agree(octants, points, radius)
    agree(ball_query, points, points, radius, 5)
    agree(nearest, points, points, min(5, n))


def test_a_point_on_the_sphere_belongs_to_its_octant_in_either_precision():
    # the square of this distance is rounded down in float32: a box must not be judged in more digits
    q = torch.tensor([0.49625658988952637, 0.7682217955589294, 0.08847743272781372])
    points = torch.cat([torch.zeros(12, 3), q.expand(12, 3)])[None]
    x, y, z = (q * q).tolist()
    square = (torch.tensor(x) + torch.tensor(y)) + torch.tensor(z)
    found = octants(points, float(square.double().sqrt()))
    assert found[0, 0].tolist() == [1, 0, 0, 0, 0, 0, 0, 12]


def octants_naive(points: np.ndarray, radius: float) -> list[list[int]]:
    """One cloud, one pair at a time."""
    rows = []
    for i, here in enumerate(points):
        row, gap = [i] * 8, [np.inf] * 8
        for j, there in enumerate(points):
            d = there - here
            octant = 4 * int(d[0] > 0) + 2 * int(d[1] > 0) + int(d[2] > 0)
            square = float(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
            if j != i and square <= radius**2 and square < gap[octant]:
                row[octant], gap[octant] = j, square
        rows.append(row)
    return rows


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 50), st.floats(0.01, 1.0), st.booleans(), st.integers(0, 10_000))
def test_octants_are_the_naive_loop(n, radius, ties, seed):
    points = random_clouds(2, n, seed=seed).double()
    if ties:
        points, radius = (4 * points).floor(), 2.0
    expected = [octants_naive(cloud.numpy(), radius) for cloud in points]
    assert octants(points, radius).tolist() == expected


def test_an_octant_is_named_by_the_signs_of_the_offset():
    corners = [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
    found = octants(torch.tensor([[[0.0, 0, 0], *corners]]), 2.0)
    assert found[0, 0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8]


def test_an_offset_of_zero_is_not_positive():
    found = octants(torch.tensor([[[0.0, 0, 0], [0, 0, 0.5], [0, 0, -0.5], [0.5, 0, 0]]]), 1.0)
    assert found[0, 0].tolist() == [2, 1, 0, 0, 3, 0, 0, 0]


def test_an_octant_without_a_neighbour_holds_the_point_itself():
    points = torch.tensor([[[0.0, 0, 0], [0.5, 0.5, 0.5], [5, 5, 5]]])
    assert octants(points, 1.0)[0].tolist() == [[0] * 7 + [1], [0] + [1] * 7, [2] * 8]


def test_the_radius_of_octants_is_inclusive():
    points = torch.tensor([[[0.0, 0, 0], [0.5, 0, 0]]])
    assert octants(points, 0.5)[0, 0].tolist() == [0, 0, 0, 0, 1, 0, 0, 0]
    assert octants(points, 0.4999999)[0, 0].tolist() == [0] * 8


def test_a_coincident_point_lies_in_the_octant_of_no_positive_offset():
    points = torch.zeros(1, 3, 3)
    assert octants(points, 1.0)[0].tolist() == [[1] + [0] * 7, [0] + [1] * 7, [0] + [2] * 7]


@pytest.mark.parametrize("axis, bit", [(0, 4), (1, 2), (2, 1)])
def test_octants_follow_the_axes(axis, bit):
    points = random_clouds(2, 600, seed=3)
    mirrored = points.clone()
    mirrored[..., axis] *= -1
    columns = [o ^ bit for o in range(8)]
    assert torch.equal(octants(mirrored, 0.2), octants(points, 0.2)[..., columns])


def test_swapped_axes_swap_the_octants():
    points = random_clouds(1, 400, seed=4)
    # x and z change places: the bits 4 and 1 do too
    columns = [(o & 1) << 2 | (o & 2) | o >> 2 for o in range(8)]
    assert torch.equal(octants(points.flip(-1), 0.2), octants(points, 0.2)[..., columns])


def test_a_rigid_motion_keeps_balls_and_nearest_points():
    points = random_clouds(2, 400, seed=5).double()
    moved = points @ torch.from_numpy(Rotation.random(random_state=0).as_matrix()) + 3.0
    assert torch.equal(ball_query(moved, moved, 0.2, 12), ball_query(points, points, 0.2, 12))
    index, square = nearest(points, points, 8)
    index_moved, square_moved = nearest(moved, moved, 8)
    assert torch.equal(index, index_moved)
    torch.testing.assert_close(square, square_moved, rtol=1e-9, atol=1e-12)


def test_a_translation_by_whole_steps_keeps_octants():
    points = torch.randint(0, 1000, (1, 500, 3), generator=torch.Generator().manual_seed(0)) / 1024
    assert torch.equal(octants(points + 8, 0.2), octants(points, 0.2))


@pytest.mark.parametrize("dtype, digits", [(torch.float32, 1e-4), (torch.float64, 1e-12)])
def test_the_nearest_agree_with_a_tree(dtype, digits):
    points, queries = random_clouds(2, 1500).to(dtype), random_clouds(2, 60, seed=1).to(dtype)
    index, square = nearest(points, queries, 7)
    assert index.dtype == torch.int64 and square.dtype == dtype
    for b in range(2):
        distance, expected = cKDTree(points[b].double().numpy()).query(queries[b].double().numpy(), k=7)
        np.testing.assert_array_equal(index[b], expected)
        np.testing.assert_allclose(square[b], distance**2, rtol=digits)


def test_equally_near_points_come_in_index_order():
    points = torch.tensor([[[0.0, 0, 1], [1, 0, 0], [0, 0, 0], [0, -1, 0], [0, 0, 0]]])
    index, square = nearest(points, torch.zeros(1, 1, 3), 5)
    assert index.tolist() == [[[2, 4, 0, 1, 3]]] and square.tolist() == [[[0, 0, 1, 1, 1]]]


def test_every_cloud_of_a_batch_is_searched_alone():
    points = random_clouds(3, 200, seed=6)
    for search in (
        lambda p: ball_query(p, p[:, :30], 0.3, 6),
        lambda p: nearest(p, p, 4)[0],
        lambda p: octants(p, 0.3),
    ):
        assert torch.equal(search(points), torch.cat([search(cloud[None]) for cloud in points]))
