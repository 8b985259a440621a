"""Farthest point sampling against its plain twin and its invariants."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from pnet.ops.operators import plain_operators
from pnet.ops.sampling import farthest_point_order


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
