"""Exports in the Siléane layout, read by code of this file's own."""

import json
from dataclasses import replace
from fractions import Fraction
from math import floor

import numpy as np
import pytest
import trimesh
from PIL import Image

from pnet.data.export.background import Background, bin_depth
from pnet.data.export.depth_view import Imaging
from pnet.data.export.sileane import (
    depth_to_numbers,
    export_sileane,
    segmentation_ids,
    sileane_folder,
    sileane_name,
)
from pnet.data.poseutils import read_poseutils
from pnet.data.public.sileane import SileaneData
from pnet.parts.tn34 import TN34
from pnet.scenes.noise import GaussianNoise
from pnet.scenes.rendering import render_view
from pnet.scenes.viewpoints import Viewpoints


def read_camera(folder):
    rows = [line.split("#")[0].split() for line in (folder / "camera_params.txt").read_text().splitlines()]
    return {key: [float(x) for x in values] for key, *values in filter(None, rows)}


def read_numbers(folder, kind, name):
    with Image.open(folder / kind / f"{name}.PNG") as image:
        assert image.format == "PNG" and image.mode == "I;16"
        return np.array(image)


def read_cloud(folder, kind, name):
    """(h, w, 3) points, NaN where missing."""
    c = {key: value[0] for key, value in read_camera(folder).items()}
    numbers = read_numbers(folder, kind, name)
    z = c["clip_start"] + (c["clip_end"] - c["clip_start"]) * numbers / 65535
    z[numbers == 65535] = np.nan
    v, u = np.mgrid[: z.shape[0], : z.shape[1]]
    return np.stack([(u - c["cu"]) * z / c["fu"], (v - c["cv"]) * z / c["fv"], z], -1)


def names_of(folder, kind, ending):
    return sorted(path.name.removesuffix(ending) for path in (folder / kind).iterdir())


