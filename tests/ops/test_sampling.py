"""Farthest point sampling against its plain twin and its invariants."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from pnet.ops.operators import plain_operators
from pnet.ops.sampling import farthest_point_order, farthest_points


def farthest_point_order_plain(points: np.ndarray, count: int, start: int = 0) -> np.ndarray:
    """The reference in place of the kernel."""
    with plain_operators():
        return farthest_point_order(points, count, start)


ORDERS = pytest.mark.parametrize("order", [farthest_point_order, farthest_point_order_plain])


def random_cloud(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((n, 3)).astype(np.float32)


def naive_order(points: np.ndarray, count: int, start: int) -> list[int]:
    """By the whole distance table, in double precision."""
    table, order = cdist(points, points), [start]
    while len(order) < count:
        order.append(int(table[order].min(0).argmax()))
    return order


@pytest.mark.parametrize("n", [2, 3, 10, 64, 65, 700, 5000])
def test_the_fast_order_is_the_plain_one(n):
    for seed in range(3):
        cloud, count = random_cloud(n, seed), min(n, 600)
        start = seed % n
        order = farthest_point_order(cloud, count, start)
        np.testing.assert_array_equal(order, farthest_point_order_plain(cloud, count, start))


@ORDERS
def test_both_are_the_naive_order_by_a_distance_table(order):
    cloud = random_cloud(300, seed=5)
    taken = order(cloud, 200)
    assert taken.tolist() == naive_order(cloud, 200, start=taken[0])


@ORDERS
def test_three_points_by_hand(order):
    cloud = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [2.9, 0, 0]])
    by_start = {0: [0, 2, 1, 3], 1: [1, 2, 0, 3], 2: [2, 0, 1, 3], 3: [3, 0, 1, 2]}
    for start, expected in by_start.items():
        assert order(cloud, 4, start).tolist() == expected


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 400), st.integers(1, 300), st.integers(0, 2**32 - 1))
def test_the_first_k_indices_are_the_k_point_sample(n, k, seed):
    cloud = random_cloud(n, seed)
    whole = farthest_point_order(cloud, 300)
    np.testing.assert_array_equal(farthest_point_order(cloud, k), whole[:k])


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 300), st.integers(1, 300), st.integers(0, 2**32 - 1))
def test_every_step_takes_a_farthest_point(n, count, seed):
    cloud = random_cloud(n, seed)
    order = farthest_point_order(cloud, min(n, count))
    assert len(set(order)) == len(order)
    nearest = np.minimum.accumulate(cdist(cloud[order], cloud), axis=0)
    steps = np.arange(1, len(order))
    np.testing.assert_allclose(nearest[steps - 1, order[1:]], nearest[:-1].max(1), rtol=1e-5)


@ORDERS
def test_fewer_points_than_asked_are_repeated_in_order(order):
    cloud = random_cloud(5)
    whole = order(cloud, 5).tolist()
    assert sorted(whole) == [0, 1, 2, 3, 4]
    assert order(cloud, 12).tolist() == whole + whole + whole[:2]


@ORDERS
def test_a_single_point_is_repeated(order):
    assert order(np.ones((1, 3), np.float32), 4).tolist() == [0, 0, 0, 0]


@ORDERS
def test_the_order_starts_where_it_is_told(order):
    cloud = random_cloud(50)
    assert order(cloud, 1).tolist() == [0]
    assert order(cloud, 3, 17)[0] == 17
    with pytest.raises(ValueError, match="from index 50 on"):
        order(cloud, 3, 50)


@ORDERS
@pytest.mark.parametrize("copies", [2, 30])
def test_every_distinct_point_comes_before_a_duplicate(order, copies):
    distinct = random_cloud(20, seed=1)
    taken = order(np.tile(distinct, (copies, 1)), 20) % 20
    assert sorted(taken) == list(range(20))


@ORDERS
def test_a_cloud_of_one_place_alone_is_sampled(order):
    taken = order(np.full((500, 3), 0.25, np.float32), 40)
    assert taken.tolist() == list(range(40))


def test_the_order_does_not_depend_on_where_the_array_lies_or_its_type():
    cloud = random_cloud(200)
    strided = np.repeat(cloud, 2, axis=0)[::2]
    assert not strided.flags.c_contiguous
    expected = farthest_point_order(cloud, 100)
    np.testing.assert_array_equal(farthest_point_order(strided, 100), expected)
    np.testing.assert_array_equal(farthest_point_order(cloud.astype(np.float64), 100), expected)
    assert expected.dtype == np.int64


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_coordinates_that_are_not_finite_are_refused(bad):
    cloud = random_cloud(10)
    cloud[7, 1] = bad
    with pytest.raises(ValueError, match="NaN or infinite"):
        farthest_point_order(cloud, 3)


def test_an_empty_cloud_is_refused():
    with pytest.raises(ValueError, match="at least one point"):
        farthest_point_order(np.zeros((0, 3)), 3)


def test_the_kernel_is_the_reference_on_any_cloud(clouds):
    n = clouds.shape[1]
    for count, start in ((1, 0), (min(n, 400), n // 2), (n + 7, n - 1)):
        taken = farthest_points(clouds, count, start)
        with plain_operators():
            assert torch.equal(taken, farthest_points(clouds, count, start))
        assert taken.shape == (len(clouds), count) and taken.dtype == torch.int64
        assert bool((taken[:, 0] == start).all())


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 120), st.integers(1, 6), st.booleans(), st.integers(0, 10_000))
def test_ties_go_to_the_smaller_index(n, width, double, seed):
    rng = np.random.default_rng(seed)
    cloud = 0.1 * rng.integers(0, width, (1, n, 3)) if double else rng.integers(0, width, (1, n, 3))
    points, start = torch.from_numpy(cloud).to(torch.float64 if double else torch.float32), seed % n
    taken = farthest_points(points, n, start)
    with plain_operators():
        assert torch.equal(taken, farthest_points(points, n, start))
    if not double:  # whole numbers have no rounding
        distinct = len(np.unique(cloud[0], axis=0))
        assert taken[0, :distinct].tolist() == naive_order(cloud[0], distinct, start)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_from_any_start_the_order_is_the_naive_one(dtype):
    points = torch.from_numpy(random_cloud(40, seed=9)).to(dtype)
    for start in range(40):
        taken = farthest_points(points[None], 40, start)[0].tolist()
        assert taken == naive_order(points.double().numpy(), 40, start) and sorted(taken) == list(range(40))


def test_duplicates_come_last():
    distinct = torch.from_numpy(random_cloud(30, seed=2))
    points = torch.cat([distinct, distinct[:10], distinct[:5]])[None]
    order = farthest_points(points, 45)[0].tolist()
    places = {tuple(points[0, i].tolist()) for i in order[:30]}
    assert len(places) == 30
    assert order[30:] == [i for i in range(45) if i not in order[:30]]  # all of them are at distance 0


def test_every_cloud_of_a_batch_is_sampled_alone():
    points = torch.from_numpy(np.stack([random_cloud(90, seed) for seed in range(4)]))
    expected = [farthest_points(cloud[None], 50, 7)[0] for cloud in points]
    assert torch.equal(farthest_points(points, 50, 7), torch.stack(expected))


def test_a_sample_of_more_than_all_points_repeats_each_cloud_s_own_order():
    points = torch.from_numpy(np.stack([random_cloud(6, seed) for seed in range(3)]))
    whole = farthest_points(points, 6)
    assert torch.equal(farthest_points(points, 15), torch.cat([whole, whole, whole[:, :3]], 1))
