"""Noise on stored scenes: new each time, labels untouched, lost points replaced."""

from dataclasses import replace

import numpy as np
import pytest

from pnet.data.noisy_scenes import NoisyScenes, add_noise
from pnet.scenes.noise import GaussianNoise, StructuredLightNoise


@pytest.fixture(scope="module")
def scene(make_scene, tn34):
    made = make_scene(tn34, bodies=3, points=300)
    incidence = np.full(300, 255, np.uint8)
    incidence[::3] = 0  # every third point lies on a surface seen along itself
    return replace(made, incidence=incidence, edge=np.full(300, 255, np.uint8))


def test_the_generator_alone_decides(scene):
    noise = GaussianNoise(0.001)
    first, again, other = (add_noise(scene, noise, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.points, again.points)
    assert np.abs(first.points - other.points).max() > 1e-4


def test_gaussian_noise_moves_points_along_their_rays_and_changes_no_label(scene):
    noisy = add_noise(scene, GaussianNoise(0.001), np.random.default_rng(0))
    ray = scene.points / scene.points[:, 2:]
    np.testing.assert_allclose(noisy.points / noisy.points[:, 2:], ray, atol=1e-6)
    shift = noisy.points[:, 2] - scene.points[:, 2]
    assert shift.std() == pytest.approx(0.001, rel=0.15)
    for name in ("instance", "R", "t", "parameters", "visibility", "occlusion", "incidence", "edge"):
        np.testing.assert_array_equal(getattr(noisy, name), getattr(scene, name))


def test_lost_points_are_replaced_by_the_first_that_are_left(scene):
    """Light that grazes the surface does not come back: two thirds are left, and come again."""
    noise = StructuredLightNoise(baseline=0.1, max_incidence_deg=80)
    noisy = add_noise(scene, noise, np.random.default_rng(0))
    left = np.arange(300) % 3 != 0
    rows = np.resize(np.flatnonzero(left), 300)
    np.testing.assert_allclose(noisy.points, scene.points[rows], atol=1e-6)
    np.testing.assert_array_equal(noisy.instance, scene.instance[rows])
    assert (noisy.incidence == 255).all() and len(noisy.edge) == 300


def test_a_scene_that_is_wholly_lost_is_named(scene):
    blind = StructuredLightNoise(baseline=0.1, dropout=1.0)
    with pytest.raises(ValueError, match=str(scene.id)):
        add_noise(scene, blind, np.random.default_rng(0))


def test_a_scene_that_does_not_know_its_incidence_is_refused(scene):
    with pytest.raises(ValueError, match=f"{scene.id}: noise needs the surface's incidence"):
        add_noise(replace(scene, incidence=None), GaussianNoise(0.001), np.random.default_rng(0))


def test_a_folder_of_scenes_stays_a_folder_of_scenes(scene):
    class Folder(list):
        ids, points_per_scene = (scene.id,), 300

    noisy = NoisyScenes(Folder([scene]), GaussianNoise(0.001))
    assert len(noisy) == 1 and noisy.ids == (scene.id,) and noisy.points_per_scene == 300
    drawn = noisy.draw(0, np.random.default_rng(5))
    expected = add_noise(scene, noisy.noise, np.random.default_rng(5))
    np.testing.assert_array_equal(drawn.points, expected.points)
