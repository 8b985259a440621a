"""Images that are rendered again from a scene: equal to what the scene was sampled from."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pnet.data.export.background import Background, bin_depth
from pnet.data.export.depth_view import Imaging
from pnet.scenes.noise import GaussianNoise, StructuredLightNoise
from pnet.scenes.viewpoints import Viewpoints


class Slanted:
    """An error that depends on all that a sensor is told, without chance."""

    def __call__(self, points, incidence, edge, camera, rng):
        scale = 1 + 0.01 * incidence + 0.001 * np.minimum(edge, 5)
        return (points * scale[:, None]).astype(np.float32), edge >= 1


def cloud_of(depth, camera):
    seen = ~np.isnan(depth)
    return camera.depth_to_points(np.nan_to_num(depth))[seen], seen


@pytest.mark.parametrize("views", [Viewpoints(), Viewpoints((0.5, 0.8), (0.0, 50.0), turn=True)])
def test_a_scenes_points_are_pixels_of_its_image(part, make_set, views):
    for scene in make_set(part, drops=(3, 9), viewpoints=views):
        view = Imaging().view(scene, part.mesh(scene.parameters[0]))
        cloud, seen = cloud_of(view.exact, scene.camera)
        distance, nearest = cKDTree(cloud).query(scene.points.astype(float))
        assert distance.max() < 1e-6
        np.testing.assert_array_equal(view.instance[seen][nearest], scene.instance)
        np.testing.assert_array_equal(view.exact, view.measured)
        np.testing.assert_array_equal(seen, view.instance >= 0)


def test_its_counts_are_the_scenes_visibility_and_occlusion(flange, make_set):
    (scene,) = make_set(flange, drops=(8,))
    view = Imaging().view(scene, flange.mesh(scene.parameters[0]))
    np.testing.assert_array_equal(1 - view.visible / view.silhouette, scene.occlusion)
    np.testing.assert_array_equal(view.visible / view.visible.max(), scene.visibility)
    # one is cut off by the border, one outside
    assert 0 < scene.occlusion[0] < 1 and scene.occlusion[1] == 1 and view.silhouette[1] > 30


def test_the_sensor_is_told_the_same_as_when_the_scene_was_made(flange, make_set):
    """All pixels, since so many points were asked for; each stored point is a measured one and the other way
    round."""
    (scene,) = make_set(flange, noise=Slanted(), drops=(7,), points=3000)
    view = Imaging(Slanted()).view(scene, flange.mesh(scene.parameters[0]))
    measured, seen = cloud_of(view.measured, scene.camera)
    assert 100 < seen.sum() < (view.instance >= 0).sum()
    assert cKDTree(measured).query(scene.points)[0].max() < 1e-6
    assert cKDTree(scene.points).query(measured)[0].max() < 1e-6
    assert np.abs(view.measured - view.exact)[seen].max() > 0.005


def test_noise_depends_on_seed_and_scene_alone(flange, make_set):
    first, second = make_set(flange, drops=(5, 6))
    mesh = flange.mesh(first.parameters[0])
    sigma = 0.001

    def noisy(scene, seed):
        return Imaging(GaussianNoise(sigma), seed=seed).view(scene, mesh)

    view = noisy(first, 0)
    np.testing.assert_array_equal(view.measured, noisy(first, 0).measured)
    np.testing.assert_array_equal(view.exact, Imaging().view(first, mesh).exact)
    body = view.instance >= 0
    error = (view.measured - view.exact)[body]
    assert error.std() == pytest.approx(sigma, rel=0.1) and abs(error.mean()) < 3 * sigma / np.sqrt(
        body.sum()
    )
    assert (noisy(first, 1).measured[body] != view.measured[body]).mean() > 0.99
    renamed = replace(first, id=second.id)
    assert (noisy(renamed, 0).measured[body] != view.measured[body]).mean() > 0.99


def test_lost_pixels_are_missing_in_the_measured_image_alone(flange, make_set):
    (scene,) = make_set(flange, drops=(8,))
    noise = StructuredLightNoise(baseline=0.1, dropout=0.3)
    view = Imaging(noise).view(scene, flange.mesh(scene.parameters[0]))
    body = view.instance >= 0
    assert np.isnan(view.measured[body]).mean() == pytest.approx(0.3, abs=0.06)
    assert not np.isnan(view.exact[body]).any()
    kept = body & ~np.isnan(view.measured)
    np.testing.assert_allclose(view.measured[kept], view.exact[kept], atol=1e-6)


def test_the_bin_lies_behind_the_bodies_and_has_no_noise(flange, make_set, box):
    (scene,) = make_set(flange, drops=(8,))
    background = Background.seen_from(Viewpoints(), box)
    mesh = flange.mesh(scene.parameters[0])
    bare, view = Imaging().view(scene, mesh), Imaging(GaussianNoise(0.001), background).view(scene, mesh)
    body = bare.instance >= 0
    empty = bin_depth(scene.camera, box, background.R, background.t)
    np.testing.assert_array_equal(view.exact, np.where(body, bare.exact, empty))
    np.testing.assert_array_equal(view.measured[~body], empty[~body])
    np.testing.assert_array_equal(view.instance, bare.instance)
    assert (view.exact[body] < 0.65).all() and (view.exact[~body] == 0.65).sum() > 2000


def test_a_body_too_near_is_refused_by_its_scene(flange, make_set):
    (scene,) = make_set(flange, drops=(3,))
    with pytest.raises(ValueError, match=r"^test_l/pile_0003_part_00/003: a body reaches to .* near plane"):
        Imaging().view(replace(scene, t=scene.t - (0, 0, 0.4)), flange.mesh(scene.parameters[0]))


def test_no_body_leaves_the_empty_bin(flange, make_set, box):
    (scene,) = make_set(flange, drops=(3,))
    none = {name: getattr(scene, name)[:0] for name in ("R", "t", "parameters", "visibility", "occlusion")}
    imaging = Imaging(GaussianNoise(0.01), Background.seen_from(Viewpoints(), box))
    view = imaging.view(replace(scene, **none), flange.mesh(scene.parameters[0]))
    np.testing.assert_array_equal(view.measured, imaging.empty(scene.camera))
    np.testing.assert_array_equal(view.exact, imaging.empty(scene.camera))
    assert (view.instance == -1).all() and view.visible.shape == (0,)
