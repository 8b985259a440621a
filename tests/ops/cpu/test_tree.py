"""The k-d tree: order, boxes, and the distance that prunes."""

import numpy as np
import pytest

from pnet.ops.cpu.tree import LEAF, box_distance, build_tree


def nodes_of(tree):
    """(node, its part of the order, whether it is a leaf)."""
    inner = len(tree.start) // 2
    return [(i, slice(tree.start[i], tree.stop[i]), i >= inner) for i in range(len(tree.start))]


def test_a_tree_of_any_cloud_is_sound(clouds):
    points = clouds[0].numpy()
    tree = build_tree(points)
    assert sorted(tree.number.tolist()) == list(range(len(points)))  # every point once
    np.testing.assert_array_equal(tree.place, points[tree.number])
    assert tree.place.dtype == tree.low.dtype == tree.high.dtype == points.dtype
    for node, part, leaf in nodes_of(tree):
        size = part.stop - part.start
        assert size >= 1
        np.testing.assert_array_equal(tree.low[node], tree.place[part].min(0))
        np.testing.assert_array_equal(tree.high[node], tree.place[part].max(0))
        assert tree.first[node] == tree.number[part].min()
        if leaf:
            assert size <= LEAF
        else:
            left, right = 2 * node + 1, 2 * node + 2
            assert tree.start[left] == part.start and tree.stop[right] == part.stop
            assert tree.stop[left] == tree.start[right] == part.start + size // 2


def test_children_are_halves_along_the_longest_side(clouds):
    tree = build_tree(clouds[0].numpy())
    for node, _, leaf in nodes_of(tree):
        if not leaf:
            axis = int((tree.high[node] - tree.low[node]).argmax())
            assert tree.high[2 * node + 1, axis] <= tree.low[2 * node + 2, axis]


@pytest.mark.parametrize("n", [1, 2, LEAF - 1, LEAF, LEAF + 1, 2 * LEAF, 2 * LEAF + 1, 100, 1000])
def test_a_tree_has_the_shape_that_its_size_says(n):
    points = np.random.default_rng(n).random((n, 3))
    tree = build_tree(points)
    leaves = 1
    while leaves * LEAF < n:
        leaves *= 2
    assert len(tree.start) == len(tree.low) == 2 * leaves - 1
    sizes = [part.stop - part.start for _, part, leaf in nodes_of(tree) if leaf]
    assert sum(sizes) == n and max(sizes) <= LEAF and max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("leaf", [4, 30])
def test_the_size_of_a_leaf_can_be_chosen(leaf):
    tree = build_tree(np.random.default_rng(0).random((200, 3)), leaf)
    sizes = [part.stop - part.start for _, part, is_leaf in nodes_of(tree) if is_leaf]
    assert leaf / 2 <= min(sizes) and max(sizes) <= leaf


def test_the_cloud_itself_is_left_alone():
    points = np.random.default_rng(0).random((100, 3))
    before = points.copy()
    build_tree(points)
    np.testing.assert_array_equal(points, before)


@pytest.mark.parametrize("order", ["random", "rising", "falling", "organ pipe"])
def test_sorted_clouds_are_halved_too(order):
    x = np.arange(400.0)
    x = {"random": x, "rising": x, "falling": x[::-1], "organ pipe": np.minimum(x, x[::-1])}[order]
    x = np.random.default_rng(0).permutation(x) if order == "random" else x
    tree = build_tree(np.stack([x, 0 * x, 0 * x], 1))
    middle = tree.stop[1]
    np.testing.assert_array_equal(np.sort(tree.place[:middle, 0]), np.sort(x)[:200])
    assert middle == 200


def test_the_distance_to_a_box_by_hand():
    low, high = np.array([[0.0, 0, 0]]), np.array([[1.0, 2, 3]])
    assert box_distance(low, high, 0, 0.5, 1.0, 3.0) == 0
    assert box_distance(low, high, 0, -2.0, 1.0, 1.0) == 4
    assert box_distance(low, high, 0, 2.0, 4.0, 6.0) == 1 + 4 + 9


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_distance_to_a_box_is_never_above_that_to_a_point_in_it(dtype):
    rng = np.random.default_rng(0)
    points = (rng.integers(0, 9, (300, 3)) * 0.1234567).astype(dtype)
    tree = build_tree(points)
    for x, y, z in (rng.integers(-3, 12, (40, 3)) * 0.1234567).astype(dtype):
        d = tree.place - np.array([x, y, z], dtype)
        square = d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]
        for node, part, _ in nodes_of(tree):
            gap = box_distance(tree.low, tree.high, node, x, y, z)
            assert gap <= square[part].min()
            corner = np.clip(np.array([x, y, z]), tree.low[node], tree.high[node]) - np.array([x, y, z])
            assert gap == pytest.approx((corner.astype(float) ** 2).sum(), rel=1e-6)
