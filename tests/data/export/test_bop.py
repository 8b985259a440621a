"""Exports in the BOP layout, read by code of this file's own; masks, counts and boxes made again naively."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pnet.data.export.background import Background, bin_depth
from pnet.data.export.bop import bop_object_id, bop_scene_id, depth_scale, export_bop
from pnet.data.export.bop_masks import NOWHERE, box_of, silhouette
from pnet.data.export.depth_view import Imaging
from pnet.parts.tn34 import TN34
from pnet.records import SceneId
from pnet.scenes.noise import StructuredLightNoise
from pnet.scenes.viewpoints import Viewpoints

MARGIN = 120  # pixels round the image in which silhouettes end, see `make_set`


class BopFolder:
    """One BOP scene."""

    def __init__(self, folder):
        self.folder = folder
        names = ("scene_camera", "scene_gt", "scene_gt_info")
        self.camera, self.gt, self.info = (
            json.loads((folder / f"{name}.json").read_text()) for name in names
        )

    def image(self, kind, name):
        with Image.open(self.folder / kind / f"{name}.png") as image:
            assert image.mode == ("I;16" if kind == "depth" else "L")
            return np.array(image)

    def cloud(self, im_id):
        """(h, w, 3) millimetres, NaN where missing."""
        K = np.reshape(self.camera[str(im_id)]["cam_K"], (3, 3))
        numbers = self.image("depth", f"{im_id:06d}")
        z = np.where(numbers > 0, numbers * self.camera[str(im_id)]["depth_scale"], np.nan)
        v, u = np.mgrid[: z.shape[0], : z.shape[1]]
        return np.stack([u, v, np.ones(z.shape)], -1) @ np.linalg.inv(K).T * z[..., None]

    def masks(self, kind, im_id):
        paths = sorted((self.folder / kind).glob(f"{im_id:06d}_*.png"))
        assert [path.stem for path in paths] == [f"{im_id:06d}_{i:06d}" for i in range(len(paths))]
        found = [self.image(kind, path.stem) for path in paths]
        assert all(set(np.unique(mask)) <= {0, 255} for mask in found)
        return np.array(found) > 0


def naive_box(mask, margin=0):
    columns, rows = (np.flatnonzero(mask.any(axis)) for axis in (0, 1))
    if not len(columns):
        return [-1, -1, -1, -1]
    x, y = columns[0], rows[0]
    return [int(x) - margin, int(y) - margin, int(columns[-1] - x), int(rows[-1] - y)]


def all_bytes(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def exported(flange, make_set, tmp_path_factory, box):
    """Scenes with noise before the bin, and their export."""
    out = tmp_path_factory.mktemp("bop")
    viewpoints = Viewpoints((0.6, 0.6), (15.0, 15.0))
    scenes = make_set(flange, drops=(2, 8), viewpoints=viewpoints)
    imaging = Imaging(StructuredLightNoise(0.1, dropout=0.2), Background.seen_from(viewpoints, box))
    return scenes, imaging, out, export_bop(scenes, flange, out, imaging)


def test_depth_gives_the_rendered_cloud_within_half_a_step(part, make_set, tmp_path):
    scenes = make_set(part, drops=(5, 9))
    folder = BopFolder(export_bop(scenes, part, tmp_path) / "000003")
    for scene in scenes:
        view = Imaging().view(scene, part.mesh(scene.parameters[0]))
        cloud = folder.cloud(scene.id.drop)
        seen = ~np.isnan(cloud[..., 2])
        np.testing.assert_array_equal(seen, view.instance >= 0)
        error = np.abs(cloud - 1000 * scene.camera.depth_to_points(np.nan_to_num(view.exact)))[seen]
        assert seen.sum() > 100 and 0.03 < error[:, 2].max() <= 0.05001 and error.max() <= 0.05001


def test_poses_and_cameras_are_the_scenes_in_millimetres(exported):
    scenes, _, out, split = exported
    assert split == out / "test_l" and [path.name for path in split.iterdir()] == ["000003"]
    folder = BopFolder(split / "000003")
    assert list(folder.gt) == list(folder.info) == list(folder.camera) == ["2", "8"]
    for scene in scenes:
        entries = folder.gt[str(scene.id.drop)]
        assert [entry["obj_id"] for entry in entries] == [1] * len(scene.R)
        np.testing.assert_array_equal([entry["cam_R_m2c"] for entry in entries], scene.R.reshape(-1, 9))
        np.testing.assert_allclose([entry["cam_t_m2c"] for entry in entries], 1000 * scene.t, rtol=1e-15)
        assert folder.camera[str(scene.id.drop)] == {
            "cam_K": [231.3, 0, 46.7, 0, 229.1, 36.4, 0, 0, 1],
            "depth_scale": 0.1,
        }
    camera = json.loads((out / "camera.json").read_text())
    assert camera == {
        "cx": 46.7,
        "cy": 36.4,
        "fx": 231.3,
        "fy": 229.1,
        "width": 96,
        "height": 72,
        "depth_scale": 0.1,
    }


def test_masks_boxes_and_counts_are_those_of_a_plain_ray_caster(exported, flange, naive_depth, triangles_of):
    scenes, _, _, split = exported
    folder = BopFolder(split / "000003")
    for scene in scenes:
        mesh, im_id = flange.mesh(scene.parameters[0]), scene.id.drop
        alone = np.array(
            [
                naive_depth(scene.camera, triangles_of(mesh, R, t), MARGIN)
                for R, t in zip(scene.R, scene.t, strict=True)
            ]
        )
        inner = alone[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
        nearest = np.where(np.isfinite(inner.min(0)), inner.argmin(0), -1)
        whole, visible = np.isfinite(inner), nearest == np.arange(len(inner))[:, None, None]
        np.testing.assert_array_equal(folder.masks("mask", im_id), whole)
        np.testing.assert_array_equal(folder.masks("mask_visib", im_id), visible)
        measured = ~np.isnan(folder.cloud(im_id)[..., 2])
        for body, info in enumerate(folder.info[str(im_id)]):
            pixels, seen = int(np.isfinite(alone[body]).sum()), int(visible[body].sum())
            assert info == {
                "bbox_obj": naive_box(np.isfinite(alone[body]), MARGIN) if seen else [-1] * 4,
                "bbox_visib": naive_box(visible[body]),
                "px_count_all": pixels,
                "px_count_valid": int((whole[body] & measured).sum()),
                "px_count_visib": seen,
                "visib_fract": seen / pixels,
            }
            assert info["visib_fract"] == pytest.approx(1 - scene.occlusion[body])
    # the cases that make_set is there for: cut off at the left, outside, hidden in part, pixels lost
    cut, outside, *rest = folder.info["8"]
    assert cut["bbox_obj"][0] < 0 == cut["bbox_visib"][0]
    assert outside["px_count_all"] > 30 and outside["bbox_obj"] == outside["bbox_visib"] == NOWHERE
    assert min(info["visib_fract"] for info in rest) < 0.8
    assert all(info["px_count_valid"] < info["px_count_all"] for info in rest)


def test_the_measured_depth_has_noise_on_bodies_and_the_bin_behind(exported):
    scenes, imaging, _, split = exported
    folder, scene = BopFolder(split / "000003"), scenes[1]
    z = folder.cloud(8)[..., 2]
    body = folder.masks("mask_visib", 8).any(0)
    empty = bin_depth(scene.camera, imaging.background.box, imaging.background.R, imaging.background.t)
    np.testing.assert_allclose(z[~body], 1000 * empty[~body], atol=0.05001)
    assert np.isnan(z[body]).mean() == pytest.approx(0.2, abs=0.05)


def test_targets_count_the_bodies_that_are_visible_by_a_tenth(exported):
    scenes, _, out, split = exported
    targets = json.loads((out / "test_targets_bop19.json").read_text())
    info = BopFolder(split / "000003").info
    expected = [
        {
            "im_id": im_id,
            "inst_count": sum(one["visib_fract"] >= 0.1 for one in info[str(im_id)]),
            "obj_id": 1,
        }
        for im_id in (2, 8)
    ]
    assert targets == [{**one, "scene_id": 3} for one in expected]
    assert [one["inst_count"] for one in targets] == [(scene.occlusion <= 0.9).sum() for scene in scenes]
    assert targets[0]["inst_count"] == 1  # the other one lies outside


def test_several_part_objects_and_clutter_have_scenes_and_models_of_their_own(
    flange, make_set, listed, tmp_path
):
    piles = make_set(flange, drops=(1, 3), cycles=(3, 4), objects=(0, 1), split="train").scenes
    clutter = make_set(flange, drops=(3,), kind="clutter", split="train").scenes
    steps = []
    split = export_bop(listed(clutter + piles), flange, tmp_path, advance=steps.append)
    assert steps == [1] * 9
    assert sorted(path.name for path in split.iterdir()) == [
        "000003",
        "000004",
        "010003",
        "010004",
        "10000003",
    ]
    models = json.loads((tmp_path / "models" / "models_info.json").read_text())
    assert list(models) == ["1", "2"]
    assert [models[key]["parameters"]["r"] for key in models] == [15, 20]
    for name, obj_id in (("000004", 1), ("010004", 2), ("10000003", 1)):
        assert {one["obj_id"] for one in BopFolder(split / name).gt["3"]} == {obj_id}
    targets = json.loads((tmp_path / "train_targets_bop19.json").read_text())
    assert {(one["scene_id"], one["obj_id"]) for one in targets} == {
        (3, 1),
        (4, 1),
        (10003, 2),
        (10004, 2),
        (10000003, 1),
    }
    # another split comes beside, with fewer part objects
    export_bop(make_set(flange, drops=(2,), cycles=(9,), split="val"), flange, tmp_path)
    assert json.loads((tmp_path / "models" / "models_info.json").read_text()) == models
    assert (tmp_path / "val" / "000009" / "depth" / "000002.png").exists()


def test_numbers_follow_from_the_scene_alone():
    one = SceneId("test_l", "pile", 29, 12, 60)
    assert (bop_scene_id(one), bop_object_id(one)) == (120029, 13)
    assert bop_scene_id(replace(one, kind="clutter")) == 10120029
    for far in (replace(one, cycle=10000), replace(one, part_index=1000)):
        with pytest.raises(ValueError, match="cycles below 10000 and part objects below 1000"):
            bop_scene_id(far)


def test_depth_steps_reach_as_far_as_the_camera(eye, make_set, flange, tmp_path):
    assert [depth_scale(replace(eye, far=far)) for far in (1.0, 6.5535, 6.554, 65.0)] == [0.1, 0.1, 1.0, 1.0]
    with pytest.raises(ValueError, match="BOP's depth images hold 65 m"):
        depth_scale(replace(eye, far=70.0))
    camera = replace(eye, far=10.0)
    (scene,) = scenes = make_set(flange, drops=(3,), camera=camera)
    folder = BopFolder(export_bop(scenes, flange, tmp_path) / "000003")
    z = folder.cloud(3)[..., 2]
    exact = 1000 * Imaging().view(scene, flange.mesh(scene.parameters[0])).exact
    np.testing.assert_allclose(z, exact, atol=0.5001)
    assert folder.camera["3"]["depth_scale"] == 1.0


def test_an_interrupted_export_is_completed_by_the_same_call(flange, make_set, tmp_path):
    scenes = make_set(flange, drops=(1, 3), cycles=(3, 4), objects=(0, 1))
    steps = []

    def stop(done):
        steps.append(done)
        if len(steps) == 5:
            raise KeyboardInterrupt

    export_bop(scenes, flange, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        export_bop(scenes, flange, tmp_path / "again", advance=stop)
    assert len(list((tmp_path / "again").rglob("scene_gt.json"))) == 2
    export_bop(scenes, flange, tmp_path / "again")
    assert all_bytes(tmp_path / "again") == all_bytes(tmp_path / "whole")


def test_what_another_export_left_is_not_mixed(flange, make_set, tmp_path):
    export_bop(make_set(flange, drops=(2,)), flange, tmp_path)
    before = all_bytes(tmp_path)
    other = TN34({"r": [18], "h": [12]}, sections=12)
    with pytest.raises(
        ValueError, match=r"models_info\.json: object 1 is another part object there, not tn34"
    ):
        export_bop(make_set(other, drops=(3,), split="val"), other, tmp_path)
    with pytest.raises(ValueError, match=r"test_l: another test split is there.*test_g to another"):
        export_bop(make_set(flange, drops=(3,), split="test_g"), flange, tmp_path)
    assert all_bytes(tmp_path) == before


def test_a_silhouette_does_not_end_at_the_image(eye, flange):
    """A disc whose middle lies on each border, on two corners and far outside."""
    mesh = flange.mesh(flange.part_object("L", 1))
    middle, box = silhouette(eye, mesh, np.eye(3), np.array([0, 0, 0.5]))
    x, y, w, h = box
    assert middle.any() and naive_box(middle) == box
    beyond, _ = silhouette(replace(eye, far=0.4), mesh, np.eye(3), np.array([0, 0, 0.5]))
    np.testing.assert_array_equal(beyond, middle)  # not measured, but there
    for du, dv in [(-47, 0), (49, 0), (0, -36), (0, 35), (-47, -36), (49, 35), (400, 0), (0, -500)]:
        # the principal point moves: a body that moved would show another side
        camera = replace(eye, cx=eye.cx + du, cy=eye.cy + dv)
        mask, moved = silhouette(camera, mesh, np.eye(3), np.array([0, 0, 0.5]))
        assert moved == [x + du, y + dv, w, h]
        full = np.zeros((3000, 3000), bool)
        full[1000 : 1000 + eye.height, 1000 : 1000 + eye.width] = middle
        shifted = np.roll(full, (dv, du), (0, 1))[1000 : 1000 + eye.height, 1000 : 1000 + eye.width]
        np.testing.assert_array_equal(mask, shifted)


def test_boxes_by_hand():
    mask = np.zeros((5, 7), bool)
    assert box_of(mask) == [-1, -1, -1, -1]
    mask[2, 3] = True
    assert box_of(mask) == [3, 2, 0, 0]
    mask[4, 1] = True
    assert box_of(mask, left=-10, top=20) == [-9, 22, 2, 2]
