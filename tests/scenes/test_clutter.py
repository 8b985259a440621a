"""Bodies scattered without physics."""

import numpy as np
import pytest

from pnet.scenes.clutter import scatter_bodies
from pnet.scenes.pile import Bin


def scatter(part, box, count, spacing=0.6, seed=0):
    return scatter_bodies(part, part.part_object("L", 0), box, count, spacing, np.random.default_rng(seed))


def bounding_radius(part) -> float:
    return float(np.linalg.norm(part.mesh(part.part_object("L", 0)).vertices, axis=1).max())


def test_every_body_lies_in_the_bin(part, box):
    pile = scatter(part, box, 40)
    vertices = part.mesh(part.part_object("L", 0)).vertices
    corners = np.einsum("dij,nj->dni", pile.R, vertices) + pile.t[:, None]
    half = np.array([box.width, box.depth]) / 2
    assert (np.abs(corners[..., :2]) <= half).all()
    assert corners[..., 2].min() >= 0 and pile.t[:, 2].max() <= box.height


def test_bodies_keep_their_distance(part, box):
    spacing, radius = 0.6, bounding_radius(part)
    t = scatter(part, box, 40, spacing).t
    gaps = np.linalg.norm(t[:, None] - t, axis=-1)[~np.eye(len(t), dtype=bool)]
    assert gaps.min() >= 2 * radius * spacing


def test_as_many_bodies_as_asked_where_there_is_room(part, box):
    pile = scatter(part, box, 10)
    assert len(pile.R) == len(pile.t) == pile.drop == 10
    assert pile.escaped == 0 and pile.settled


def test_bodies_without_room_are_left_out(tn34):
    radius = bounding_radius(tn34)
    pile = scatter(tn34, Bin(2 * radius, 2 * radius, 0.05), 20, spacing=2.0)
    assert len(pile.R) == 1 and pile.drop == 20


def test_orientations_are_rotations_and_uniform(tn34, box):
    """A uniform axis has mean 0 and covariance 1/3; 1,600 axes give that to three parts in a hundred."""
    R = np.concatenate([scatter(tn34, box, 40, spacing=0.1, seed=seed).R for seed in range(40)])
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    axes = R[:, :, 2]
    np.testing.assert_allclose(axes.mean(0), 0, atol=0.06)
    np.testing.assert_allclose(np.cov(axes.T), np.eye(3) / 3, atol=0.04)


def test_the_generator_alone_decides(tn34, box):
    first, again, other = (scatter(tn34, box, 10, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.R, again.R)
    np.testing.assert_array_equal(first.t, again.t)
    assert np.abs(first.t - other.t).max() > 1e-3


@pytest.mark.parametrize("count", [1, 60])
def test_more_bodies_lie_deeper(tn34, box, count):
    heights = scatter(tn34, box, count, spacing=0.1).t[:, 2]
    radius = bounding_radius(tn34)
    expected = min(box.height, 2 * radius * (1 + count * (2 * radius) ** 2 / (box.width * box.depth)))
    assert radius <= heights.min() and heights.max() <= expected
