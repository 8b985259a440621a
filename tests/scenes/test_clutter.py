"""Bodies scattered without physics."""

import numpy as np
import pytest

from pnet.scenes.clutter import Clutter
from pnet.scenes.overlap import ConvexPiece, penetration
from pnet.scenes.pile import Bin


def scatter(part, box, count, spacing=0.6, seed=0, **more):
    rng = np.random.default_rng(seed)
    return Clutter(spacing, **more).scatter(part, part.part_object("L", 0), box, count, rng)


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


def deepest_overlap(part, pile) -> float:
    """Over all pairs of bodies."""
    pieces = [ConvexPiece(p) for p in part.convex_pieces(part.part_object("L", 0), True)]
    poses = list(zip(pile.R, pile.t, strict=True))
    return max(penetration(pieces, *pose, poses[i + 1 :]) for i, pose in enumerate(poses[:-1]))


def test_no_two_bodies_overlap_where_they_must_not(part):
    """Bodies by the twenty in a bin so small that they touch, and overlap where they may."""
    dense = {"spacing": 0.3, "density": 4.0}
    free = scatter(part, Bin(0.06, 0.06, 0.1), 20, overlap=True, **dense)
    apart = scatter(part, Bin(0.06, 0.06, 0.1), 20, overlap=False, **dense)
    assert deepest_overlap(part, free) > 0.0005
    assert 6 <= len(apart.R) <= len(free.R) and deepest_overlap(part, apart) <= 0
    radius = bounding_radius(part)
    gaps = np.linalg.norm(apart.t[:, None] - apart.t, axis=-1)[~np.eye(len(apart.t), dtype=bool)]
    assert 0.6 * radius <= gaps.min() < 2 * radius  # nearer than bounding spheres would allow


def test_bodies_far_enough_apart_need_no_test_of_overlap(tn34, box):
    """With a spacing of one diameter the exact test changes nothing."""
    free, apart = (scatter(tn34, box, 15, spacing=1.0, overlap=overlap) for overlap in (True, False))
    np.testing.assert_array_equal(free.R, apart.R)
    np.testing.assert_array_equal(free.t, apart.t)


def layers(part, box, count, density=1.0) -> float:
    """The height up to which bodies are scattered: a layer of bounding spheres and as many as are needed."""
    radius = bounding_radius(part)
    return min(box.height, 2 * radius * (1 + count * (2 * radius) ** 2 / (box.width * box.depth * density)))


@pytest.mark.parametrize("count", [1, 60])
@pytest.mark.parametrize("density", [1.0, 2.0])
def test_more_bodies_lie_deeper_and_a_density_of_2_halves_that(tn34, box, count, density):
    heights = scatter(tn34, box, count, spacing=0.1, density=density).t[:, 2]
    top = layers(tn34, box, count, density)
    assert bounding_radius(tn34) <= heights.min() and heights.max() <= top
    if count == 60:
        assert heights.max() > 0.95 * top


def test_bodies_fill_the_bin_up_to_its_rim_at_most(tn34):
    low = Bin(0.06, 0.06, 0.05)
    heights = scatter(tn34, low, 40, spacing=0.1).t[:, 2]
    assert layers(tn34, low, 40) == 0.05 and 0.045 < heights.max() <= 0.05


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"spacing": -0.1}, "clutter.spacing is -0.1, expected at least 0"),
        ({"density": 0.0}, "clutter.density is 0.0, expected more than 0"),
        ({"density": -1.0}, "clutter.density is -1.0, expected more than 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Clutter(**settings)