def all_bytes(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_depth_gives_the_rendered_cloud_within_half_a_step(part, make_set, tmp_path, eye):
    scenes = make_set(part, drops=(5, 9), viewpoints=Viewpoints((0.5, 0.7), (0.0, 40.0), turn=True))
    (folder,) = export_sileane(scenes, part, tmp_path)
    step = (eye.far - eye.near) / 65535
    for scene in scenes:
        view = render_view(eye, part.mesh(scene.parameters[0]), scene.R, scene.t)
        for kind in ("depth", "depth_gt"):
            cloud = read_cloud(folder, kind, f"{part.name}_3_{scene.id.drop:03d}")
            seen = ~np.isnan(cloud[..., 2])
            np.testing.assert_array_equal(seen, view.instance >= 0)
            exact = eye.depth_to_points(view.depth)[seen]
            error = np.abs(cloud[seen] - exact)
            assert seen.sum() > 100 and error.max() <= 0.5001 * step < 6e-6
            assert error[:, 2].max() > 0.3 * step  # all steps are used


def test_segmentation_truth_and_mesh_are_the_scenes(part, make_set, tmp_path, eye):
    scenes = make_set(part, drops=(2, 7))
    (folder,) = export_sileane(scenes, part, tmp_path)
    assert read_camera(folder) == {
        "width": [96],
        "height": [72],
        "fu": [231.3],
        "fv": [229.1],
        "cu": [46.7],
        "cv": [36.4],
        "clip_start": [0.31],
        "clip_end": [1.03],
        "location": [0, 0, 0],
        "rotation": [1, 0, 0, 0],
    }
    for scene in scenes:
        name = f"{part.name}_3_{scene.id.drop:03d}"
        truth, ids = (
            json.loads((folder / "gt" / f"{name}.json").read_text()),
            read_numbers(folder, "segmentation", name),
        )
        n = len(scene.R)
        assert [list(row) for row in truth] == [["R", "t", "segmentation_id", "occlusion_rate"]] * n
        np.testing.assert_array_equal([row["R"] for row in truth], scene.R)
        np.testing.assert_array_equal([row["t"] for row in truth], scene.t)
        np.testing.assert_array_equal([row["occlusion_rate"] for row in truth], scene.occlusion)
        assert [row["segmentation_id"] for row in truth] == [
            floor(Fraction(65535 * (n - k), n) + Fraction(1, 2)) for k in range(n)
        ]
        expected = render_view(eye, part.mesh(scene.parameters[0]), scene.R, scene.t).instance
        found = np.full(ids.shape, -1)
        for body, row in enumerate(truth):
            found[ids == row["segmentation_id"]] = body
        np.testing.assert_array_equal(found, expected)
        assert set(np.unique(ids)) <= {0, *(row["segmentation_id"] for row in truth)}
    mesh, own = trimesh.load(folder / "mesh.ply"), part.mesh(scenes[0].parameters[0])
    assert mesh.is_watertight and len(mesh.faces) == len(own.faces)
    np.testing.assert_allclose(mesh.triangles, own.triangles, atol=5e-9)
    named = json.loads((folder / "parameters.json").read_text())
    assert named == dict(zip(part.parameter_names, scenes[0].parameters[0].tolist(), strict=True))
    space, found_space = part.pose_space(scenes[0].parameters[0]), read_poseutils(folder / "poseutils.json")
    assert found_space.distance_threshold == space.distance_threshold
    assert type(found_space.symmetry) is type(space.symmetry)
    np.testing.assert_array_equal(found_space.scale, space.scale)
    np.testing.assert_array_equal(found_space.frame_t, space.frame_t)


def test_every_part_object_and_the_clutter_have_folders(flange, make_set, listed, tmp_path):
    piles = make_set(flange, drops=(1, 2), cycles=(3, 4), objects=(0, 1)).scenes
    clutter = make_set(flange, drops=(2,), kind="clutter").scenes
    steps = []
    folders = export_sileane(listed(piles + clutter), flange, tmp_path, advance=steps.append)
    assert steps == [1] * 9
    assert [path.name for path in folders] == ["tn34_0", "tn34_0_clutter", "tn34_1"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tn34_0", "tn34_0_clutter", "tn34_1"]
    shown = [f"tn34_{cycle}_{drop:03d}" for cycle in (3, 4) for drop in (1, 2)]
    images = sorted([*shown, "tn34_3_000", "tn34_4_000"])
    for folder in (folders[0], folders[2]):
        assert names_of(folder, "gt", ".json") == shown
        for kind in ("depth", "depth_gt", "segmentation"):
            assert names_of(folder, kind, ".PNG") == images
    assert names_of(folders[1], "gt", ".json") == ["tn34_3_002"]
    for index, folder in ((0, folders[0]), (1, folders[2])):
        assert json.loads((folder / "parameters.json").read_text())["r"] == [0.015, 0.02][index]
        assert trimesh.load(folder / "mesh.ply").extents[0] == pytest.approx([0.03, 0.04][index], rel=1e-5)
    assert (sileane_folder("tn34", piles[-1].id), sileane_name("tn34", piles[-1].id)) == (
        "tn34_1",
        "tn34_4_002",
    )


def test_the_empty_bin_is_scene_zero_and_lies_behind_the_others(flange, make_set, box, tmp_path, eye):
    scenes = make_set(flange, drops=(7,))
    imaging = Imaging(GaussianNoise(0.002), Background.seen_from(Viewpoints(), box))
    (folder,) = export_sileane(scenes, flange, tmp_path, imaging)
    exact = bin_depth(eye, box, imaging.background.R, imaging.background.t)
    step = (eye.far - eye.near) / 65535
    for kind in ("depth", "depth_gt"):
        found = read_cloud(folder, kind, "tn34_3_000")[..., 2]
        np.testing.assert_allclose(found, exact, atol=0.5001 * step)  # NaN equals NaN
    assert not read_numbers(folder, "segmentation", "tn34_3_000").any()
    body = read_numbers(folder, "segmentation", "tn34_3_007") > 0
    noisy, ideal = (read_cloud(folder, kind, "tn34_3_007")[..., 2] for kind in ("depth", "depth_gt"))
    np.testing.assert_allclose(ideal[~body], exact[~body], atol=0.5001 * step)
    np.testing.assert_array_equal(noisy[~body], ideal[~body])
    rendered = render_view(eye, flange.mesh(scenes[0].parameters[0]), scenes[0].R, scenes[0].t).depth
    assert np.abs(ideal - rendered)[body].max() <= 0.5001 * step
    assert (noisy - ideal)[body].std() == pytest.approx(0.002, rel=0.1)


def test_without_a_background_the_empty_bin_is_missing(flange, make_set, tmp_path):
    (folder,) = export_sileane(make_set(flange, drops=(2,)), flange, tmp_path)
    assert (read_numbers(folder, "depth", "tn34_3_000") == 65535).all()
    assert not (folder / "gt" / "tn34_3_000.json").exists()


def test_no_depth_is_mistaken_for_a_missing_one(eye):
    step = (eye.far - eye.near) / 65535
    depth = np.array([[eye.near, eye.far, eye.far - 0.4 * step, np.nan, eye.near + 7 * step]])
    assert depth_to_numbers(depth, eye).tolist() == [[0, 65534, 65534, 65535, 7]]
    # single precision may leave the range by a hair
    ends = np.array([[np.float64(np.float32(eye.near)), np.float64(np.float32(eye.far))]])
    assert depth_to_numbers(ends, eye).tolist() == [[0, 65534]]


@pytest.mark.parametrize("n", [0, 1, 2, 3, 60, 1000])
def test_segmentation_ids_differ_and_are_not_the_background(n):
    ids = segmentation_ids(n).tolist()
    assert len(set(ids)) == n and all(0 < x <= 65535 for x in ids)
    assert ids == [floor(Fraction(65535 * (n - k), n) + Fraction(1, 2)) for k in range(n)]


def test_an_interrupted_export_is_completed_by_the_same_call(flange, make_set, tmp_path):
    scenes = make_set(flange, drops=(1, 2, 3), objects=(0, 1))
    imaging, steps = Imaging(GaussianNoise(0.001), seed=4), []

    def stop(done):
        steps.append(done)
        if len(steps) == 4:
            raise KeyboardInterrupt

    export_sileane(scenes, flange, tmp_path / "whole", imaging)
    with pytest.raises(KeyboardInterrupt):
        export_sileane(scenes, flange, tmp_path / "again", imaging, stop)
    assert len(list((tmp_path / "again").rglob("gt/*.json"))) == 4
    export_sileane(scenes, flange, tmp_path / "again", imaging)
    assert all_bytes(tmp_path / "again") == all_bytes(tmp_path / "whole")
    assert len(all_bytes(tmp_path / "whole")) == 2 * (4 + 3 * 4 + 3)


def test_a_folder_of_another_part_object_or_camera_is_left_alone(flange, make_set, tmp_path, eye):
    export_sileane(make_set(flange, drops=(2,)), flange, tmp_path)
    before = all_bytes(tmp_path)
    other = TN34({"r": [18], "h": [12]}, sections=12)
    with pytest.raises(ValueError, match=r"tn34_0/mesh\.ply: is there already, of another part object"):
        export_sileane(make_set(other, drops=(3,)), other, tmp_path)
    camera = replace(eye, fx=300.0)
    with pytest.raises(ValueError, match=r"camera_params\.txt: is there already"):
        export_sileane(make_set(flange, drops=(3,), camera=camera), flange, tmp_path)
    assert all_bytes(tmp_path) == before
    # another split, whose cycles have other numbers, may come beside
    export_sileane(make_set(flange, drops=(3,), cycles=(9,), split="train"), flange, tmp_path)
    assert names_of(tmp_path / "tn34_0", "gt", ".json") == ["tn34_3_002", "tn34_9_003"]


def test_bodies_in_scene_zero_are_refused(flange, make_set, listed, tmp_path):
    (scene,) = make_set(flange, drops=(2,))
    with pytest.raises(ValueError, match="/000: shows 2 bodies, but 000 is the name of the empty bin"):
        export_sileane(listed([replace(scene, id=replace(scene.id, drop=0))]), flange, tmp_path)


@pytest.mark.parametrize("depth", ["depth", "depth_gt"])
def test_pnets_reader_of_the_data_set_gives_the_same_scenes(make_set, tmp_path, eye, box, depth):
    part = TN34({"r": [15], "h": [12]}, sections=12)
    viewpoints = Viewpoints((0.6, 0.6), (20.0, 20.0))
    scenes = make_set(part, drops=(3, 7), cycles=(0, 2), viewpoints=viewpoints)
    imaging = Imaging(background=Background.seen_from(viewpoints, box))
    (folder,) = export_sileane(scenes, part, tmp_path, imaging)
    back = SileaneData(str(folder), points=400, depth=depth).scenes("test_l", part)
    assert back.ids == scenes.ids
    for scene, found in zip(scenes, back, strict=True):
        assert found.camera == scene.camera and found.part == scene.part
        for name in ("t", "parameters", "visibility", "occlusion"):
            np.testing.assert_array_equal(getattr(found, name), getattr(scene, name))
        np.testing.assert_allclose(found.R, scene.R, atol=1e-15)
        # of points that are nearly as far another may be sampled first, so sets of pixels are compared
        own, other = (eye.project(x.points).round().astype(int) @ [1, 1000] for x in (scene, found))
        both, i, j = np.intersect1d(own, other, return_indices=True)
        assert len(both) > 0.95 * len(np.unique(own))
        assert np.abs(scene.points[i] - found.points[j]).max() < 6e-6
        np.testing.assert_array_equal(scene.instance[i], found.instance[j])
