"""Neighbour tables against loops and scipy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from pnet.ops import neighbours
from pnet.ops.neighbours import ball_query, three_nearest


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
    whole = [ball_query(points, centres, 0.3, 8), *three_nearest(points, centres)]
    monkeypatch.setattr(neighbours, "CHUNK", chunk)
    parts = [ball_query(points, centres, 0.3, 8), *three_nearest(points, centres)]
    for a, b in zip(whole, parts, strict=True):
        assert torch.equal(a, b)
