"""Where a training's views come from: stored scenes, or new views of stored piles."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnet.data.noisy_scenes import NoisyScenes
from pnet.data.rendered_scenes import RenderedScenes
from pnet.data.scene_folder import SceneFolder
from pnet.data.source import StoredData
from pnet.data.views import RandomViews, StoredViews
from pnet.scenes.manifest import MANIFEST
from pnet.scenes.noise import GaussianNoise, NoNoise
from pnet.scenes.pile import Pile
from pnet.scenes.pile_store import PileHeader, write_piles
from pnet.scenes.view_factory import ViewFactory
from pnet.scenes.viewpoints import Viewpoints

AROUND = RandomViews((0.6, 0.7), (0.0, 20.0))


def pile(drop: int) -> Pile:
    """Bodies side by side, above the floor."""
    place = [[0.04 * (i - 1), 0.0, 0.03] for i in range(drop)]
    return Pile(Rotation.random(drop, rng=drop).as_matrix(), np.array(place), drop)


@pytest.fixture(scope="module")
def root(tmp_path_factory, tn34, camera):
    """Two part objects with piles of one, two and three bodies each."""
    root = tmp_path_factory.mktemp("data")
    (root / "piles" / "train").mkdir(parents=True)
    for index in (0, 5):
        size = tuple(tn34.part_object("L", index).tolist())
        header = PileHeader("made", "tn34", "train", "pile", "L", 0, index, size, (1, 2, 3))
        path = root / "piles" / "train" / f"pile_0000_part_{index:02d}.safetensors"
        write_piles(path, header, [pile(drop) for drop in (1, 2, 3)])
    settings = {"camera": {"_target_": "x", **camera.to_dict()}, "protocol": {"points": 200}}
    (root / MANIFEST).write_text(json.dumps(settings))
    return root


@pytest.fixture(scope="module")
def rendered(root, tn34) -> RenderedScenes:
    return AROUND.open(StoredData(root), tn34, None, NoNoise(), None)


def test_every_pile_is_a_scene(rendered, camera):
    assert len(rendered) == 6 and rendered.points_per_scene == 200
    assert [(scene.part_index, scene.drop) for scene in rendered.ids] == [
        (part, drop) for part in (0, 5) for drop in (1, 2, 3)
    ]
    for index in range(6):
        scene = rendered.draw(index, np.random.default_rng(0))
        assert scene.id == rendered.ids[index] and len(scene.R) == scene.id.drop
        assert scene.points.shape == (200, 3) and scene.camera == camera


def test_the_generator_alone_decides_the_view(rendered):
    first, again, other = (rendered.draw(2, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.points, again.points)
    assert np.abs(first.t - other.t).max() > 0.01


def test_a_new_view_shows_the_same_pile(rendered):
    """Distances and relative orientations of bodies stay; the camera looks at the floor's middle."""
    stored = pile(3)
    for seed in range(5):
        scene = rendered.draw(2, np.random.default_rng(seed))
        np.testing.assert_allclose(
            np.linalg.norm(scene.t[:, None] - scene.t, axis=-1),
            np.linalg.norm(stored.t[:, None] - stored.t, axis=-1),
            atol=1e-12,
        )
        turned = np.einsum("aji,bjk->abik", scene.R, scene.R)
        np.testing.assert_allclose(turned, np.einsum("aji,bjk->abik", stored.R, stored.R), atol=1e-12)
        R = scene.R[0] @ stored.R[0].T
        centre = scene.t[0] - R @ stored.t[0]  # the world's origin in the camera frame
        assert np.abs(centre[:2]).max() < 1e-12 and 0.6 <= centre[2] <= 0.7
        assert R[2, 2] < -np.cos(np.deg2rad(20)) + 1e-12  # the axis is tilted by 20 degrees at most


def test_noise_is_added_to_the_image_before_it_is_sampled(root, tn34):
    noisy = AROUND.open(StoredData(root), tn34, 100, GaussianNoise(0.002), None)
    assert noisy.points_per_scene == 100
    exact = AROUND.open(StoredData(root), tn34, 100, NoNoise(), None)
    a, b = (scenes.draw(2, np.random.default_rng(0)) for scenes in (noisy, exact))
    np.testing.assert_array_equal(a.t, b.t)
    assert np.abs(a.points[:, 2] - b.points[:, 2]).max() > 0.002


def test_part_objects_can_be_left_out(root, tn34):
    kept = AROUND.open(StoredData(root), tn34, None, NoNoise(), lambda objects: objects - {0})
    assert {scene.part_index for scene in kept.ids} == {5} and len(kept) == 3


def test_it_travels_to_a_loaders_worker(rendered):
    rendered.draw(0, np.random.default_rng(0))
    copy = pickle.loads(pickle.dumps(rendered))
    a, b = (scenes.draw(4, np.random.default_rng(0)) for scenes in (rendered, copy))
    np.testing.assert_array_equal(a.points, b.points)


def test_missing_piles_are_named(tmp_path, tn34, camera):
    views = ViewFactory(tn34, camera, Viewpoints(), NoNoise(), 10)
    with pytest.raises(FileNotFoundError, match=f"{tmp_path}/train: no piles there"):
        RenderedScenes(tmp_path, "train", views)


def test_piles_of_another_part_are_refused(root, tn06, camera):
    with pytest.raises(ValueError, match=r"pile_0000_part_00.* a pile of tn34, not of tn06"):
        AROUND.open(StoredData(root), tn06, None, NoNoise(), None)


def test_a_camera_that_never_sees_a_body_is_an_error(root, tn34, camera):
    blind = ViewFactory(tn34, replace(camera, near=0.9), Viewpoints((1.5, 1.5)), NoNoise(), 10)
    with pytest.raises(ValueError, match="the camera saw no body in 20 views of train/pile_0000_part_00/001"):
        RenderedScenes(root / "piles", "train", blind).draw(0, np.random.default_rng(0))


def test_a_manifest_without_a_camera_is_refused(tmp_path, tn34):
    (tmp_path / MANIFEST).write_text("{}")
    with pytest.raises(ValueError, match="its manifest names no camera"):
        AROUND.open(StoredData(tmp_path), tn34, None, NoNoise(), None)


def test_stored_views_are_the_folder_itself(tmp_path, tn34, write_split):
    written = write_split(tmp_path, tn34, "train")
    plain = StoredViews().open(StoredData(tmp_path), tn34, None, NoNoise(), None)
    assert isinstance(plain, SceneFolder) and len(plain) == len(written)
    drawn = plain.draw(3, np.random.default_rng(0))
    np.testing.assert_array_equal(drawn.points, written[3].points)
    noisy = StoredViews().open(StoredData(tmp_path), tn34, None, GaussianNoise(0.001), None)
    assert isinstance(noisy, NoisyScenes) and noisy.ids == plain.ids
