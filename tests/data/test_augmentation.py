"""What augmentation does to points and poses."""

import numpy as np
import pytest
import torch

from pnet.data.augmentation import Augmentation, rotate_about_view_axis
from pnet.data.targets import point_labels
from pnet.parts.choice import KeypointChoice


def in_part_frame(scene):
    """Every point in the frame of its own body."""
    R, t = scene.R[scene.instance], scene.t[scene.instance]
    return np.einsum("nji,nj->ni", R, scene.points - t)


def test_a_quarter_turn_carries_x_to_y(part, make_scene):
    scene = make_scene(part)
    turned = rotate_about_view_axis(scene, np.pi / 2)
    x, y, z = scene.points.T
    np.testing.assert_allclose(turned.points, np.stack([-y, x, z], -1), atol=1e-7)
    np.testing.assert_allclose(
        turned.t, np.stack([-scene.t[:, 1], scene.t[:, 0], scene.t[:, 2]], -1), atol=1e-15
    )
    assert turned.points.dtype == np.float32


@pytest.mark.parametrize("angle", [0.3, 2.0, 5.5])
def test_points_turn_with_their_bodies(part, make_scene, angle):
    scene = make_scene(part)
    turned = rotate_about_view_axis(scene, angle)
    np.testing.assert_allclose(in_part_frame(turned), in_part_frame(scene), atol=2e-7)
    np.testing.assert_allclose(np.linalg.det(turned.R), 1, atol=1e-12)


def test_jitter_has_the_given_deviation_and_leaves_poses(tn34, make_scene):
    scene = make_scene(tn34, points=20000)
    noisy = Augmentation(rotate=False, jitter=0.0005)(scene, np.random.default_rng(0))
    noise = noisy.points - scene.points
    np.testing.assert_allclose(noise.std(0), 0.0005, rtol=0.03)
    np.testing.assert_allclose(noise.mean(0), 0, atol=2e-5)
    np.testing.assert_array_equal(noisy.R, scene.R)
    assert noisy.points.dtype == np.float32


def test_switched_off_it_changes_nothing(tn34, make_scene):
    scene = make_scene(tn34)
    assert Augmentation(rotate=False, jitter=0.0)(scene, np.random.default_rng(0)) is scene


def test_angles_reach_all_around(tn34, make_scene):
    scene, augment = make_scene(tn34, bodies=1), Augmentation()
    rng = np.random.default_rng(0)
    turned = [augment(scene, rng).t[0] for _ in range(200)]
    angles = np.arctan2(*np.transpose(turned)[1::-1])
    counts, _ = np.histogram(angles, 4, (-np.pi, np.pi))
    assert counts.min() > 30


def test_labels_are_those_of_the_changed_scene(part, make_scene):
    scene, choice = make_scene(part), KeypointChoice(direction=(0, 1, 0))
    angle = np.random.default_rng(7).uniform(0, 2 * np.pi)
    found = point_labels(Augmentation()(scene, np.random.default_rng(7)), part.chain, choice)
    expected = point_labels(rotate_about_view_axis(scene, angle), part.chain, choice)
    for name, value in expected.items():
        assert torch.equal(found[name], value), name
