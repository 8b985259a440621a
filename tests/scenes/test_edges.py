"""Distances to depth edges."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from pnet.scenes.edges import EDGE_REACH, FAR_FROM_EDGES, image_edges


def test_a_step_between_two_columns():
    depth = np.full((3, 8), 0.5)
    depth[:, 3:] = 0.51
    assert image_edges(depth, 0.005).tolist() == [[2, 1, 0, 0, 1, 2, 3, 4]] * 3


def test_a_step_between_two_rows():
    depth = np.full((5, 2), 0.5)
    depth[4:] = 0.51
    assert image_edges(depth, 0.005).T.tolist() == [[3, 2, 1, 0, 0]] * 2


def test_a_smaller_step_is_no_edge():
    depth = np.full((3, 8), 0.5)
    depth[:, 3:] = 0.504
    assert (image_edges(depth, 0.005) == FAR_FROM_EDGES).all()


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_a_pixel_without_depth_by_hand(nothing):
    depth = np.full((5, 5), 0.5)
    depth[2, 2] = nothing
    # the four beside it touch the edge; corners are √2 or √5, rounded down, from the nearest of them
    want = [[2, 1, 1, 1, 2], [1, 1, 0, 1, 1], [1, 0, 0, 0, 1], [1, 1, 0, 1, 1], [2, 1, 1, 1, 2]]
    assert image_edges(depth, 0.005).tolist() == want


def test_beyond_the_reach_there_is_no_distance():
    depth = np.full((1, 20), 0.5)
    depth[0, 0] = 0.0
    row = image_edges(depth, 0.005)[0]
    assert row[: EDGE_REACH + 2].tolist() == [0, *range(EDGE_REACH + 1)]
    assert (row[EDGE_REACH + 2 :] == FAR_FROM_EDGES).all()


def test_distances_are_euclidean():
    rng = np.random.default_rng(0)
    depth = np.full((60, 80), 0.5, np.float32)
    depth[rng.random(depth.shape) < 0.01] = 0.0
    edges = image_edges(depth, 0.005)
    exact = distance_transform_edt(edges > 0)
    assert edges.dtype == np.uint8
    assert (edges == np.where(exact > EDGE_REACH, FAR_FROM_EDGES, np.floor(exact))).all()
